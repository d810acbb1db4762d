"""A logged cause that comes late into the log, early or as a mean: sought where it matters.

A current that is averaged in the logger, or stamped when it is written, is some tenths of a second
off.  Held against the field as it is logged its coefficients come out too small, since its edges
miss those of the field, and its derivative explains the rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.effects.base import Setting
from ahrsd.diagnosis.effects.shapes import LOGGED
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.settings import WORTH_NATS, evidence_of

#: names whose cause may change within tenths of a second
QUICK_CAUSES = ("motor_current_field",)
LATE_S = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4)
CLOSER_S = (-0.05, 0.05, -0.025, 0.025)
#: spans of which a logger takes its mean, which comes late by half of that or has its middle's time
MEANS_S = (0.2, 0.4, 0.8)
READ: tuple[Setting, ...] = (
    *({"late_s": late_s} for late_s in LATE_S),
    *({"mean_s": mean_s} for mean_s in MEANS_S),
    *({"mean_s": mean_s, "late_s": mean_s / 2} for mean_s in MEANS_S),
)
#: alternatives that the choice among them costs
TRIED = len(READ) + len(CLOSER_S) + 1


def in_time(basis: Base, candidate: Candidate) -> Candidate:
    """The candidate with its cause moved to where it explains most, if that is clearly more."""
    if candidate.name not in QUICK_CAUSES or candidate.evidence < WORTH_NATS:
        return candidate
    best = replace(candidate, evidence=evidence_of(basis, candidate))
    for read in READ:
        best = _better(basis, best, {**candidate.setting, **read})
    for step_s in CLOSER_S:
        late_s = round(float(best.setting.get("late_s", 0.0)) + step_s, 3)
        best = _better(basis, best, {**best.setting, "late_s": late_s})
    paid = best.evidence - _cost(candidate)
    if paid < candidate.evidence + WORTH_NATS:
        return candidate
    return replace(best, tried=candidate.tried * TRIED, evidence=paid)


def on_time(basis: Base, candidate: Candidate) -> Candidate:
    """The candidate with its cause as it was logged."""
    setting = {key: value for key, value in candidate.setting.items() if key not in LOGGED}
    logged = replace(candidate, setting=setting, tried=1, alike=1.0)
    return replace(logged, evidence=evidence_of(basis, logged))


def _better(basis: Base, best: Candidate, setting: Setting) -> Candidate:
    """The candidate in another setting where that explains more."""
    moved = replace(best, setting=setting)
    moved = replace(moved, evidence=evidence_of(basis, moved))
    return moved if moved.evidence > best.evidence else best


def _cost(candidate: Candidate) -> float:
    return candidate.paid + float(np.log(TRIED))
