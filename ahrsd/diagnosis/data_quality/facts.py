"""A fact about a recording: found by counting, without physics and before any fit."""

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
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class Fact:
    """One thing that is wrong with a recording.

    effect:     identifier of the contract;  words: one line that describes it, with its numbers
    confidence: probability of the effect, 0..1
    parameters: as in the effect's table row
    setting:    what else the effect needs (axes, signs, onset, ...), JSON-able
    bad:        (N,) rows whose magnetometer reading is invalid; None if all are valid
    turned:     (N,) ratio of the sensor's turn to the gyro's in the step that ends at the row, nan
                where it is unknown; None if the gyro is right
    unseen:     (N,) expected number of further lost steps, corrected on average as well
    stops:      no fit means anything before it is corrected
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


def is_finding(fact: Fact) -> bool:
    """Whether the fact is a finding; otherwise it deserves a note only."""
    if fact.effect == "dropped_samples" and not fact.setting:
        return fact.parameters[0].value > priors.MISSING_FINDING_SHARE
    if fact.effect == "stuck_magnetometer":
        return fact.parameters[0].value >= priors.STUCK_FINDING_S
    if fact.effect == "stuck_gyro":  # not an effect of the library
        return False
    if fact.effect == "timestamp_jitter" and not fact.stops:
        return fact.parameters[0].value > priors.JITTER_FINDING_SHARE * float(
            fact.setting["step_s"]
        )
    return True


def burst_is_explained(burst: Fact, moments: Sequence[tuple[float, float]]) -> bool:
    """Whether each interval of a noise burst contains one of these moments, which then explain it.

    moments: intervals in seconds of lost turns and of short effects
    """
    spans = burst.where.intervals_s if burst.effect == "noise_burst" else ()
    explained = [any(a <= end and begin <= b for begin, end in moments) for a, b in spans]
    return bool(explained) and all(explained)


def lost_turn_intervals(facts: Sequence[Fact]) -> list[tuple[float, float]]:
    """Intervals in which turns were lost, seconds."""
    return [span for fact in facts if fact.turned is not None for span in fact.where.intervals_s]


def rounding(facts: Sequence[Fact]) -> tuple[Term, ...]:
    """The quantisation steps of the readings, if they were found, as a term of the model."""
    return tuple(
        Term(
            fact.effect,
            np.array([value.value for value in fact.parameters]),
            np.array([value.std for value in fact.parameters]),
        )
        for fact in facts
        if fact.effect == "mag_quantisation"
    )


def whole_recording(track: Track) -> tuple[tuple[float, float], ...]:
    """The interval of the whole recording, seconds."""
    return ((float(track.time_s[0]), float(track.time_s[-1])),)


def row_intervals(rows: NDArray[np.bool], gap: int = 0) -> list[tuple[int, int]]:
    """First row and last row + 1 of each interval of true rows; gaps up to `gap` are closed."""
    at = np.flatnonzero(rows)
    if not len(at):
        return []
    cut = np.flatnonzero(np.diff(at) > 1 + gap)
    firsts = at[np.r_[0, cut + 1]]
    lasts = at[np.r_[cut, len(at) - 1]] + 1
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def as_finding(fact: Fact, library: Mapping[str, Effect]) -> Finding:
    """A counted fact as a finding: without held-out gain and without effect on the calibration."""
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


def stopped_diagnosis(
    recording: str, facts: Sequence[Fact], library: Mapping[str, Effect], notes: tuple[str, ...]
) -> Diagnosis:
    """The diagnosis if these facts make any fit meaningless."""
    return Diagnosis(
        recording=recording,
        baseline=None,
        mismatch=True,
        p_value=0.0,
        findings=tuple(as_finding(fact, library) for fact in facts),
        unexplained=Unexplained(False),
        posterior_predictive={},
        notes=(*notes, *(fact.words for fact in facts), "correct this first, then diagnose again"),
    )
