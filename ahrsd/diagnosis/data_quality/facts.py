"""A fact about a recording that needs no physics: found by counting, told before any fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding, Unexplained, Value, Where
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.model import Term
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Fact:
    """One thing that is wrong with a recording.

    effect:     identifier of the contract;  words: one line that says it with its numbers
    confidence: of the name, 0..1
    parameters: as the effect's table row
    setting:    what else the effect needs (axes, signs, onset, ...), JSON-able
    bad:        (N,) rows whose magnetometer reading is not one, None where all are
    turned:     (N,) how many times as far as the gyro says the sensor turned in the step that ends
                at the row, nan where nobody knows; None where the gyro is right
    unseen:     (N,) how many steps are expected to be lost beyond those, in the mean put right too
    stops:      nothing that is fitted before it is put right means anything
    """

    effect: str
    words: str
    where: Where
    confidence: float
    parameters: tuple[Value, ...] = ()
    setting: dict[str, Any] = field(default_factory=dict)
    bad: NDArray[np.bool] | None = None
    turned: Array | None = None
    unseen: Array | None = None
    stops: bool = False


def matters(fact: Fact) -> bool:
    """Whether the fact is a finding; else it is worth a note."""
    if fact.effect == "dropped_samples" and not fact.setting:
        return fact.parameters[0].value > priors.MISSING_FINDING_SHARE
    if fact.effect == "stuck_magnetometer":
        return fact.parameters[0].value >= priors.STUCK_FINDING_S
    if fact.effect == "stuck_gyro":  # no name of the library
        return False
    if fact.effect == "timestamp_jitter" and not fact.stops:
        return fact.parameters[0].value > priors.JITTER_FINDING_SHARE * float(
            fact.setting["step_s"]
        )
    return True


def around(burst: Fact, moments: Sequence[tuple[float, float]]) -> bool:
    """Whether every span of a burst of noise has one of these in it: then it is what that leaves.

    moments: seconds, of lost turns and of names that show for a moment only
    """
    spans = burst.where.intervals_s if burst.effect == "noise_burst" else ()
    beside = [any(a <= end and begin <= b for begin, end in moments) for a, b in spans]
    return bool(beside) and all(beside)


def lost_at(facts: Sequence[Fact]) -> list[tuple[float, float]]:
    """Where turns were lost, seconds."""
    return [span for fact in facts if fact.turned is not None for span in fact.where.intervals_s]


def rounding(facts: Sequence[Fact]) -> tuple[Term, ...]:
    """The coarse steps of the readings, where they were counted, as a term of the model."""
    return tuple(
        Term(
            fact.effect,
            np.array([value.value for value in fact.parameters]),
            np.array([value.std for value in fact.parameters]),
        )
        for fact in facts
        if fact.effect == "mag_quantisation"
    )


def spans_of(rows: NDArray[np.bool], gap: int = 0) -> list[tuple[int, int]]:
    """First row and row behind the last of each stretch of true rows; gaps up to `gap` closed."""
    at = np.flatnonzero(rows)
    if not len(at):
        return []
    cut = np.flatnonzero(np.diff(at) > 1 + gap)
    firsts = at[np.r_[0, cut + 1]]
    lasts = at[np.r_[cut, len(at) - 1]] + 1
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def of_fact(fact: Fact, library: Mapping[str, Effect]) -> Finding:
    """A fact that was counted, not fitted, as a finding; nothing is held out, nothing moves."""
    effect = library.get(fact.effect)
    return Finding(
        effect=fact.effect,
        confidence=fact.confidence,
        alternatives=(),
        where=fact.where,
        parameters=fact.parameters,
        heldout=None,
        cost_if_left_out=None,
        separate_from=None,
        words=fact.words,
        equation="" if effect is None else effect.equation,
        setting=fact.setting,
    )


def stopped(
    recording: str, facts: Sequence[Fact], library: Mapping[str, Effect], notes: tuple[str, ...]
) -> Diagnosis:
    """The answer where nothing that is fitted would mean anything, for these facts."""
    return Diagnosis(
        recording=recording,
        baseline=None,
        mismatch=True,
        p_value=0.0,
        findings=tuple(of_fact(fact, library) for fact in facts),
        unexplained=Unexplained(False),
        posterior_predictive={},
        notes=(*notes, *(fact.words for fact in facts), "put this right first, then ask again"),
    )
