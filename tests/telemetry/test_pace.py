"""The countdown: linear for growing quantities, exponential for falling ones, and no guess
otherwise.
"""

import math

import pytest
from shown_status import cells, gate, level_ring, motion

from ahrsd.telemetry.driving import LEVEL, TILTED, Pace, about, left_s


@pytest.mark.parametrize(
    ("span_s", "first", "last", "goal", "expected"),
    [
        (60.0, 100.0, 200.0, 300.0, 60.0),  # 100 deg a minute, 100 to go
        (60.0, 8.0, 4.0, 1.0, 120.0),  # halves in a minute, two halvings to go
        (60.0, 100.0, 100.0, 300.0, None),  # stands still
        (60.0, 200.0, 100.0, 300.0, None),  # goes away
        (60.0, 4.0, 8.0, 1.0, None),
        (10.0, 100.0, 200.0, 300.0, None),  # too short to know a rate
        (60.0, 100.0, 100.1, 300.0, None),  # longer than an hour
        (60.0, 4.0, 3.0, 0.0, None),  # a share of it never comes to nothing
        (60.0, 100.0, 300.0, 300.0, 0.0),
    ],
)
def test_remaining_time_at_the_present_rate(span_s, first, last, goal, expected):
    assert left_s(span_s, first, last, goal) == (
        None if expected is None else pytest.approx(expected)
    )


ALL = ["motion.heading", "observability.heading_sigma"]


def status(at_s, *gates, directions=""):
    return {"at_s": at_s, "gates": list(gates), "motion": motion(directions)}


def test_gates_have_a_remaining_time_until_they_open():
    pace = Pace()
    for at_s in range(0, 61, 10):
        coverage = gate("motion.heading", 100.0 + at_s, 200.0)
        sigma = gate("observability.heading_sigma", 8.0 * 0.5 ** (at_s / 60.0), 1.0)
        pace.take(status(float(at_s), coverage, sigma))
    assert pace.left_s("motion.heading") == pytest.approx(40.0)
    assert pace.left_s("observability.heading_sigma") == pytest.approx(120.0)
    assert pace.slowest(ALL) == ("observability.heading_sigma", pytest.approx(120.0))
    pace.take(status(61.0, gate("motion.heading", 161.0, 200.0)))
    assert pace.slowest(ALL) == ("motion.heading", pytest.approx(39.0))
    assert pace.left_s("observability.heading_sigma") is None


def test_no_total_time_when_one_gate_makes_no_progress():
    pace = Pace()
    for at_s in (0.0, 30.0, 60.0):
        pace.take(status(at_s, gate("a.moves", at_s, 100.0), gate("a.stands", 1.0, 2.0)))
    assert pace.left_s("a.moves") == pytest.approx(40.0)
    assert pace.slowest(["a.moves", "a.stands"]) is None
    assert pace.standing(["a.moves", "a.stands", "not.measured"]) == ["a.stands"]
    assert pace.slowest(["a.moves", "not.measured"]) == ("a.moves", pytest.approx(40.0))
    assert pace.slowest([]) is None


def test_count_of_unmeasured_gates_is_ignored():
    pace = Pace()
    for at_s in (0.0, 60.0):
        pace.take(status(at_s, gate("a.moves", at_s, 100.0), gate("evidence.complete", 7.0, 0.0)))
    both = ["a.moves", "evidence.complete"]
    assert pace.slowest(both) == ("a.moves", pytest.approx(40.0))
    assert pace.standing(both) == []


def test_rates_are_reset_after_a_restart():
    pace = Pace()
    for at_s in (500.0, 560.0, 3.0):
        pace.take(status(at_s, gate("motion.heading", 100.0 + at_s / 10, 200.0)))
    assert pace.left_s("motion.heading") is None


def test_rate_is_that_of_the_newest_minutes():
    pace = Pace()
    for at_s in range(0, 601, 10):
        value = 0.2 * at_s if at_s <= 300 else 60.0
        pace.take(status(float(at_s), gate("motion.heading", value, 200.0)))
    assert pace.left_s("motion.heading") is None  # nothing new for five minutes


def test_covered_directions_have_a_remaining_time():
    pace = Pace()
    for at_s in (0.0, 30.0, 60.0):
        ring = cells(lambda f, a, at_s=at_s: level_ring(f, a) and a < 3.0 * at_s)
        pace.take(status(at_s, directions=ring))
    assert pace.left_s(LEVEL) == pytest.approx(60.0, rel=0.15)  # half the circle in a minute
    assert pace.left_s(TILTED) is None


def test_remaining_time_is_rounded_coarsely():
    assert about(3.0) == "about 10 s at the present rate"
    assert about(41.0) == "about 50 s at the present rate"
    assert about(65.0) == "about 1 min at the present rate"
    assert about(250.0) == "about 4 min at the present rate"
    assert about(None) == "not at the present rate"


def held_out(at_s, turning_deg_s, windows=0.0):
    body = status(at_s, gate("heldout_heading.windows", windows, 2.0))
    rate = [0.0, 0.0, math.radians(turning_deg_s)]
    return body | {"readings": {"gyro_b_rad_s": rate}}


def test_held_out_segments_are_expected_every_two_minutes_of_turning():
    turning, resting = Pace(), Pace()
    for at_s in (0.0, 10.0):
        turning.take(held_out(at_s, 12.0))
        resting.take(held_out(at_s, 0.5))
    assert turning.left_s("heldout_heading.windows") == 240.0
    assert resting.left_s("heldout_heading.windows") is None
    turning.take(held_out(20.0, 12.0, windows=1.0))
    assert turning.left_s("heldout_heading.windows") == 20.0  # it came 20 s after the first look
