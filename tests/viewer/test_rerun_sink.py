"""The sink: no fault of the viewer, its process or its disk reaches the caller."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow
import pytest
import rerun_cli
from free_port import free_port
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.events import (
    Estimated,
    Event,
    GateResult,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)
from ahrsd.samples import SampleBlock
from ahrsd.viewer.process import free_part, part_name, quaternion_xyzw, record
from ahrsd.viewer.sink import ProcessSettings, RerunLimits, RerunSink, SinkCounters

RATE_HZ = 100.0
FIELD_GAUSS = 0.48
A = np.array([[1.16, 0.07, -0.03], [0.07, 0.92, 0.05], [-0.03, 0.05, 0.95]])
A = A / np.cbrt(np.linalg.det(A))
B_GAUSS = np.array([0.21, -0.13, 0.16])
GYRO_BIAS = np.array([0.004, -0.006, 0.003])


def exponential(v: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(v)
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    if angle < 1e-12:
        return np.eye(3) + K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * (K @ K)


def simulated(seconds: float, seed: int = 1) -> SampleBlock:
    """A vehicle that turns and rocks, as the sensor with its iron and bias reads it."""
    rng = np.random.default_rng(seed)
    time_s = 12.0 + np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    t = time_s - time_s[0]
    rate = np.stack(
        [0.55 * np.cos(0.9 * t), 0.5 * np.sin(0.63 * t + 1.0), 0.35 + 0.3 * np.sin(0.11 * t)], 1
    )
    R_nb, field = np.eye(3), []
    for w in rate:
        R_nb = R_nb @ exponential(w / RATE_HZ)
        field.append(R_nb.T @ np.array([0.2, 0.02, 0.436]))
    h = np.array(field) / 0.48 * FIELD_GAUSS
    raw = h @ A.T + B_GAUSS + rng.normal(0, 0.0016, h.shape)
    gyro = rate + GYRO_BIAS + rng.normal(0, 0.002, rate.shape)
    nan = np.full_like(h, np.nan)
    return SampleBlock(time_s, np.full(len(t), 1 / RATE_HZ), 5000.0 + t * 1.00002, raw, gyro, nan)


def part(block: SampleBlock, rows: slice) -> SampleBlock:
    return SampleBlock(
        block.time_s[rows],
        block.dt_s[rows],
        block.host_s[rows],
        block.raw_b_gauss[rows],
        block.gyro_b_rad_s[rows],
        block.accel_b_m_s2[rows],
    )


def estimate_after(seconds: float, rng: np.random.Generator) -> Estimate:
    """An estimate whose error and sigma shrink as 1/sqrt(time)."""
    scale = np.r_[np.full(6, 0.35), np.full(3, 0.12), np.full(3, 0.003)] / (0.2 + seconds)
    scale += np.r_[np.full(6, 0.0015), np.full(3, 0.0005), np.full(3, 0.0001)]
    error = scale * rng.normal(0, 1, 12) * 0.7
    soft = np.zeros((3, 3))
    soft[np.triu_indices(3)] = A[np.triu_indices(3)] + error[:6]
    soft = soft + np.triu(soft, 1).T
    heading = 0.25 + 40.0 / (1.0 + seconds)
    return Estimate(
        soft_iron=soft,
        hard_iron_gauss=B_GAUSS + error[6:9],
        gyro_bias_rad_s=GYRO_BIAS + error[9:],
        field_gauss=FIELD_GAUSS,
        field_known=False,
        covariance=np.diag(scale**2),
        noise_mag_gauss=0.0016,
        noise_gyro_rad_s=0.002,
        misfit=1.02,
        heading_sigma_deg=heading,
        observability=Observability(np.linspace(0.01, 0.3, 12), (), seconds / 40.0),
        samples=int(seconds * RATE_HZ),
        duration_s=seconds,
        converged=heading < 1.0,
    )


def judged_after(seconds: float, at_s: float, host_s: float, heading: float) -> Judged:
    def gate(name: str, value: float, limit: float, ok: bool, unit: str, advice: str) -> GateResult:
        return GateResult(name, value, limit, ok, at_s, unit, advice)

    turn = min(360.0, seconds * 9.0)
    return Judged(
        at_s,
        host_s,
        (
            gate("stream.errors", 2e-4, 1e-3, True, "", "check the cable and the baud rate"),
            gate(
                "input_basis.registers_read",
                6,
                6,
                True,
                "registers",
                "let the daemon read registers",
            ),
            gate("motion.turn", turn, 280.0, turn >= 280.0, "deg", "drive a full turn"),
            gate(
                "observability.score",
                seconds / 40,
                1.0,
                seconds >= 40,
                "",
                "pitch by 30 deg",
            ),
            gate(
                "observability.heading_sigma", heading, 1.0, heading <= 1.0, "deg", "keep turning"
            ),
            gate("field.spread", 1.4, 2.0, True, "%", "move away from steel"),
            gate(
                "heldout_heading.rms",
                30 / (5 + seconds),
                0.5,
                seconds > 55,
                "deg",
                "one more turn, in the other direction",
            ),
            gate(
                "second_opinion.heading",
                0.4,
                2.0,
                seconds > 20,
                "deg",
                "wait for the ellipsoid fit",
            ),
            gate("bounds.condition", 1.27, 2.0, True, "", "an operator must approve"),
        ),
    )


STORY = (
    (0.5, "OBSERVING", "CANDIDATE", "first estimate"),
    (56.0, "CANDIDATE", "QUALIFIED", "all gates ok for 1 s"),
    (58.0, "QUALIFIED", "STAGED", "register 23 and 84 written to RAM and read back"),
    (60.0, "STAGED", "TRIAL", "proving it on live data"),
    (80.0, "TRIAL", "PROVEN", "heading error 0.3 deg on 20 s of live data, 23.1 before"),
)


def simulated_events(seconds: float = 90.0, rows: int = 10) -> Iterator[Event]:
    """What the core would say while a calibration converges, is written and is proven."""
    rng = np.random.default_rng(7)
    block = simulated(seconds)
    story = list(STORY)
    present, proposed = Affine.identity(), None
    yield Noted(12.0, 5000.0, "info", "VN-100, firmware 2.1, serial 0100012345")
    for k in range(0, len(block), rows):
        here = part(block, slice(k, k + rows))
        at_s, host_s = float(here.time_s[-1]), float(here.host_s[-1])
        yield SamplesSeen(here, present, proposed)
        if k % 100 == 90:
            estimate = estimate_after((k + rows) / RATE_HZ, rng)
            proposed = estimate.correction
            yield Estimated(at_s, host_s, estimate)
            yield judged_after(k / RATE_HZ, at_s, host_s, estimate.heading_sigma_deg)
        while story and k / RATE_HZ >= story[0][0]:
            _, old, new, reason = story.pop(0)
            yield StateChanged(at_s, host_s, old, new, reason)
            if new == "STAGED" and proposed is not None:
                before = present.to_register()
                present = proposed
                yield RegisterWritten(
                    at_s, host_s, 23, before, present.to_register(), "written and read back equal"
                )
        if k == 3300:
            yield Noted(at_s, host_s, "warning", "gap of 0.31 s in the stream")


# What is in the file.


def reader(path: Path) -> RrdReader:
    with warnings.catch_warnings():  # no footer: long recordings do without, on purpose
        warnings.simplefilter("ignore", RerunWarning)
        return RrdReader(path)


def columns(path: Path) -> dict[str, pyarrow.Table]:
    """All rows of a recording by entity, in the file's order."""
    found: dict[str, list[pyarrow.RecordBatch]] = defaultdict(list)
    for chunk in reader(path).stream():
        found[chunk.entity_path].append(chunk.to_record_batch())
    return {
        entity: pyarrow.concat_tables(
            [pyarrow.Table.from_batches([batch]) for batch in batches], promote_options="default"
        )
        for entity, batches in found.items()
    }


