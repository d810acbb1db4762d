"""Driving advice: the circle first, then the tilt that shows most of the missing directions."""

import numpy as np
import pytest
from shown_status import cell_of, cells, gate, level_ring, motion

from ahrsd.evidence.coverage import cell_centres
from ahrsd.gates import GATES
from ahrsd.telemetry.driving import HELPED_BY_TILT, drive_next, shown_of, tilt_is_wanted

SHUT = [gate("observability.score")]


def status(directions, gates=SHUT, heading_deg=None, **changes):
    return {
        "motion": motion(directions, **changes),
        "gates": gates,
        "readings": {"heading_deg": heading_deg},
    }


def all_but(wanted):
    """Everything was shown except the cells of these attitudes and their neighbours."""
    middle = cell_centres()
    hidden = np.zeros(len(middle), dtype=bool)
    for attitude in wanted:
        hidden |= middle @ middle[cell_of(*attitude)] > np.cos(np.radians(8.0))
    return "".join("0" if one else "1" for one in hidden)


def test_level_circle_covers_the_ring_and_no_tilt():
    shown = shown_of(status(cells(level_ring)))
    assert shown.level_share == 1.0
    assert shown.tilted_share == 0.0
    assert shown.level[cell_of(77.0)]
    assert shown.tilted[cell_of(77.0, roll_deg=20.0)] or shown.level[cell_of(77.0, roll_deg=20.0)]
    half = shown_of(status(cells(lambda f, a: level_ring(f, a) and a < 180.0)))
    assert half.level_share == pytest.approx(0.5, abs=0.06)


def test_no_advice_without_the_necessary_data():
    assert shown_of({"motion": None}) is None
    assert shown_of(status("")) is None
    assert shown_of(status(cells(level_ring), dip_deg=None)) is None
    assert shown_of(status(cells(level_ring), down_b=[None, None, None])) is None
    assert shown_of({"motion": {"heading_deg": 10.0}}) is None  # an older daemon


def test_inverted_sensor_covers_the_same_share():
    upright = status(cells(lambda f, a: level_ring(f, a) and a < 180.0))
    turned = cells(lambda f, a: level_ring(180.0 - f, a) and a < 180.0)
    hanging = status(turned, down_b=[0.0, 0.0, -1.0])
    assert shown_of(hanging).level_share == shown_of(upright).level_share


@pytest.mark.parametrize(
    ("attitude", "words"),
    [
        ((0.0, 0.0, -25.0), "face north and nose down by up to 30 deg, if the vehicle can"),
        ((0.0, 0.0, 15.0), "face north and nose up by up to 30 deg, if the vehicle can"),
        ((90.0, -25.0, 0.0), "face east and roll to the left by up to 30 deg, if the vehicle can"),
        ((90.0, 15.0, 0.0), "face east and roll to the right by up to 30 deg, if the vehicle can"),
        ((180.0, 0.0, 25.0), "face south and nose up by up to 30 deg, if the vehicle can"),
        ((270.0, 25.0, 0.0), "face west and roll to the right by up to 30 deg, if the vehicle can"),
        ((270.0, -15.0, 0.0), "face west and roll to the left by up to 30 deg, if the vehicle can"),
    ],
)
def test_missing_attitude_is_advised(attitude, words):
    """The text is compared with the direction of the field in that attitude."""
    assert drive_next(status(all_but([attitude]))) == words


@pytest.mark.parametrize(
    ("attitude", "words"),
    [
        ((0.0, 0.0, -15.0), "face north and nose down"),
        ((90.0, 25.0, 0.0), "face east and roll to the right"),
        ((270.0, 15.0, 0.0), "face west and roll to the right"),
    ],
)
def test_advice_on_the_southern_hemisphere(attitude, words):
    south = status(all_but([(*attitude, -60.0)]), dip_deg=-60.0)
    assert drive_next(south).startswith(words)
    assert shown_of(south).ring_deg == 150.0


def test_advised_turn_is_relative_to_the_present_heading():
    missing = all_but([(90.0, -25.0, 0.0)])
    assert drive_next(status(missing, heading_deg=10.0)) == (
        "face east (80 deg to the right) and roll to the left by up to 30 deg, if the vehicle can"
    )
    body = status(missing, heading_deg=10.0)
    body["readings"]["heading_would_be_deg"] = 40.0  # the better one
    assert "east (50 deg to the right)" in drive_next(body)
    assert "east (140 deg to the left)" in drive_next(status(missing, heading_deg=230.0))
    assert "east (as now)" in drive_next(status(missing, heading_deg=100.0))


def test_circle_is_advised_first_and_tilt_only_for_a_gate():
    ring = cells(level_ring)
    assert drive_next(status(ring, next_="turn left about 120 deg more")) == (
        "turn left about 120 deg more"
    )
    assert drive_next(status(ring)).startswith("face ")
    assert drive_next(status(ring, gates=[gate("heldout_heading.rms")])) == ""
    assert drive_next(status(ring, gates=[gate("observability.score", ok=True)])) == ""
    assert drive_next(status("1" * len(ring))) == ""
    assert drive_next({"motion": None}).startswith("drive two full circles")


def test_gates_helped_by_tilt_are_those_whose_advice_mentions_it():
    tilt = ("{e.motion.more_tilt}", "{e.would_tell}")
    advised = {g.gate for g in GATES if any(words in g.advice for words in tilt)}
    assert advised == HELPED_BY_TILT
    assert all(tilt_is_wanted({"gates": [gate(name)]}) for name in advised)
