"""What a strong name leaves of itself, and other names that are no more than that.

No column of ours is exact: a term is linear where the physics is not, and play that is sampled
misses its turning points.  What a name of ten thousand nats leaves of its own form is worth a few,
which have a place and a shape, and look like another small effect.

The strength of a name is its evidence in the noise that is there in the end: when it was found, the
noise still held all that was named later, and itself.
"""

from __future__ import annotations

from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.rivals import MORE_SHARE
from ahrsd.diagnosis.rules.search import State, Survey, formed_basis_of, without_term
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.stand_ins import dropped

#: part of a name's evidence when it was found that its own form, which is never exact, may leave
FORM_SHARE = 1e-3


def strengths(state: State) -> list[float]:
    """Evidence of every name beside the others, nats; at least what it was when it was found."""
    made = state.fit.made
    if "strengths" not in made:
        basis = formed_basis_of(state)
        made["strengths"] = [
            max(judged.evidence, evidence_of(without_term(state, k, basis), judged.candidate))
            for k, judged in enumerate(state.named)
        ]
    found: list[float] = made["strengths"]
    return found


def price_of(state: State) -> float:
    """Nats that the names may leave of their own forms."""
    return max(_prices(state, strengths(state)), default=0.0)


def free_price_of(state: State) -> float:
    """The same where a form with many coefficients is asked: it finds a hundredth of any name."""
    known = max((judged.evidence for judged in state.named), default=0.0)
    return max(price_of(state), MORE_SHARE * known)


def without_trifles(
    state: State, surveys: list[Survey], left: unknown.Remainder
) -> tuple[State, list[Survey], unknown.Remainder]:
    """The state without names that are worth less than what a stronger one leaves of its form.

    What such a name explained is of that form, too, and no unknown.  Steps and what follows a
    logged column are exact: a delay beside a magnet of a fifth of a gauss is no trifle.
    """
    if len(state.named) < 2:
        return state, surveys, left
    found = strengths(state)
    shares = (judged.candidate.effect.form_share for judged in state.named)
    price = max(share * nats for share, nats in zip(shares, found, strict=True))
    trifles = [k for k, nats in enumerate(found) if nats < price]
    if not trifles:
        return state, surveys, left
    slim, others, rest = dropped(state, surveys, trifles, left)
    return slim, others, unknown.beside_names(rest, price, state.problem.limits)


def _prices(state: State, found: list[float]) -> list[float]:
    """What each name may leave of its form: of its evidence now, and of that when it was found."""
    return [
        max(judged.candidate.effect.form_share * nats, FORM_SHARE * judged.evidence)
        for judged, nats in zip(state.named, found, strict=True)
    ]
