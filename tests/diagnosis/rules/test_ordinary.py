"""What is left is ordinary, beyond that, or of a recording to which the sizes do not apply."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student

from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding, Unexplained, Where
from ahrsd.diagnosis.answer.ordinary_text import in_one_sentence, ordinary_left, size_lines
from ahrsd.diagnosis.answer.spoken import lines, verdict
from ahrsd.diagnosis.rules.ordinary import (
    COMPONENTS,
    FREEDOM,
    Row,
    Table,
    beyond_ordinary,
    held_against,
    is_course_on_sensor,
    spread_of,
    table_of,
)
from ahrsd.diagnosis.rules.remainder_sizes import Left, Size
from ahrsd.report.diagnosis_page import write_diagnosis_report

#: of twenty recordings, none of which has a course on the sensor
TABLE = Table(
    recordings=20,
    components={
        "sensor_course": Row(0.0, 0.5, 0, 20),
        "by_attitude": Row(8e-3, 0.5, 20, 20),
        "world": Row(10e-3, 0.5, 10, 20),
        "gyro_course": Row(4e-3, 0.5, 5, 20),
        "by_rate": Row(20e-3, 0.5, 10, 20),
    },
    field=Row(14e-3, 0.5, 20, 20),
    heading=Row(2.2, 0.5, 20, 20),
    gyro=Row(20e-3, 0.5, 20, 20),
    beside=Row(5e-3, 0.5, 20, 20),
)


def left(beside: float = 4e-3, **sizes: float) -> Left:
    """What is left of these components, gauss and rad/s, each surely there."""
    field = float(np.hypot(sizes.get("by_attitude", 0.0), sizes.get("world", 0.0)))
    parts = tuple(
        Size(name, sizes.get(name, 0.0), None if "gyro" in COMPONENTS[name] else 100.0 * size,
             100.0 if size else 0.0)
        for name in COMPONENTS
        for size in (sizes.get(name, 0.0),)
    )  # fmt: skip
    return Left(parts, field, 100.0 * field, sizes.get("by_rate", 0.0), beside)


def found(one: Left, *findings: Finding) -> Diagnosis:
    """A diagnosis that leaves this in the world."""
    unknown = Unexplained(
        detected=True,
        where=Where(((0.0, 100.0),), ("x", "y"), "world"),
        size=0.03,
        unit="gauss",
        evidence_nats=120.0,
        ordinary=held_against(one, TABLE),
    )
    return Diagnosis("walk.csv", None, True, 1e-20, findings, unknown, {})


def test_a_limit_is_what_the_next_recording_stays_below():
    everywhere = Row(8e-3, 0.5, 20, 20)
    factor = np.exp(0.5 * np.sqrt(1 + 1 / 20) * student.ppf(0.95, FREEDOM))
    assert everywhere.up_to() == pytest.approx(8e-3 * factor)
    assert everywhere.from_on() == pytest.approx(8e-3 / factor)
    half = Row(8e-3, 0.5, 10, 20)  # of those that have it one in ten may be beyond
    less = np.exp(0.5 * np.sqrt(1 + 1 / 10) * student.ppf(0.90, FREEDOM))
    assert half.up_to() == pytest.approx(8e-3 * less)
    assert Row(8e-3, 0.5, 2, 20).up_to() == 0.0  # next to none has any: to have some is beyond
    assert Row(8e-3, 0.5, 3, 20).up_to() > 8e-3
    assert Row(0.0, 0.5, 0, 20).up_to() == 0.0


def test_fewer_recordings_make_a_limit_wider():
    assert Row(8e-3, 0.5, 3, 3).up_to() > Row(8e-3, 0.5, 20, 20).up_to()


def test_the_spread_is_that_of_the_recordings_and_one_that_is_far_off_hardly_moves_it():
    rng = np.random.default_rng(5)
    rows = [np.exp(np.log(m) + 0.6 * rng.standard_t(FREEDOM, 400)) for m in (2e-3, 8e-3)]
    assert spread_of(rows) == pytest.approx(0.6, rel=0.1)
    few = np.exp(np.log(5e-3) + np.linspace(-1.0, 1.0, 15))
    assert spread_of([[*few, 5.0]]) < 1.35 * spread_of([few])


def test_the_table_of_some_recordings():
    made = table_of(
        [
            left(2e-3, by_attitude=5e-3, world=9e-3),
            left(4e-3, by_attitude=8e-3, by_rate=20e-3),
            left(8e-3, by_attitude=20e-3, world=18e-3),
        ]
    )
    assert made.recordings == 3
    assert (made.components["by_attitude"].median, made.components["by_attitude"].seen) == (8e-3, 3)
    assert made.components["world"].median == pytest.approx(13.5e-3)
    assert (made.components["world"].seen, made.components["world"].asked) == (2, 3)
    assert made.components["sensor_course"].seen == 0
    assert made.beside.median == 4e-3


def test_a_component_that_is_hardly_known_counts_for_nothing():
    weak = left(by_attitude=9e-3)
    weak = replace(weak, sizes=tuple(replace(one, evidence_nats=11.0) for one in weak.sizes))
    assert table_of([weak]).components["by_attitude"].seen == 0
    huge = replace(weak, sizes=tuple(replace(one, size=1.0) for one in weak.sizes))
    assert held_against(huge, TABLE).within


def test_as_much_as_others_leave_is_ordinary_and_four_times_as_much_is_not():
    sizes = {"by_attitude": 12e-3, "world": 15e-3, "by_rate": 15e-3}
    one = held_against(left(**sizes), TABLE)
    assert one.within
    assert one.why is None
    assert one.field_gauss == pytest.approx(np.hypot(12e-3, 15e-3))
    assert one.recordings == 20
    four = held_against(left(16e-3, **{name: 4 * size for name, size in sizes.items()}), TABLE)
    assert not four.within
    assert four.why.startswith("beyond the ordinary: a field by attitude, 48 mG where up to ")


def test_a_course_on_the_sensor_is_beyond_where_no_recording_has_one():
    one = held_against(left(by_attitude=8e-3, sensor_course=2e-3), TABLE)
    assert not one.within
    assert "a course in time on the sensor, 2 mG where none is ordinary" in one.why


def test_of_a_clean_world_nothing_is_ordinary_however_small():
    one = held_against(left(0.1e-3, world=2e-3), TABLE)
    assert not one.within
    assert one.why.startswith("cleaner than the real recordings")
    assert "it leaves 0.1 mG" in one.why


def test_what_changes_with_time_on_the_sensor_is_never_ordinary():
    small = left(by_attitude=8e-3, world=10e-3)
    assert held_against(small, TABLE).within
    one = held_against(small, TABLE, on_sensor=True)
    assert not one.within
    assert one.why == (
        "beyond the ordinary: it changes with time on the sensor, as an unlogged current does"
    )


@pytest.mark.parametrize(
    ("frame", "course", "on_sensor"),
    [
        ("sensor", ((0.0, 1e-3), (1.0, -1e-3)), True),
        ("world", ((0.0, 1e-3), (1.0, -1e-3)), False),
        ("sensor", (), False),  # of a condition, not of a time
    ],
)
def test_a_course_on_the_sensor(frame, course, on_sensor):
    one = Unexplained(True, Where(((0.0, 9.0),), ("x",), frame), course=course)
    assert is_course_on_sensor(one) is on_sensor


def test_what_is_ordinary_is_no_mismatch_and_is_not_silent():
    before = found(left(by_attitude=8e-3, world=10e-3))
    after = beyond_ordinary(before)
    assert (after.mismatch, after.unexplained.detected) == (False, False)
    assert after.p_value == before.p_value  # that something is there is as sure as before
    told = after.to_json()["unexplained"]
    assert told["where"]["frame"] == "world"
    assert told["evidence_nats"] == 120.0
    assert told["ordinary"]["within"] is True
    assert told["ordinary"]["field_gauss"] == pytest.approx(np.hypot(8e-3, 10e-3))
    assert [part["component"] for part in told["ordinary"]["components"]] == list(COMPONENTS)
    said = verdict(after)
    assert "agree" not in said
    assert said.startswith(
        "nothing beyond the ordinary: what is left is ordinary for a real recording: 13 mG, "
        "1.3 deg of heading (95 % of such recordings leave up to "
    )
    assert said.endswith("it is there (p = 1e-20 that nothing is)")
    assert "left, and ordinary:" in lines(after)
    assert "not in the library:" not in lines(after)


def test_a_name_beside_what_is_ordinary_is_a_mismatch():
    lag = Finding(
        "mag_time_lag", 0.99, (), Where((), (), "link"), (), None, None, None, words="it is late"
    )
    after = beyond_ordinary(found(left(by_attitude=8e-3, world=10e-3), lag))
    assert after.mismatch
    assert not after.unexplained.detected
    assert verdict(after).startswith(
        "MISMATCH: 1 effect left out (p = 1e-20); what else is left is"
    )
    assert ordinary_left(after) is after.unexplained.ordinary


def test_what_is_beyond_stays_unknown_and_says_by_how_much():
    before = found(left(by_attitude=80e-3, world=10e-3))
    after = beyond_ordinary(before)
    assert after is before
    assert ordinary_left(after) is None
    said = "\n".join(lines(after))
    assert "something that the library has no name for" in said
    assert "part       a field by attitude: 80 mG, 8 deg of heading, 100 nats" in said
    assert "yardstick  beyond the ordinary: a field by attitude, 80 mG where up to" in said


def test_the_page_says_which_of_both_it_is(tmp_path):
    page = tmp_path / "report.html"
    before = found(left(by_attitude=8e-3, world=10e-3))
    write_diagnosis_report(page, beyond_ordinary(before), "ahrsd diagnose walk.csv")
    said = page.read_text(encoding="utf-8")
    assert "Left, and ordinary" in said
    assert "13 mG, 1.3 deg of heading" in said
    assert "a field by attitude: 8 mG, 0.8 deg of heading, 100 nats (ordinary: up to " in said
    assert "Unknown, here" not in said
    beyond = found(left(by_attitude=80e-3, world=10e-3))
    write_diagnosis_report(page, beyond_ordinary(beyond), "ahrsd diagnose walk.csv")
    said = page.read_text(encoding="utf-8")
    assert "Unknown, here" in said
    assert "beyond the ordinary: a field by attitude, 80 mG where up to " in said
    assert "Left, and ordinary" not in said


def test_nothing_is_ordinary_in_a_recording_that_is_known_to_be_simulated():
    before = found(left(by_attitude=8e-3, world=10e-3))
    after = beyond_ordinary(before, simulated=True)
    assert after.mismatch
    assert after.unexplained.detected
    assert not after.unexplained.ordinary.within
    assert "yardstick  a simulated recording" in "\n".join(lines(after))


def test_an_unknown_without_a_yardstick_stays_one():
    hum = replace(found(left()), unexplained=Unexplained(True, Where((), ("x",), "sensor")))
    assert beyond_ordinary(hum) is hum


def test_what_no_component_holds_is_told_as_a_whole():
    one = held_against(replace(left(), field_gauss=3e-3, heading_deg=0.4), TABLE)
    assert size_lines(one) == ["3 mG, 0.4 deg of heading, of no one component"]
    assert "3 mG, 0.4 deg of heading" in in_one_sentence(one)
