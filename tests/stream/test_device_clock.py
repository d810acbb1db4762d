"""Device clock, step clock and timeline: known truth in, known figures out."""

import numpy as np
import pytest

from ahrsd.samples import Array
from ahrsd.stream.device_clock import HULL_POINTS, DeviceClock, StepClock, StreamTimeline


def arrivals(
    device_s: Array,
    rate: float = 1.0,
    offset_s: float = 1000.0,
    burst_s: float = 0.0,
    seed: int = 1,
) -> Array:
    """Host arrival times: the true line, at least 1 ms of delay, bursts of a latency timer."""
    delay_s = 1e-3 + np.random.default_rng(seed).exponential(5e-4, len(device_s))
    host_s = offset_s + rate * device_s + delay_s
    if burst_s:
        host_s = np.ceil(host_s / burst_s) * burst_s
    return host_s


def even(count: int, step_s: float, start_s: float = 0.0) -> Array:
    return np.asarray(start_s + np.arange(count) * step_s, dtype=np.float64)


def fed(device_s: Array, host_s: Array) -> DeviceClock:
    clock = DeviceClock()
    for d, h in zip(device_s.tolist(), host_s.tolist(), strict=True):
        clock.update(d, h)
    return clock


def rate_ppm(clock: DeviceClock) -> float:
    """By how much the device's clock runs faster than the host's."""
    start_s, end_s = clock.to_host(np.array([0.0, 1000.0]))
    return float(1000.0 / (end_s - start_s) - 1.0) * 1e6


def test_nothing_known_before_the_first_arrival() -> None:
    clock = DeviceClock()
    assert not clock.known
    assert np.isnan(clock.to_host(np.array([1.0, 2.0]))).all()
    assert clock.update(5.0, 100.0)
    assert clock.to_host(np.array([5.0, 6.5])).tolist() == [100.0, 101.5]


@pytest.mark.parametrize(
    "ppm",
    [
        -50.0,
        pytest.param(0.0, marks=pytest.mark.slow),
        10.0,
        pytest.param(50.0, marks=pytest.mark.slow),
    ],
)
def test_drift_is_found_through_latency_bursts(ppm: float) -> None:
    device_s = np.arange(0.0, 600.0, 0.005)
    rate = 1.0 / (1.0 + ppm * 1e-6)
    host_s = arrivals(device_s, rate, burst_s=0.016)
    clock = fed(device_s, host_s)
    assert rate_ppm(clock) == pytest.approx(ppm, abs=3.0)
    error_s = clock.to_host(device_s) - (1000.0 + rate * device_s)
    assert np.all(error_s > 0.0)
    assert np.max(np.abs(error_s)) < 3e-3  # a burst's mean delay is 8 ms
    assert clock.jumps == 0
    assert 0.006 < np.mean(host_s - clock.to_host(device_s)) < 0.010


def test_short_run_keeps_the_nominal_rate() -> None:
    device_s = np.arange(0.0, 5.0, 0.025)
    clock = fed(device_s, arrivals(device_s, burst_s=0.016))
    assert rate_ppm(clock) == 0.0
    assert np.max(np.abs(clock.to_host(device_s) - 1000.0 - device_s)) < 5e-3


@pytest.mark.parametrize("speed", [5.0, 30.0])
def test_accelerated_run(speed: float) -> None:
    device_s = np.arange(0.0, 300.0, 0.005)
    clock = fed(device_s, arrivals(device_s, 1.0 / speed))
    error_s = clock.to_host(device_s) - (1000.0 + device_s / speed)
    assert np.max(np.abs(error_s)) < 3e-3
    assert clock.jumps == 0


def test_device_restart_starts_a_new_clock_line() -> None:
    device_s = np.concatenate([np.arange(100.0, 130.0, 0.01), np.arange(1.5, 30.0, 0.01)])
    host_s = arrivals(even(len(device_s), 0.01))
    clock = fed(device_s, host_s)
    assert clock.restarts == 1
    assert clock.jumps == 0
    assert clock.host_s(device_s[-1]) == pytest.approx(host_s[-1], abs=5e-3)


@pytest.mark.parametrize("leap_s", [-3600.0, -2.0, 2.0, 3600.0])
def test_host_jump_is_noticed_and_followed(leap_s: float) -> None:
    device_s = np.arange(0.0, 120.0, 0.02)
    host_s = arrivals(device_s)
    host_s[3000:] += leap_s
    clock = fed(device_s, host_s)
    assert clock.jumps == 1
    truth_s = 1000.0 + device_s[-1] + leap_s
    assert clock.host_s(device_s[-1]) == pytest.approx(truth_s, abs=5e-3)