def values(table: pyarrow.Table, component: str) -> list:
    (name,) = [n for n in table.column_names if n.endswith(component)]
    return [row for row in table.column(name).to_pylist() if row is not None]


def seconds(table: pyarrow.Table, timeline: str) -> np.ndarray:
    whole = table.column(timeline).cast(pyarrow.int64()).to_numpy()
    return whole[~np.isnan(whole)] / 1e9 if whole.dtype.kind == "f" else whole / 1e9


def verified(path: Path) -> bool:
    """What rerun's own checker says."""
    tool = Path(rerun_cli.__file__).with_name("rerun")
    done = subprocess.run([tool, "rrd", "verify", path], check=False, capture_output=True)
    return done.returncode == 0


@pytest.fixture(scope="module")
def story(tmp_path_factory) -> dict[str, pyarrow.Table]:
    path = tmp_path_factory.mktemp("story") / "run.rrd"
    record(simulated_events(), path)
    assert verified(path)
    return columns(path)


def test_every_sample_is_in_the_file_with_three_clocks(story):
    block = simulated(90.0)
    gyro = story["/gyro_b_rad_s"]
    assert np.array_equal(np.array(values(gyro, "scalars")), block.gyro_b_rad_s)
    assert gyro.column("sample").drop_null().to_pylist() == list(range(9000))
    assert seconds(gyro, "device_time")[-1] == pytest.approx(block.time_s[-1], abs=1e-8)
    assert seconds(gyro, "host_time")[-1] == pytest.approx(block.host_s[-1], abs=1e-8)


