"""Evidence about a calibration from data that the estimate has, and has not, seen.

::

    samples ─▶ segments (every 4th held out; attitude by gyro and gravity, no compass)
                 ├─▶ heading    held-out error
                 ├─▶ coverage   attitudes shown
                 └─▶ second_opinions  refits of halves and of the field's size, gyro bias at rest

`collector` compares the candidate with the calibration in force and the world, by all of these.

`EvidenceCollector` runs it all; `values` is what it finds, and what `ahrsd.gates` judges.
"""

from ahrsd.evidence.collector import (
    Envelope,
    EvidenceCollector,
    heading_error_curve,
    worst_difference_deg,
)
from ahrsd.evidence.segments import HistoryParameters, Role
from ahrsd.evidence.values import BasisFacts, Evidence, HealthFacts

__all__ = [
    "BasisFacts",
    "Envelope",
    "Evidence",
    "EvidenceCollector",
    "HealthFacts",
    "HistoryParameters",
    "Role",
    "heading_error_curve",
    "worst_difference_deg",
]
