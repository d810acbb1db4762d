"""Size and dip of the corrected field, over all samples and from segment to segment."""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.evidence.segments import Nodes
from ahrsd.evidence.values import FieldFacts
from ahrsd.samples import Array

_ROUGH_M_S2 = 0.5  # rms of |force| - gravity above which a segment's dip is not compared


def field_facts(nodes: Nodes, correction: Affine) -> FieldFacts:
    """Facts about the field that `correction` makes of all segments."""
    h_b = correction.apply(nodes.raw_b_gauss)
    size = np.linalg.norm(h_b, axis=1)
    sine = np.sum(h_b * nodes.down_b, axis=1) / size
    dip_deg = nodes.mean(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))
    calm = dip_deg[nodes.rough_m_s2 < _ROUGH_M_S2]
    temperatures = np.array([t.segment.temperature_c for t in nodes.tracks])
    return FieldFacts(
        mean_gauss=float(np.mean(size)),
        min_gauss=float(np.min(size)),
        max_gauss=float(np.max(size)),
        spread=float(np.std(size) / np.mean(size)),
        inclination_deg=float(np.median(calm)) if len(calm) else float("nan"),
        wander_gauss=_wander(nodes.mean(size)),
        inclination_wander_deg=_wander(calm),
        temperature_range_c=float(np.ptp(temperatures)),
    )


def _wander(values: Array) -> float:
    return float(np.max(np.abs(values - np.median(values)))) if len(values) else float("nan")
