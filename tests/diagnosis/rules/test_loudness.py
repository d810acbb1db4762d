"""Noise that comes and goes: an unknown is told only if it is seen in rows of one noise too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import loudness, unknown
from ahrsd.diagnosis.rules.loudness import even, in_even_noise
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.diagnosis.rules.search import State, formed_basis_of
from ahrsd.diagnosis.rules.spells import with_spells
from ahrsd.diagnosis.track import Spec
from ahrsd.samples import Array

LOUD = (900, 2200, 4100, 6000)


def _basis(seed: int, extra: Array) -> Base:
    track = made(Trial(seed, scenario="wam", samples=8000)).track
    track = replace(track, mag_b_gauss=track.mag_b_gauss + extra)
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return formed_basis_of(State(problem, fit_null(problem.track, problem.spec, cold, walk=False)))


def _bursts(seed: int) -> Array:
    rng = np.random.default_rng([seed, 4])
    extra = np.zeros((8000, 3))
    for first in LOUD:
        extra[first : first + 170] = 3e-3 * rng.standard_normal((170, 3))
    return extra


@pytest.fixture(scope="module")
def loud() -> Base:
    return _basis(4, _bursts(4))


def test_rows_are_of_one_noise(loud: Base) -> None:
    rows = even(loud).innovation
    inside = np.zeros(len(rows), dtype=bool)
    thin = 8000 / len(rows)
    for first in LOUD:
        inside[int((first + 20) / thin) : int((first + 150) / thin)] = True
    assert np.std(loud.innovation[inside]) > 2.5 * np.std(loud.innovation[~inside])
    assert np.std(rows[inside]) == pytest.approx(np.std(rows[~inside]), rel=0.2)


def test_what_is_louder_for_a_while_is_no_unknown(loud: Base) -> None:
    left = with_spells(unknown.remainder(loud))
    assert unknown.detected(left, LIMITS)
    assert not unknown.detected(in_even_noise(loud, left, LIMITS), LIMITS)


def test_a_source_that_comes_and_goes_beside_it_is_still_told() -> None:
    source = np.zeros((8000, 3))
    source[2900:3700] = source[5000:5700] = (2e-3, -1e-3, 1.5e-3)
    basis = _basis(4, _bursts(4) + source)
    left = with_spells(unknown.remainder(basis))
    told = in_even_noise(basis, left, LIMITS)
    assert unknown.detected(told, LIMITS)
    assert told is left


def test_a_quick_source_in_a_louder_half_is_asked_for_once_more(monkeypatch, loud: Base) -> None:
    """`ring600j`, bc2798ae: noise three times as loud from the middle on was one source."""
    asked: list[bool] = []

    def framed(basis: Base, left, limits):
        asked.append(basis.weight is not None)
        return left

    monkeypatch.setattr(loudness, "framed", framed)
    left = replace(with_spells(unknown.remainder(loud)), one_source=True)
    told = in_even_noise(loud, left, LIMITS)
    assert asked == [True]
    assert not told.one_source
    assert not unknown.detected(told, LIMITS)
