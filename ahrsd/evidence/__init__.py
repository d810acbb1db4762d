"""Evidence about a calibration, from training data and from held-out data.

::

    samples ─▶ segments (every 4th held out; attitude by gyro and gravity, no compass)
                 ├─▶ heading    held-out error
                 ├─▶ coverage   attitudes covered
                 └─▶ second_opinions  refits of halves and of the magnitude, gyro bias at rest

`collector` compares the candidate with the calibration in force and with the world model, using all
of these. `EvidenceCollector` runs everything; `values` holds its results, which `ahrsd.gates`
judges.
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
