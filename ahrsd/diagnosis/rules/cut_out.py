"""Readings that were taken while something was put on or taken off: given no weight.

A magnet in a hand takes a second to be put on.  A step has its two levels right, but not the way
from the one to the other: what it leaves there is louder than everything else, counts as noise, and
hides a lag or spoils its value.  The same holds for bursts of any cause.  So the rows in which the
innovations are loud without a break, around a step that was named or in bursts, lose their
readings (the gyro carries the field across), and naming goes on with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Unexplained
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.data_quality.facts import spans_of
from ahrsd.diagnosis.rules.bursts import bursts
from ahrsd.diagnosis.rules.regression import residual
from ahrsd.diagnosis.rules.search import STEPS, State, formed_basis_of, refitted
from ahrsd.diagnosis.rules.sought import Sought, sought
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

Span = tuple[float, float]

#: power of a row over the usual one, chi-squared of three, from which it is loud: 1 in a million
LOUD = 30.0
#: median of chi-squared of three
_MIDDLE = 2.366
#: quiet rows between loud ones that are part of it, and how far from a loud row a step may be
BREAK_S = 0.5
#: fewer rows are no way from one level to another: a row across the step itself is loud
FEWEST = 3
#: what lasts longer is a course of its own
LONGEST_S = 5.0
#: what is quieter may show once the loudest is gone
ROUNDS = 3


def beside_brief(found: Sought) -> tuple[Sought, Unexplained | None]:
    """What was found, sought anew without the loud rows, and the bursts among them.

    Bursts that are the way from one level of a named step to the other are no unknown.
    """
    state, short, gone = found.state, None, []
    for _ in range(ROUNDS):
        here = bursts(formed_basis_of(state))
        where = () if here is None or here.where is None else here.where.intervals_s
        if short is None and not all(_near(span, _onsets(state)) for span in where):
            short = here
        spans = brief(state, where)
        if not spans:
            break
        gone += spans
        state = refitted(replace(state, problem=without(state.problem, spans)), state.named)
    if not gone:
        return found, short
    words = ", ".join(f"{a:.1f}-{b:.1f}" for a, b in merged(gone))
    notes = (
        *state.problem.notes,
        f"readings at {words} s were left out: something was moved there",
    )
    state = replace(state, problem=replace(state.problem, notes=notes))
    return replace(sought(state), first=found.first, before=found.before), short


def brief(state: State, bursts_s: Sequence[Span] = ()) -> list[Span]:
    """(begin, end) seconds of loud stretches in which a step is, or a burst."""
    basis = formed_basis_of(state)
    time_s, used = basis.context.track.time_s, basis.filtered.used
    power = np.sum(residual(basis.known, basis.innovation) ** 2, axis=1)
    usual = float(np.median(power[used])) / _MIDDLE
    loud = used & (power > LOUD * usual)
    known = (*_onsets(state), *bursts_s)
    half_s = 0.5 / basis.rate_hz
    out = []
    for a, b in spans_of(loud, round(BREAK_S * basis.rate_hz)):
        begin, end = float(time_s[a]), float(time_s[b - 1])
        if (
            _near((begin, end), known)
            and np.count_nonzero(loud[a:b]) >= FEWEST
            and end - begin < LONGEST_S
        ):
            out.append((begin - half_s, end + half_s))
    return out


def merged(spans: Sequence[Span]) -> list[Span]:
    """Spans in order, those that touch made one."""
    out: list[Span] = []
    for begin, end in sorted(spans):
        if out and begin <= out[-1][1] + BREAK_S:
            out[-1] = (out[-1][0], max(end, out[-1][1]))
        else:
            out.append((begin, end))
    return out


def _onsets(state: State) -> list[Span]:
    """The times of the steps of a field, as spans."""
    names = (STEPS["sensor"], STEPS["world"])
    onsets_s = [j.candidate.setting["onset_s"] for j in state.named if j.candidate.name in names]
    return [(float(at), float(at)) for at in onsets_s]


def _near(span: Span, others: Sequence[Span]) -> bool:
    """Whether a span touches one of the others, but for a short break."""
    return any(span[0] - BREAK_S < end and begin < span[1] + BREAK_S for begin, end in others)


def without(problem: Problem, spans: Sequence[Span]) -> Problem:
    """The problem with no readings of the magnetometer in these spans, seconds."""
    return replace(
        problem,
        track=_silenced(problem.track, spans),
        recorded=_silenced(problem.recorded, spans),
    )


def _silenced(track: Track, spans: Sequence[Span]) -> Track:
    mag: Array = track.mag_b_gauss.copy()
    for begin_s, end_s in spans:
        mag[(track.time_s >= begin_s) & (track.time_s <= end_s)] = np.nan
    return replace(track, mag_b_gauss=mag)
