"""A coefficient at its physical bound, which is known only so well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.base import BOUND_DEVIATIONS
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter.score import total_score
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.exam import examined
from ahrsd.diagnosis.rules.name import Judged, believable
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, added, survey
from ahrsd.diagnosis.track import Spec, Track

NAME = "mag_cross_axis"


@pytest.mark.parametrize(
    ("beyond", "colour", "believed"),
    [(-1.0, 1.0, True), (1.9, 1.0, True), (3.1, 1.0, False), (5.9, 4.0, True), (6.1, 4.0, False)],
)
def test_what_is_beyond_its_bound_by_noise_alone_is_believed(beyond, colour, believed):
    candidate = Candidate(EFFECTS[NAME], {"products": "own"}, 1, 0.0)
    sigma = np.linspace(0.5e-3, 1.6e-3, 6)
    G = np.diag(sigma**-2)
    value = np.zeros(6)
    value[3] = -(20e-3 + beyond * sigma[3])
    what = total_score(G, G @ value, np.diag(G), candidate.scale, 0.01)
    np.testing.assert_allclose(what.value, value, atol=1e-9)
    assert believable(candidate, what, value, colour) == believed


@pytest.mark.parametrize(("sigma", "believed"), [(0.05, True), (0.2, False)])
def test_what_is_known_to_half_its_bound_only_is_not_known(sigma, believed):
    """Beyond its bound by less than three of its deviations, but those are as large as it."""
    candidate = Candidate(EFFECTS["mag_gyro_misalignment"], {}, 1, 0.0)
    G = np.eye(3) / sigma**2
    value = np.array([0.48, 0.1, -0.1]) if believed else np.array([-0.68, -0.4, -0.3])
    what = total_score(G, G @ value, np.diag(G), candidate.scale, 0.0)
    assert believable(candidate, what, value, 1.0) == believed


@pytest.fixture(scope="module")
def track() -> Track:
    return made(Trial(3, ((NAME, 2.0),), samples=6000)).track


def _bounded(track: Track, bound_gauss: float) -> tuple[State, Judged]:
    """The state without names, and the effect judged in it with that bound."""

    class Bounded(type(EFFECTS[NAME])):  # type: ignore[misc]
        parameters = tuple(replace(p, bound=bound_gauss) for p in EFFECTS[NAME].parameters)

    problem, cold = problem_of(track, Spec(), {**EFFECTS, NAME: Bounded()}, LIMITS)
    state = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    return state, next(one for one in survey(state).judged if one.candidate.name == NAME)


def test_a_name_goes_only_where_its_coefficients_are_beyond_doubt(track):
    _, free = _bounded(track, 20e-3)
    size = np.abs(free.what.value)
    largest = int(np.argmax(size))
    sigma = np.sqrt(free.what.covariance[largest, largest])
    assert size[largest] > 10 * sigma
    state, near = _bounded(track, float(size[largest] - 1.5 * sigma))
    assert near.refused == ()
    assert examined(added(state, near))[0].names == (NAME,)
    _, far = _bounded(track, float(size[largest] - 2 * BOUND_DEVIATIONS * sigma))
    assert far.refused == ("physical bounds",)


@pytest.mark.parametrize(
    ("part", "sigma", "believed"),
    [(0.05, 1e-3, True), (8e-3, 1e-3, True), (2e-3, 3e-4, False), (-0.012, 1e-3, False)],
)
def test_a_compensation_takes_hard_iron_away(part: float, sigma: float, believed: bool) -> None:
    """Next to nothing of it, or more of it, is a drift."""
    candidate = Candidate(EFFECTS["onboard_calibration_active"], {}, 1, 0.0)
    G = np.diag([sigma**-2, 1e8])
    value = np.array([part, 1e-3])
    what = total_score(G, G @ value, np.diag(G), candidate.scale, 0.0)
    np.testing.assert_allclose(what.value, value, atol=1e-9)
    assert believable(candidate, what, value, 1.0) == believed


def test_no_axis_turns_faster_than_the_earth() -> None:
    candidate = Candidate(EFFECTS["earth_rotation"], {}, 1, 0.0)
    G = np.eye(3) * 5e-6**-2
    for east, believed in ((7.2e-5, True), (8.6e-5, True), (9.2e-5, False)):
        value = np.array([1e-5, east, -1e-5])
        what = total_score(G, G @ value, np.diag(G), candidate.scale, 0.0)
        assert believable(candidate, what, value, 1.0) == believed
