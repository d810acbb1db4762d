"""Short form of benchmarks/writeback/bench_siege.py: all surroundings of the daemon fail at
once.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).parents[2] / "benchmarks" / "writeback" / "bench_siege.py"


@pytest.mark.benchmark
def test_no_sample_is_lost_with_stopped_viewer_full_disk_and_blocked_readers(tmp_path):
    if os.geteuid() != 0:
        pytest.skip("only root can mount a small file system")
    spec = importlib.util.spec_from_file_location("bench_siege", PATH)
    siege = importlib.util.module_from_spec(spec)
    sys.modules["bench_siege"] = siege
    spec.loader.exec_module(siege)
    try:
        with siege.small_disk(tmp_path) as disk:
            figures = siege.measure(200, 8.0, tmp_path, disk)
    except subprocess.CalledProcessError:
        pytest.skip("mounting is not allowed here")
    print(figures)
    assert figures.disk_full
    assert figures.said_full
    assert figures.stopped
    assert figures.lost == 0
    assert figures.received > 1400
    assert float(figures.latency_s.mean()) < 1.0  # on a busy machine
    assert figures.exit_code == 0
    assert figures.stop_s < 8.0  # 3 s on an idle machine
