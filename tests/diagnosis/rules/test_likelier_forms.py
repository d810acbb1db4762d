"""Names amid a rest are held once more against free forms, the rest's own course among them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import likelier_forms, unknown
from ahrsd.diagnosis.rules.beside import material
from ahrsd.diagnosis.rules.likelier_forms import without_likelier_forms
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, Survey, formed_basis_of, refitted, survey
from ahrsd.diagnosis.track import Spec, Track

TEMPERATURE = "mag_bias_temperature"
DIRECTION = np.array([0.6, -0.3, 0.74])


@pytest.fixture(scope="module")
def track() -> Track:
    return made(Trial(seed=11, samples=6000, rate_hz=25.0, scenario="wam", noise="white")).track


def named(track: Track, name: str) -> tuple[State, list[Survey], unknown.Remainder]:
    """A state that has this name for what is in the recording, its survey, and what is left."""
    problem, cold = problem_of(track, Spec(), {name: EFFECTS[name]}, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    seen = survey(start)
    state = refitted(start, (seen.judged[0],))
    assert state.names == (name,)
    return state, [seen], unknown.remainder(formed_basis_of(state))


def with_field(track: Track, course: np.ndarray, gauss: float) -> Track:
    return replace(track, mag_b_gauss=track.mag_b_gauss + gauss * course[:, None] * DIRECTION)


def swung(track: Track, temperature_c: np.ndarray) -> Track:
    return replace(track, covariates={"temperature_c": temperature_c})


@pytest.fixture(scope="module")
def bumped(track: Track) -> tuple[State, list[Survey], unknown.Remainder]:
    """A jump of the field for what is a bump of the gyro."""
    phase = np.clip((track.time_s - 120.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * phase)[:, None] ** 2 * np.array([8e-4, -6e-4, 9e-4])
    gyro = track.gyro_b_rad_s + bump
    return named(replace(track, gyro_b_rad_s=gyro, covariates={}), "field_step")


def test_a_jump_of_the_field_that_is_half_a_bump_of_the_gyro(bumped) -> None:
    state, surveys, left = bumped
    assert unknown.detected(left, LIMITS)
    after, seen, rest = without_likelier_forms(state, surveys, left)
    assert (after.names, seen) == ((), [])
    assert unknown.detected(rest, LIMITS)
    assert rest.strongest.frame == "gyro"


def test_a_logged_cause_that_resembles_an_unlogged_one_a_little(track: Track) -> None:
    """The course of the source is likelier than what it has in common with the temperature."""
    time_s = track.time_s - track.time_s[0]
    source = np.sign(np.sin(2 * np.pi * time_s / 75.0)) + 1.2 * np.sin(2 * np.pi * time_s / 113.0)
    alike = 20.0 + 3.0 * np.sin(2 * np.pi * time_s / 113.0)
    alike += 1.5 * np.sin(2 * np.pi * time_s / 31.0)
    state, surveys, left = named(swung(with_field(track, source, 1.5e-3), alike), TEMPERATURE)
    assert unknown.detected(left, LIMITS)
    after, _, rest = without_likelier_forms(state, surveys, left)
    assert after.names == ()
    assert unknown.detected(rest, LIMITS)
    assert rest.strongest.frame == "sensor"


def test_a_true_cause_stays_amid_an_unlogged_one(track: Track) -> None:
    time_s = track.time_s - track.time_s[0]
    warm = 20.0 + 5.0 * np.sin(2 * np.pi * time_s / 113.0)
    source = np.where((time_s > 60.0) & (time_s < 95.0), 1.0, 0.0)
    both = with_field(with_field(track, (warm - 20.0) / 5.0, 3e-3), source, 1.0e-3)
    state, surveys, left = named(swung(both, warm), TEMPERATURE)
    assert unknown.detected(left, LIMITS)
    after, seen, _ = without_likelier_forms(state, surveys, left)
    assert after is state
    assert seen is surveys


def test_where_nothing_is_left_nothing_is_asked(track: Track, monkeypatch) -> None:
    monkeypatch.setattr(likelier_forms, "wrong_in_form", None)
    warm = 20.0 + 5.0 * np.sin(2 * np.pi * (track.time_s - track.time_s[0]) / 113.0)
    given = named(swung(with_field(track, (warm - 20.0) / 5.0, 3e-3), warm), TEMPERATURE)
    assert not unknown.detected(given[2], LIMITS)
    assert without_likelier_forms(*given) == given


def test_only_what_every_sensor_has_of_itself_has_a_bar() -> None:
    """A delay has been taken out of the track: its term is next to nothing, and it stays."""
    delay, mount, scale = (
        Candidate(EFFECTS[name], {}, 1, 0.0)
        for name in ("mag_time_lag", "mag_gyro_misalignment", "gyro_scale")
    )
    assert material(delay, np.zeros(1))
    assert not material(mount, np.array([0.03, 0.0, 0.04]))
    assert material(mount, np.array([0.04, 0.0, 0.04]))
    assert not material(scale, np.array([0.0, 0.039, 0.0]))


def test_a_mount_no_worse_than_any_is_not_said_amid_more(track: Track) -> None:
    """A third of a degree, beside a rest that is worth more; ten times as much is said."""
    crooked = replace(track, covariates={})
    angle = np.array([2e-3, -4e-3, 3e-3])
    mag = crooked.mag_b_gauss
    crooked = replace(crooked, mag_b_gauss=mag + np.cross(angle, mag))
    state, _, left = named(crooked, "mag_gyro_misalignment")
    nats = 2 * state.named[0].evidence
    sensor = replace(left.located["sensor"], evidence=nats, p_value=1e-30)
    loud = replace(left, located={**left.located, "sensor": sensor})
    assert likelier_forms._of_sensors_themselves(state, loud, [0]) == [0]
    assert likelier_forms._of_sensors_themselves(state, loud, []) == []
    assert likelier_forms._of_sensors_themselves(state, left, [0]) == []
    term = replace(state.fit.terms[0], value=10 * angle + 0.05)
    large = replace(state, fit=replace(state.fit, terms=(term,)))
    assert likelier_forms._of_sensors_themselves(large, loud, [0]) == []


def test_what_is_worth_more_than_the_rest_it_was_found_in_stays(bumped) -> None:
    """A bump of the gyro beside a step: in white noise one is the other's, in a room it is not."""
    state, surveys, left = bumped
    rest = left.strongest.evidence
    found = replace(state, named=(replace(state.named[0], evidence=rest + 1.0),))
    beside = frozenset({"field_step"})
    assert without_likelier_forms(found, surveys, left)[0].names == ()
    assert without_likelier_forms(found, surveys, left, beside)[0] is found
    weaker = replace(state, named=(replace(state.named[0], evidence=rest - 1.0),))
    assert without_likelier_forms(weaker, surveys, left, beside)[0].names == ()