def test_stall_of_the_host_is_not_a_clock_jump() -> None:
    device_s = np.arange(0.0, 60.0, 0.02)
    host_s = arrivals(device_s)
    host_s[1500:1560] = host_s[1560]  # 1.2 s of samples arrive at once
    clock = fed(device_s, host_s)
    assert clock.jumps == 0
    assert np.max(np.abs(clock.to_host(device_s) - 1000.0 - device_s)) < 5e-3


def test_non_finite_and_repeated_times_are_ignored() -> None:
    clock = DeviceClock()
    clock.update(1.0, 11.0)
    for device_s, host_s in [(float("nan"), 12.0), (2.0, float("inf")), (1.0, 30.0), (0.9, 31.0)]:
        assert not clock.update(device_s, host_s)
    assert clock.host_s(1.0) == 11.0


def test_memory_is_bounded_when_every_point_is_on_the_hull() -> None:
    device_s = np.arange(0.0, 900.0, 0.05)
    clock = fed(device_s, 1000.0 + device_s + 1e-9 * device_s**2)  # convex: each point on the hull
    assert len(clock._hull) <= HULL_POINTS


def test_step_clock_counts_lost_messages_and_does_not_drift() -> None:
    clock = StepClock(40.0)
    assert clock.times(np.array([0, 0, 2, 0])).tolist() == [0.0, 0.025, 0.1, 0.125]
    assert clock.times(np.array([1])).tolist() == pytest.approx([0.175])
    many = StepClock(30.0).times(np.zeros(300_001))
    assert many[-1] == pytest.approx(10_000.0, abs=1e-9)
    with pytest.raises(ValueError, match="rate must be positive"):
        StepClock(0.0)


def test_timeline_of_an_even_stream() -> None:
    timeline = StreamTimeline()
    one = timeline.extend(even(10, 0.01))
    two = timeline.extend(even(5, 0.01, 0.1))
    assert one.first.tolist() == [True] + [False] * 9
    assert np.isnan(one.dt_s[0])
    assert one.dt_s[1:] == pytest.approx(0.01)
    assert two.dt_s == pytest.approx(0.01)
    assert not two.first.any()
    assert timeline.period_s == pytest.approx(0.01)


def test_gap_is_recorded_and_never_bridged() -> None:
    time_s = np.concatenate([even(50, 0.01), even(50, 0.01, 2.0)])
    for cut in (10, 50, 51, 90):
        timeline = StreamTimeline()
        parts = [timeline.extend(time_s[:cut]), timeline.extend(time_s[cut:])]
        dt_s = np.concatenate([part.dt_s for part in parts])
        first = np.concatenate([part.first for part in parts])
        gaps = [gap for part in parts for gap in part.gaps]
        assert np.flatnonzero(first).tolist() == [0, 50]
        assert np.flatnonzero(np.isnan(dt_s)).tolist() == [0, 50]
        assert [(gap.at_s, gap.length_s) for gap in gaps] == [pytest.approx((0.49, 1.51))]


def test_duplicates_are_dropped_and_a_backward_step_starts_a_new_run() -> None:
    steps = StreamTimeline().extend(np.array([1.0, 1.1, 1.1, 1.2, 0.1, 0.2]))
    assert steps.keep.tolist() == [True, True, False, True, True, True]
    assert steps.first.tolist() == [True, False, False, False, True, False]
    assert steps.restarts == 1
    assert steps.gaps == ()
    assert steps.dt_s[[1, 3, 5]] == pytest.approx(0.1)


def test_unusable_samples_leave_a_gap() -> None:
    usable = np.array([True, True, True, False, True, True])
    steps = StreamTimeline().extend(even(6, 0.1), usable)
    assert steps.keep.tolist() == usable.tolist()
    assert steps.first.tolist() == [True, False, False, False, True, False]
    assert [(gap.at_s, gap.length_s) for gap in steps.gaps] == [pytest.approx((0.2, 0.2))]


def test_timeline_follows_a_changed_rate() -> None:
    timeline = StreamTimeline()
    timeline.extend(even(400, 0.005))
    slow = timeline.extend(even(400, 0.025, 2.0))
    assert not slow.first[200:].any()
    assert timeline.period_s == pytest.approx(0.025)


def test_no_step_is_ever_negative_or_long() -> None:
    rng = np.random.default_rng(7)
    timeline = StreamTimeline(0.01)
    for _ in range(200):
        time_s = np.cumsum(
            rng.choice([0.01, 0.0, 0.5, -3.0, np.nan], 50, p=[0.9, 0.03, 0.03, 0.03, 0.01])
        )
        dt_s = timeline.extend(time_s).dt_s
        steps_s = dt_s[np.isfinite(dt_s)]
        assert np.all((steps_s > 0.0) & (steps_s < 0.02))
