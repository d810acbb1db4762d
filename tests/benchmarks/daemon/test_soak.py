"""Short form of benchmarks/daemon/bench_soak.py: live memory does not grow, updates stay as quick.

The histories are made so short that they are full after three minutes of device time. What is live
is counted, so the figures do not depend on what else the machine does.
"""

from __future__ import annotations

import functools
import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import theilslopes

from ahrsd.evidence.collector import EvidenceCollector
from ahrsd.evidence.segments import HistoryParameters
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.emulator.scenarios import Setup
from drivers.vn100.messages import encode

SHORT = HistoryParameters(segment_s=6.0, shortest_s=2.0, segments=8)
ESTIMATOR = {"epoch_steps": 64, "window_steps": 512}
MINUTE_DAY = 60.0 / 86400.0
FULL_S, ROW_S = 180.0, 10.0
HEAP_KB, BLOCKS = 60.0, 300  # what a device minute may add: noise of a kB or so, never a trend


@pytest.fixture(scope="module")
def soak():
    path = Path(__file__).with_name("bench_soak.py")
    spec = importlib.util.spec_from_file_location("bench_soak", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_soak"] = module
    spec.loader.exec_module(module)
    return module


@dataclass
class Growth:
    """Per device minute, by the median slope (Theil and Sen) through what comes after `FULL_S`.

    A buffer of a megabyte that happens to be out at a row bends a line of least squares by more
    than the bar, either way; it is no growth.
    """

    heap_kb: float
    blocks: float

    @staticmethod
    def of(figures):
        minutes = figures.column("device_s") / 60.0
        late = minutes > FULL_S / 60.0

        def slope(name):
            return float(theilslopes(figures.column(name)[late], minutes[late]).slope)

        return Growth(1e3 * slope("heap_mb"), slope("blocks"))


def run(soak, folder, minutes):
    return soak.measure(
        folder, days=minutes * MINUTE_DAY, loop_s=60.0, row_s=ROW_S, estimator=ESTIMATOR
    )


@pytest.fixture
def short_histories(monkeypatch):
    monkeypatch.setattr(
        "ahrsd.core.estimation.EvidenceCollector",
        functools.partial(EvidenceCollector, SHORT),
    )


@pytest.mark.slow
@pytest.mark.parametrize("minutes", [6, 9])
def test_memory_and_update_time_do_not_grow(soak, tmp_path, short_histories, minutes):
    found = run(soak, tmp_path, float(minutes))
    print(found)
    growth = Growth.of(found)
    print(growth)
    assert abs(growth.heap_kb) < HEAP_KB
    assert abs(growth.blocks) < BLOCKS
    assert found.by_reference("estimator_s", 150.0) < 2.0
    assert found.column("slices")[-1] == pytest.approx(minutes * 60 / 15, abs=2)
    assert found.column("reference_s")[-1] < 0.2 * found.column("cpu_s")[-1]
    assert len(set(found.column("descriptors")[1:])) == 1
    assert len(set(found.column("threads")[1:])) == 1
    assert found.column("updates")[-1] > 150 / 9 * minutes
    assert found.column("gaps")[-1] >= 6 / 9 * minutes
    assert found.column("samples")[-1] > 0.95 * minutes * 60 * 40 * 60 / 62


@pytest.mark.slow
def test_growing_log_is_detected(soak, tmp_path, short_histories, monkeypatch):
    """The proof that the test above can fail: four kilobytes per update."""
    monkeypatch.setattr(soak, "DAEMON_KEEPS", None)
    growth = Growth.of(run(soak, tmp_path, 8.0))
    assert growth.heap_kb + growth.blocks / 10 > HEAP_KB


def test_the_played_stream_is_the_emulated_one_with_time_going_on(soak, monkeypatch):
    device = soak.Device(Setup("rov", seed=1, output="binary", rate_hz=40, baud=921600), 20.0)
    monkeypatch.setattr(soak, "DAMAGE_S", 1e12)
    rounds = []
    for begins_s in (10.0, 1e6):
        deframer = Deframer()
        frames = [f for _, data in device.round(begins_s) for f in deframer.feed(data)]
        assert deframer.counters.skipped_bytes == 0
        found = [decode(frame) for frame in frames]
        assert all(isinstance(one, Measurement) for one in found)
        rounds.append(np.array([one.values for one in found]))
    first, second = rounds
    assert len(first) == pytest.approx(21 * 40, abs=25)
    assert first[0, 0] == 10.0
    assert np.diff(first[:, 0]) == pytest.approx(1 / 40, abs=1e-4)
    assert second[:, 0] - first[:, 0] == pytest.approx(1e6 - 10.0, abs=1e-6)
    assert np.array_equal(first[:, 1:], second[:, 1:])


def test_query_is_answered_once_by_the_device_and_then_from_memory(soak):
    device = soak.Device(Setup("rov", seed=1, output="binary", rate_hz=40, baud=921600), 5.0)
    asked = encode("VNRRG,03")
    answer = device.answer(asked)
    assert answer.startswith(b"$VNRRG,03,0100130608*")
    device._talker = None
    assert device.answer(asked) == answer
