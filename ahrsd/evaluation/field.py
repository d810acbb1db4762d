"""Size of the corrected field: its spread, and the error of the norm constraint.

Spread is [R] 4.4, std |h| / mean |h|. [L]'s constraint is |h_k| = |H_k|; where the world's field is
not known the mean of |h| stands for |H|, and the error is then about that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.baselines.metrics import field_spread
from ahrsd.evaluation.heading import FOLDS
from ahrsd.samples import Array


@dataclass(frozen=True, slots=True, eq=False)
class FieldFigures:
    """Of one calibration. constraint_*: of |h| - |H|, |H| the mean of |h| unless it was given."""

    mean_gauss: float
    spread: float
    fold_spread: tuple[float, ...]
    constraint_rms_gauss: float
    constraint_worst_gauss: float
    size_gauss: Array


def field_figures(field_b: Array, world_gauss: float | None) -> FieldFigures:
    """Figures of corrected fields (N, 3) in gauss."""
    size = np.linalg.norm(field_b, axis=1)
    error = size - (float(np.mean(size)) if world_gauss is None else world_gauss)
    return FieldFigures(
        mean_gauss=float(np.mean(size)),
        spread=field_spread(field_b),
        fold_spread=tuple(field_spread(part) for part in np.array_split(field_b, FOLDS)),
        constraint_rms_gauss=float(np.sqrt(np.mean(error**2))),
        constraint_worst_gauss=float(np.max(np.abs(error))),
        size_gauss=size,
    )
