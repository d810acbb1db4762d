"""Readings taken while a hand puts a magnet on: without weight, and the rest is named."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.delay import delayed_gyro
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.cut_out import FEWEST, brief, without
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.regression import Candidate
from ahrsd.diagnosis.rules.search import State, fitted_term
from ahrsd.diagnosis.track import Spec, Track

MAGNET = np.array([0.07, -0.1, 0.5])
ON_S, OFF_S, HAND_S = 60.0, 110.0, 1.2
LAG_S = 0.012


def handled(lag_s: float = 0.0, hand_s: float = HAND_S) -> Track:
    """A magnet put on and taken off by a hand, which brings it from the side."""
    track = track_of(experiment("wam", motion="rov", samples=4000))
    time_s = track.time_s - track.time_s[0]
    on, off = (np.clip((time_s - at) / max(hand_s, 1e-9) + 0.5, 0.0, 1.0) for at in (ON_S, OFF_S))
    aside = np.sin(np.pi * on) ** 2 - 0.6 * np.sin(np.pi * off) ** 2
    field = (on - off)[:, None] * MAGNET + aside[:, None] * np.array([0.2, 0.15, 0.0])
    return delayed_gyro(replace(track, mag_b_gauss=track.mag_b_gauss + field), -lag_s)


def state_of(track: Track) -> State:
    """The two steps and nothing else."""
    problem, start = problem_of(track, Spec(), EFFECTS, LIMITS)
    effect = EFFECTS["hard_iron_step"]
    first_s = float(track.time_s[0])
    candidates = [Candidate(effect, {"onset_s": first_s + at}, 1, 0.0) for at in (ON_S, OFF_S)]
    terms = tuple(fitted_term(one, np.zeros(3)) for one in candidates)
    fit = fit_null(problem.track, problem.spec, start, terms, walk=False)
    return State(problem, fit, tuple(SimpleNamespace(candidate=one) for one in candidates))


@pytest.mark.slow
def test_a_lag_is_named_with_its_value_beside_a_magnet_that_a_hand_puts_on() -> None:
    found = diagnose(handled(LAG_S))
    steps = [one for one in found.findings if one.effect == "hard_iron_step"]
    (lag,) = (one for one in found.findings if one.effect != "hard_iron_step")
    assert len(steps) == 2
    assert lag.effect == "mag_time_lag"
    (told,) = lag.parameters
    assert abs(told.value - LAG_S) < max(3 * told.std, 3e-4)
    assert told.std < 1e-3
    assert not found.unexplained.detected
    assert any("left out" in note for note in found.notes)


@pytest.mark.slow
def test_the_way_of_a_hand_is_cut_out_and_a_sharp_step_has_none() -> None:
    state = state_of(handled())
    spans = brief(state)
    assert len(spans) == 2
    first_s = float(state.problem.track.time_s[0])
    for (begin, end), at in zip(spans, (ON_S, OFF_S), strict=True):
        assert begin - first_s == pytest.approx(at - HAND_S / 2, abs=0.4)
        assert end - first_s > at + HAND_S / 4
    cut = without(state.problem, spans).track
    lost = ~np.isfinite(cut.mag_b_gauss).all(axis=1)
    assert FEWEST <= np.count_nonzero(lost) < 60
    assert brief(state_of(handled(hand_s=0.0))) == []