def test_field_strength_before_and_after_the_newest_estimate(story):
    norm = np.array(values(story["/field_norm_gauss"], "scalars"))
    raw = np.linalg.norm(simulated(90.0).raw_b_gauss, axis=1)
    assert np.allclose(norm[:5000, 0], raw[:5000])
    assert np.isnan(norm[:100, 1]).all()
    assert np.std(norm[5000:, 1]) < 0.01 < 0.1 < np.std(norm[:5000, 0])


def test_points_are_thinned_to_fifty_a_second_of_device_time(story):
    points = story["/field/raw/points"]
    shown = values(points, "positions")
    assert len(shown) == 90 * 50
    sample = points.column("sample").to_numpy()
    assert set(np.diff(sample)) <= {1, 2, 3}
    assert np.allclose(np.array(shown)[:, 0], simulated(90.0).raw_b_gauss[sample], atol=1e-6)


def test_the_ellipsoid_passes_through_the_raw_points(story):
    ellipsoid = story["/field/raw/ellipsoid"]
    half = np.array(values(ellipsoid, "half_sizes")[-1][0])
    centre = np.array(values(ellipsoid, "centers")[-1][0])
    x, y, z, w = values(ellipsoid, "quaternions")[-1][0]
    q = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * (np.outer(q, q) - q @ q * np.eye(3))
    along = (simulated(90.0).raw_b_gauss - centre) @ rotation / half
    assert np.allclose(np.linalg.norm(along, axis=1), 1.0, atol=0.03)
    assert values(story["/field/corrected/sphere"], "half_sizes")[-1] == [[np.float32(0.48)] * 3]


def test_estimates_carry_their_band(story):
    lines = np.array(values(story["/estimate/hard_iron_gauss"], "scalars"))
    assert lines.shape == (90, 9)
    value, low, high = lines[:, 0::3], lines[:, 1::3], lines[:, 2::3]
    assert np.allclose(value[-1], B_GAUSS, atol=0.01)
    assert np.allclose(high - value, value - low)
    assert (high[-1] - low[-1] < (high[0] - low[0]) / 10).all()
    assert np.array(values(story["/estimate/soft_iron_minus_identity"], "scalars")).shape == (
        90,
        18,
    )
    assert values(story["/estimate/heading_sigma_deg"], "scalars")[-1][0] == pytest.approx(
        0.69, abs=0.01
    )


def test_gates_are_lanes_that_change_once_and_a_table_of_advice(story):
    assert values(story["/gate/motion"], "StateChange:state") == [["not met"], ["ok"]]
    assert values(story["/gate/field"], "StateChange:state") == [["ok"]]
    tables = [row[0] for row in values(story["/gate_table"], "text")]
    assert "**Held back by 5 of 9 gates**" in tables[0]
    assert "- **motion**: drive a full turn\n" in tables[0]
    assert "- **observability**: pitch by 30 deg *(and 1 more)*\n" in tables[0]
    assert "| **NO** | motion.turn | 8.1 deg | 280 deg |" in tables[0]
    assert "**All 9 gates ok**" in tables[-1]


