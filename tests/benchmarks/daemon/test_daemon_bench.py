"""Short forms of the daemon's benchmarks: the full forms are in tests/benchmarks."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parent


def benchmark(name):
    spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.benchmark
@pytest.mark.parametrize(
    ("rate_hz", "seconds"),
    [(800, 6.0), (200, 15.0), (800, 15.0)],
)
def test_no_sample_is_lost_at_the_devices_rates(rate_hz, seconds, tmp_path):
    figures = benchmark("bench_run").measure(rate_hz, seconds, tmp_path)
    print(figures)
    assert figures.lost == 0
    assert figures.taken > (seconds - 1.0) * rate_hz
    assert figures.exit_code == 0
    assert figures.stop_s < 3.0


REPLUG = """
import json, sys
from pathlib import Path
from bench_replug import measure
found = measure(20, Path(sys.argv[1]))
print(found, file=sys.stderr)
kept = {name: getattr(found, name) for name in ("descriptors", "threads", "rss_mb")}
print(json.dumps(kept))
"""


@pytest.mark.benchmark
@pytest.mark.slow
def test_unplugging_leaks_nothing(tmp_path):
    """In a process of its own: the memory of one that has run a thousand tests moves by itself."""
    path = {"PYTHONPATH": os.pathsep.join([str(BENCHMARKS), *filter(None, sys.path)])}
    done = subprocess.run(
        [sys.executable, "-c", REPLUG, str(tmp_path)],
        env={**os.environ, **path},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    print(done.stderr)
    assert done.returncode == 0
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["descriptors"][0] == figures["descriptors"][1]
    assert figures["threads"][0] == figures["threads"][1]
    assert figures["rss_mb"][1] - figures["rss_mb"][0] < 5.0
