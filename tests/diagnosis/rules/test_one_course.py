"""Several names that share one smooth course, and those that only look as if they did."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import one_course
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.one_course import as_smooth, price, smooth_nats
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.track import Spec


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_two_smooth_effects_are_still_two(seed):
    effects = (("hard_iron_drift", 3.0), ("mag_scale_temperature", 1.0))
    found = diagnose(made(Trial(seed, effects, samples=6000)).track)
    assert {one.effect for one in found.findings} == {name for name, _ in effects}


def test_what_was_sought_is_paid():
    onset_and_scale = {"onset_s": 80.0, "time_constant_s": 20.0}
    active = Candidate(EFFECTS["onboard_calibration_active"], onset_and_scale, 1, 0.0)
    assert price(active, 0.0) == 0.0
    assert abs(price(active, 1000.0) - np.log(2001.0)) < 1e-9
    assert price(replace(active, tried=100), 0.0) == np.log(100)
    step = Candidate(EFFECTS["field_step"], {"onset_s": 80.0}, 1, 0.0)
    assert abs(price(step, 1000.0) - np.log(2001.0) / 2) < 1e-9
    place = {"place_m": [1.0, 2.0, 3.0], "distance_m": 2.0, "turn_deg": 30.0}
    passed = Candidate(EFFECTS["field_anomaly"], place, 1, 0.0)
    assert abs(price(passed, 1000.0) - 2 * np.log(2001.0)) < 1e-9


@pytest.mark.parametrize(
    ("world", "sensor", "found"),
    [(20.0, 8.0, ([0], "sensor")), (-13.5, 0.9, ([0], "world")), (20.0, 13.0, ([], None))],
)
def test_a_name_must_be_likelier_than_a_smooth_course_once_paid(
    monkeypatch, world, sensor, found
) -> None:
    """Of 40.5 nats, with a time that was sought: ln(82) / 2 = 2.2 and the odds asked for, 6.9."""
    leads = {"w": world, "s": sensor}
    monkeypatch.setattr(one_course, "_courses", lambda _: [("world", "w"), ("sensor", "s")])
    monkeypatch.setattr(one_course, "_lead", lambda *given: leads[given[3]])
    setting = {"time_constant_s": 20.0}
    candidate = Candidate(EFFECTS["viscous_magnetisation"], setting, 1, 0.0)
    state = SimpleNamespace(named=[SimpleNamespace(candidate=candidate, evidence=40.5)])
    basis = SimpleNamespace(colour=1.0)
    assert as_smooth(state, basis, {(0,): float(np.log(1000.0))}) == found
    assert as_smooth(state, basis, {}) == ([], None)


def test_what_slow_iron_is_worth_and_what_noise_is() -> None:
    """A field on the sensor of two milligauss that comes and goes within minutes."""
    track = made(Trial(4)).track
    course = np.sin(track.time_s / 15.0) * np.exp(-(((track.time_s - 150.0) / 60.0) ** 2))
    moved = replace(
        track, mag_b_gauss=track.mag_b_gauss + 2e-3 * np.outer(course, [0.48, -0.6, 0.64])
    )
    nats = {}
    for name, one in (("noise", track), ("iron", moved)):
        problem, cold = problem_of(one, Spec(), {}, LIMITS)
        state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
        nats[name] = smooth_nats(formed_basis_of(state))
    assert max(nats["noise"].values()) < np.log(100.0)
    assert nats["iron"]["sensor"] > np.log(1e6)
    assert nats["iron"]["sensor"] > nats["iron"]["world"]
