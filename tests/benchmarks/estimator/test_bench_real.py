"""Short form of bench_real.py: real recordings, with the cheap methods only."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARK = Path(__file__).with_name("bench_real.py")


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("bench_real", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_real"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.benchmark
def test_circles_calibrate_and_the_drive_judges(bench, recordings):
    """A car with 0.35 G of iron: useless before, as good as the reference can tell after."""
    lines = {line.method: line for line in bench.drive(recordings, ("magical-ls", "magyc-bfg"))}
    assert set(lines) == {"magyc", "magical-ls", "magyc-bfg"}
    for line in lines.values():
        assert line.before_deg == pytest.approx(77.1, abs=0.5)
        assert line.after_deg < 12.0
        assert line.reckoning_before_percent > 50.0
        assert line.reckoning_after_percent < 5.0
    assert lines["magyc"].after_deg < 9.0


@pytest.mark.slow
@pytest.mark.benchmark
def test_no_method_beats_one_that_uses_the_optical_attitude(bench, recordings):
    """This sensor is nearly calibrated: the remaining error is the field of the room, and ours
    adds none.
    """
    names = (bench.BROAD[1],)
    lines = {line.method: line for line in bench.against_optics(recordings, ("ellipsoid",), names)}
    assert lines["oracle"].after_deg < lines["oracle"].before_deg
    assert lines["oracle"].after_deg == pytest.approx(2.64, abs=0.1)
    assert lines["magyc"].after_deg < lines["oracle"].after_deg + 0.4


@pytest.mark.slow
@pytest.mark.benchmark
def test_a_sensor_at_rest_is_refused_by_all(bench, recordings):
    rows = bench.at_rest(recordings, ("magical-nls", "twostep", "ellipsoid", "fnp"))
    assert len(rows) == 5
    for row in rows:
        assert not row.converged
        assert row.reason


@pytest.mark.slow
@pytest.mark.benchmark
def test_one_sensor_on_two_fists(bench, recordings):
    """y and z are about (0.03, -0.45) G whoever wears it; x, along the arm, is the weak one."""
    for line in bench.punch(recordings, ("magyc-bfg", "fnp")):
        for person in ("shaked_mG", "satish_mG"):
            assert np.allclose(line[person][1:], [30.0, -455.0], atol=35.0), line