def test_points_show_the_newest_estimate_before_there_is_a_proposal(tmp_path):
    (seen,) = (SamplesSeen(simulated(1.0), Affine.identity(), None),)
    estimated = Estimated(12.0, 5000.0, estimate_after(60.0, np.random.default_rng(1)))
    record([seen, estimated, seen], tmp_path / "run.rrd")
    norm = np.array(values(columns(tmp_path / "run.rrd")["/field_norm_gauss"], "scalars"))
    assert np.isnan(norm[:100, 1]).all()
    assert np.allclose(norm[100:, 1], FIELD_GAUSS, atol=0.03)


def test_states_and_register_writes_are_recorded(story):
    states = [row[0] for row in values(story["/daemon/state"], "StateChange:state")]
    assert states == ["OBSERVING", *(new for _, _, new, _ in STORY)]
    log = [row[0] for row in values(story["/log/registers"], "text")]
    assert len(log) == 1
    assert log[0].startswith("register 23: written and read back equal; before [1, 0, 0, 0, 1,")
    assert values(story["/log/notes"], "level") == [["INFO"], ["WARN"]]


def test_the_file_opens_with_its_own_layout(tmp_path):
    record([], tmp_path / "empty.rrd")
    assert len(reader(tmp_path / "empty.rrd").blueprints()) == 1


def test_unknown_clocks_are_left_out(tmp_path):
    record([Noted(math.nan, 3.0, "error", "no | text")], tmp_path / "run.rrd")
    notes = columns(tmp_path / "run.rrd")["/log/notes"]
    assert "device_time" not in notes.column_names
    assert seconds(notes, "host_time").tolist() == [3.0]


def test_unwritable_file_is_one_error_with_its_name(tmp_path):
    with pytest.raises(OSError, match=r"absent/run\.rrd.*No such file"):
        record([], tmp_path / "absent" / "run.rrd")


@pytest.mark.parametrize("seed", range(5))
def test_quaternion_of_any_rotation(seed):
    v = np.random.default_rng(seed).normal(size=3) * (0.1 if seed else 0.0)
    for angle_axis in (v, v / max(np.linalg.norm(v), 1e-9) * (math.pi - 1e-7)):
        x, y, z, w = quaternion_xyzw(exponential(angle_axis))
        half = np.linalg.norm(angle_axis) / 2
        assert abs(w) == pytest.approx(abs(math.cos(half)), abs=1e-9)
        assert np.allclose(
            np.outer([x, y, z], [x, y, z]),
            np.outer(angle_axis, angle_axis) * (math.sin(half) / max(2 * half, 1e-300)) ** 2,
            atol=1e-7,
        )


# What can go wrong with the process, its disk and its viewer.

ALL_DISK = RerunLimits(reserve_bytes=0)


def wait_for(condition: Callable[[], bool], timeout_s: float = 120.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.02)


@contextmanager
def opened(path: Path | None, **options: Any) -> Iterator[RerunSink]:
    sink = RerunSink(path, limits=options.pop("limits", ALL_DISK), **options)
    try:
        yield sink
    finally:
        sink.close(0.0)


def push_all(sink: RerunSink, events: Iterable[Event], every_s: float = 0.0) -> np.ndarray:
    """Push events as fast as they come; how long each push took, in seconds."""
    took_s = []
    for event in events:
        begin_s = time.perf_counter()
        sink.push(event, time.monotonic())
        took_s.append(time.perf_counter() - begin_s)
        if every_s:
            time.sleep(every_s)
    return np.array(took_s)


def assert_never_blocked(took_s: np.ndarray) -> None:
    """One that waits does so for good, or WAIT_S each time; a busy machine delays a few."""
    assert np.median(took_s) < 0.01
    assert took_s.max() < 60.0


def one_sample_events(count: int) -> Iterator[SamplesSeen]:
    block = simulated(10.0)
    identity = Affine.identity()
    seen = [SamplesSeen(part(block, slice(k, k + 1)), identity, identity) for k in range(1000)]
    for k in range(count):
        yield seen[k % 1000]