def test_a_delay_is_no_part_of_a_rest(track: Track) -> None:
    late = replace(
        track,
        mag_b_gauss=np.column_stack(
            [np.interp(track.time_s - 0.03, track.time_s, one) for one in track.mag_b_gauss.T]
        ),
        covariates={},
    )
    state, _, left = named(late, "mag_time_lag")
    assert likelier_forms._asked(state, left, frozenset()) == []


@pytest.mark.parametrize(("period_s", "asked"), [(40.0, []), (200.0, [0])])
def test_what_was_logged_and_changes_often_is_no_part_of_a_rest(
    track: Track, period_s: float, asked: list[int]
) -> None:
    on = np.where((track.time_s - track.time_s[0]) % period_s < period_s / 2, 0.0, 1.0)
    switched = replace(with_field(track, on, 2e-3), covariates={"lamp_on": on})
    state, _, left = named(switched, "switched_device")
    nats = 2 * state.named[0].evidence
    sensor = replace(left.located["sensor"], evidence=nats, p_value=1e-30)
    left = replace(left, located={**left.located, "sensor": sensor})
    assert likelier_forms._asked(state, left, frozenset({"switched_device"})) == asked
    assert likelier_forms._asked(state, left, frozenset()) == [0]


def test_what_is_a_small_part_of_the_rest_is_not_said(monkeypatch) -> None:
    rest = SimpleNamespace(
        strongest=SimpleNamespace(evidence=20.0), bins=(("heading", 264.0, 0.0),)
    )
    state = SimpleNamespace(problem=SimpleNamespace(limits=LIMITS))
    monkeypatch.setattr(likelier_forms, "strengths", lambda _: [7.9, 38.0, 41.0, 8.0])
    assert likelier_forms._next_to_nothing(state, rest, [0, 1, 2]) == [0, 1]
    in_time = SimpleNamespace(strongest=SimpleNamespace(evidence=264.0), bins=())
    assert likelier_forms._next_to_nothing(state, in_time, [1, 2, 3]) == [1, 3]
