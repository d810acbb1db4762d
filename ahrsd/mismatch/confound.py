"""What this motion cannot tell apart: shared information, what the calibration takes, advice.

After the calibration is projected out, the share of A's information that B explains is the mean
squared cosine of the principal angles between their whitened column spaces (distinguishability in
the sense of Eriksson, Frisk, Krysander, Automatica 49:1591, 2013, for Gaussian residuals).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.gram import RANK_SHARE, Gram
from ahrsd.samples import Array

#: member -> families that contain it exactly or nearly; the member is the name to prefer
NESTED: Mapping[str, tuple[str, ...]] = {
    "mag_time_lag": ("eddy_current", "mag_low_pass", "gyro_time_lag", "gyro_integration"),
    "gyro_time_lag": ("mag_time_lag", "gyro_integration"),
    "clock_rate": ("gyro_scale",),
    "hard_iron_step": ("switched_device",),
    "gyro_bias_step": ("gyro_bias_drift",),
    "gyro_startup": ("gyro_bias_drift",),
    "gyro_bias_temperature": ("gyro_bias_drift",),
    "mag_bias_temperature": ("hard_iron_drift",),
}


def shared_information(projected: Gram, first: str, second: str) -> float:
    """Share 0..1 of the information on `first` that `second` also explains."""
    total = projected.total
    a, b = projected.groups[first], projected.groups[second]
    root_a = _inverse_root(total[a, a], projected.information[a])
    root_b = _inverse_root(total[b, b], projected.information[b])
    if not (root_a.shape[1] and root_b.shape[1]):
        return 0.0
    cosines = root_a.T @ total[a, b] @ root_b
    return float(np.clip(np.sum(cosines**2) / root_a.shape[1], 0.0, 1.0))


def absorbed_by_calibration(projected: Gram, name: str) -> float:
    """Share 0..1 of the effect that a fitted calibration silently takes as its own."""
    columns = projected.groups[name]
    left = float(np.trace(projected.total[columns, columns]))
    return 1.0 - float(np.clip(left / max(projected.information[columns].sum(), 1e-300), 0.0, 1.0))


def separating_manoeuvre(library: Mapping[str, Effect], name: str, others: Sequence[str]) -> str:
    """What to drive so that `name` and the likeliest of `others` come apart, in words."""
    for other in others:
        for one, two in ((name, other), (other, name)):
            if one in library:
                for confuser, words in library[one].confusers:
                    if confuser == two:
                        return words
    return library[name].manoeuvre if name in library else ""


def _inverse_root(G: Array, information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.maximum(information, np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(G * scale[:, None] * scale)
    kept = values > RANK_SHARE
    return np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]))