def test_a_closed_sink_leaves_a_complete_file(tmp_path):
    path = tmp_path / "run.rrd"
    with opened(path) as sink:
        push_all(sink, simulated_events(20.0))
        sink.close(120.0)
        assert sink.counters == SinkCounters()
    assert verified(path)
    gyro = columns(path)["/gyro_b_rad_s"]
    assert sorted(gyro.column("sample").drop_null().to_pylist()) == list(range(2000))
    sink.push(Noted(0.0, 0.0, "info", "too late"), 0.0)  # ignored, not an error


@pytest.mark.slow
def test_a_replay_that_is_faster_than_rerun_loses_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("ahrsd.viewer.sink.WAIT_S", 120.0)  # of a busy machine
    with opened(tmp_path / "run.rrd", queue_batches=4, wait=True) as sink:
        push_all(sink, one_sample_events(20_000))
        sink.close(120.0)
        assert sink.counters == SinkCounters()
    gyro = columns(tmp_path / "run.rrd")["/gyro_b_rad_s"]
    # rerun writes its chunks in the order in which it fills them: not always that of the rows
    assert sorted(gyro.column("sample").drop_null().to_pylist()) == list(range(20_000))


@pytest.mark.slow
def test_a_replay_waits_for_a_stopped_process_only_once(tmp_path, monkeypatch):
    monkeypatch.setattr("ahrsd.viewer.sink.WAIT_S", 0.3)
    with opened(tmp_path / "run.rrd", queue_batches=4, wait=True) as sink:
        wait_for((tmp_path / "run.rrd").exists)
        os.kill(sink.pid, signal.SIGSTOP)
        begin_s = time.monotonic()
        push_all(sink, one_sample_events(100_000))
        assert time.monotonic() - begin_s >= 0.3
        sink.close(0.5)
    assert sink.counters.dropped > 50_000


def test_the_daemon_never_loads_rerun(tmp_path):
    code = "import sys, ahrsd.viewer.sink; print(sorted(m for m in sys.modules if m == 'rerun'))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_nothing_is_sent_or_stored_about_the_user(tmp_path, monkeypatch):
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home))
    with opened(tmp_path / "run.rrd") as sink:
        push_all(sink, simulated_events(2.0))
        wait_for((tmp_path / "run.rrd").exists)
        remote = [c for c in psutil.Process(sink.pid).net_connections() if c.raddr]
        sink.close(120.0)
    assert remote == []
    assert list(home.rglob("*")) == []


def test_stopped_process_loses_events_and_does_not_block(tmp_path):
    with opened(tmp_path / "run.rrd") as sink:
        wait_for((tmp_path / "run.rrd").exists)
        os.kill(sink.pid, signal.SIGSTOP)
        events = list(one_sample_events(100_000))
        took_s = push_all(sink, events)
        sink.close(1.0)
    assert_never_blocked(took_s)
    assert sink.counters.dropped > 20_000
    assert "killed" in sink.counters.last_fault


@pytest.mark.slow
def test_a_process_that_reads_nothing_is_replaced(tmp_path):
    with opened(tmp_path / "run.rrd", stall_s=0.5) as sink:
        wait_for((tmp_path / "run.rrd").exists)
        stopped = sink.pid
        os.kill(stopped, signal.SIGSTOP)
        push_all(sink, one_sample_events(30_000))
        wait_for(lambda: sink.pid not in (stopped, None))
        assert "read nothing for 0.5 s" in sink.counters.last_fault
    assert not psutil.pid_exists(stopped)


def test_a_killed_process_comes_back_with_a_new_part_that_knows_the_state(tmp_path):
    first, second = tmp_path / "run.rrd", tmp_path / "run.split2.rrd"
    with opened(first) as sink:
        push_all(sink, simulated_events(20.0))
        wait_for(lambda: first.exists() and "/daemon/state" in readable(first))
        os.kill(sink.pid, signal.SIGKILL)
        wait_for(second.exists)
        push_all(sink, [Noted(50.0, 5050.0, "info", "after the crash")])
        sink.close(120.0)
        assert sink.counters.respawns == 1
        assert sink.counters.last_fault.endswith("code -9")
    again = columns(second)
    assert values(again["/log/notes"], "text") == [["after the crash"]]
    assert values(again["/daemon/state"], "StateChange:state")[-1] == ["CANDIDATE"]
    assert len(values(again["/estimate/hard_iron_gauss"], "scalars")) == 1
    assert len(columns(first)["/estimate/hard_iron_gauss"]) > 10


