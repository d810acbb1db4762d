"""Evidence about a calibration from data that the estimate has, and has not, seen.

::

    samples ─▶ history (segments, every 4th held out) ─▶ attitude (gyro + gravity, no compass)
                 │                                          ├─▶ heading  held-out error
                 │                                          ├─▶ field    size, dip, drift
                 │                                          ├─▶ coverage attitudes shown
                 │                                          └─▶ refits   halves, second opinion
                 └─▶ stillness (gyro bias at rest)          prediction: heading change over headings

`EvidenceCollector` runs it all; `ahrsd.gates` judges the `Evidence`.
"""

from ahrsd.evidence.collector import EvidenceCollector
from ahrsd.evidence.history import HistoryParameters, Role
from ahrsd.evidence.prediction import Envelope, heading_error_curve, worst_difference_deg
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
