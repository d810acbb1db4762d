"""A logged cause that comes late into the log, or early: its own clock, sought where it matters.

A current that is averaged in the logger, or stamped when it is written, is some tenths of a second
off.  Held against the field as it is logged its coefficients come out too small, since its edges
miss those of the field, and its derivative explains the rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.settings import WORTH_NATS, evidence_of

#: names whose cause may change within tenths of a second
QUICK_CAUSES = ("motor_current_field",)
LATE_S = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4)
CLOSER_S = (-0.05, 0.05)
#: alternatives that the choice among them costs
TRIED = len(LATE_S) + len(CLOSER_S) + 1


def in_time(basis: Base, candidate: Candidate) -> Candidate:
    """The candidate with its cause moved to where it explains most, if that is clearly more."""
    if candidate.name not in QUICK_CAUSES or candidate.evidence < WORTH_NATS:
        return candidate
    best = replace(candidate, evidence=evidence_of(basis, candidate))
    for around in (LATE_S, CLOSER_S):
        at_s = float(best.setting.get("late_s", 0.0))
        for step_s in around:
            moved = replace(
                candidate, setting={**candidate.setting, "late_s": round(at_s + step_s, 3)}
            )
            moved = replace(moved, evidence=evidence_of(basis, moved))
            best = moved if moved.evidence > best.evidence else best
    paid = best.evidence - _cost(candidate)
    if paid < candidate.evidence + WORTH_NATS:
        return candidate
    return replace(best, tried=candidate.tried * TRIED, evidence=paid)


def on_time(basis: Base, candidate: Candidate) -> Candidate:
    """The candidate with its cause as it was logged."""
    setting = {key: value for key, value in candidate.setting.items() if key != "late_s"}
    logged = replace(candidate, setting=setting, tried=1, alike=1.0)
    return replace(logged, evidence=evidence_of(basis, logged))


def _cost(candidate: Candidate) -> float:
    return candidate.paid + float(np.log(TRIED))