def readable(path: Path) -> dict[str, pyarrow.Table]:
    try:
        return columns(path)
    except (RuntimeError, ValueError):
        return {}  # being written


def test_unwritable_path_is_counted_without_further_effect(tmp_path):
    with opened(tmp_path / "absent" / "run.rrd") as sink:
        took_s = push_all(sink, simulated_events(20.0))
        wait_for(lambda: sink.counters.faults >= 1)
        assert "No such file or directory" in sink.counters.last_fault
        sink.close(10.0)
    assert_never_blocked(took_s)
    assert sink.counters.respawns == 0


@pytest.mark.slow
def test_a_disk_that_fills_up_is_counted_and_tried_again(small_disk):
    with opened(small_disk / "run.rrd") as sink:
        wait_for((small_disk / "run.rrd").exists)
        took_s = push_all(sink, one_sample_events(20_000), every_s=1e-4)
        wait_for(lambda: sink.counters.faults >= 1, timeout_s=30.0)
        wait_for(lambda: sink.counters.respawns >= 1)
        sink.close(3.0)
    assert_never_blocked(took_s)
    assert sink.counters.faults >= 1


def test_nothing_is_written_to_a_nearly_full_disk(small_disk):
    limits = RerunLimits(reserve_bytes=1 << 20)
    with opened(small_disk / "run.rrd", limits=limits) as sink:
        push_all(sink, simulated_events(5.0))
        wait_for(lambda: sink.counters.faults >= 1)
        assert "less than 1 MB free" in sink.counters.last_fault
    assert list(small_disk.iterdir()) == []


@pytest.mark.slow
def test_parts_change_at_their_size_and_the_oldest_go(tmp_path):
    limits = RerunLimits(part_bytes=200_000, quota_bytes=600_000, reserve_bytes=0)
    path = tmp_path / "run.rrd"
    with opened(path, limits=limits) as sink:
        events = simulated_events(90.0)
        for number in (2, 3, 4):
            push_all(sink, islice(events, 250))
            wait_for(part_name(path, number).exists)
        sink.close(120.0)
        assert sink.counters == SinkCounters()
    left = sorted(tmp_path.glob("*.rrd"))
    assert path not in left
    assert part_name(path, 4) in left
    assert [verified(part) for part in left] == [True] * len(left)


def test_a_port_in_use_is_counted_and_the_file_still_written(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with opened(tmp_path / "run.rrd", serve=True, port=taken.getsockname()[1]) as sink:
            push_all(sink, simulated_events(5.0))
            wait_for(lambda: sink.counters.faults >= 1)
            assert sink.counters.last_fault.startswith("server: ")
            sink.close(120.0)
    assert len(values(columns(tmp_path / "run.rrd")["/gyro_b_rad_s"], "scalars")) == 500


def test_the_live_viewer_is_served_on_this_machine_only():
    port = free_port()
    with opened(None, serve=True, port=port) as sink:
        push_all(sink, simulated_events(5.0))

        def listening() -> list[str]:
            all_of_it = psutil.Process(sink.pid).net_connections(kind="inet")
            return [c.laddr.ip for c in all_of_it if c.laddr.port == port and not c.raddr]

        wait_for(lambda: bool(listening()))
        assert listening() == ["127.0.0.1"]
        sink.close(5.0)
        assert sink.counters == SinkCounters()


def test_next_part_never_has_an_existing_name(tmp_path):
    path = tmp_path / "run.rrd"
    assert free_part(path) == path
    for name in ("run.rrd", "run.split2.rrd", "run.split7.rrd", "run.splitx.rrd", "other.rrd"):
        (tmp_path / name).write_bytes(b"x")
    assert free_part(path) == tmp_path / "run.split8.rrd"


def test_settings_survive_the_command_line():
    settings = ProcessSettings("a b.rrd", True, 9876, "id", RerunLimits(part_s=2.5), fresh=False)
    assert ProcessSettings.from_json(settings.to_json()) == settings
