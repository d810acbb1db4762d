"""Calibration and terms fitted together against the spectrum of what they leave.

A fit against white noise follows what is loudest.  Where that is a room, it bends a delay or a
scale to serve it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.calibration_fit.descent import FittedTerm, moved
from ahrsd.diagnosis.calibration_fit.prior import PRIOR
from ahrsd.diagnosis.rules.delays import DELAYS
from ahrsd.diagnosis.rules.regression import CALIBRATION
from ahrsd.diagnosis.rules.search import STEPS, State, at_model, formed_basis_of, term_group
from ahrsd.diagnosis.rules.spectrum import against, spectrum_of
from ahrsd.diagnosis.values import NullModel

ROUNDS = 3


def reweighted(state: State) -> State:
    """The state at the fit that the spectrum asks for; its noise stays as it was.

    As it is where something jumps (`stepped`).
    """
    if stepped(state):
        return state
    for _ in range(ROUNDS):
        basis = formed_basis_of(state)
        quiet = against(basis, spectrum_of(basis))
        Z = quiet.known.reshape(-1, quiet.known.shape[2])
        ridge = np.zeros(Z.shape[1])
        ridge[quiet.groups[CALIBRATION]] = PRIOR**-2.0
        for k, term in enumerate(state.fit.terms):
            ridge[quiet.groups[term_group(k)]] = term.scale**-2.0
        change = np.linalg.solve(
            Z.T @ Z + np.diag(np.maximum(ridge, 1e-9)), Z.T @ quiet.innovation.ravel()
        )
        model = moved(state.fit.model, change[quiet.groups[CALIBRATION]])
        terms = tuple(
            replace(term, value=term.value + change[quiet.groups[term_group(k)]])
            for k, term in enumerate(state.fit.terms)
        )
        state = _at(state, model, terms)
    return state


def stepped(state: State) -> bool:
    """Whether a field or a rate jumps in the state.

    A jump is most of what there is at low frequencies: its size is best told by the levels before
    and after.
    """
    return any(name in STEPS.values() for name in state.names)


def _at(state: State, model: NullModel, terms: tuple[FittedTerm, ...]) -> State:
    """The state with this model and these terms; a delay is taken out of the track."""
    problem = state.problem
    for k, term in enumerate(terms):
        if term.identifier in DELAYS:
            late_s = DELAYS[term.identifier] * float(term.value[0])
            problem = problem.lagging(problem.lag_s + late_s)
            terms = (*terms[:k], replace(term, value=np.zeros(1)), *terms[k + 1 :])
    return replace(state, problem=problem, fit=at_model(problem.track, model, terms))
