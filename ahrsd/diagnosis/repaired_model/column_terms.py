"""Effects that logged columns alone determine, sample by sample, such as the field of a current.

Separate from the forward model, so that a daemon that subtracts such effects does not load it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Term
from ahrsd.samples import Array

_PROBE_ROWS = 64


def follows_a_column(term: Term) -> bool:
    """Whether columns alone determine the effect, each sample by itself.

    Tested on the effect itself: with all but time and columns unknown its contribution must be
    finite, and the same in two halves as in one piece.
    """
    name = term.setting.get("covariate")
    if EFFECTS[term.identifier].kind != "mean" or not isinstance(name, str) or name == "accel":
        return False
    time_s = np.arange(_PROBE_ROWS, dtype=np.float64)
    dt_s = np.ones(_PROBE_ROWS)
    column = np.random.default_rng(1).normal(20.0, 5.0, _PROBE_ROWS)
    whole, first, second = (
        column_contribution(term, time_s[rows], dt_s[rows], {name: column[rows]})
        for rows in (slice(None), slice(_PROBE_ROWS // 2), slice(_PROBE_ROWS // 2, None))
    )
    joined = np.concatenate([first, second], axis=1)
    return bool(np.isfinite(whole).all() and np.allclose(joined, whole, rtol=1e-9))


def column_contribution(
    term: Term, time_s: Array, dt_s: Array, columns: Mapping[str, Array]
) -> Array:
    """(2, N, 3): what the effect adds to field and rate; nan where it needs more than columns."""
    count, nothing = len(time_s), np.full((len(time_s), 3), np.nan)
    if term.setting["covariate"] not in columns:
        return np.full((2, count, 3), np.nan)
    silent = Readings(
        time_s=time_s, dt_s=dt_s, mag_b_gauss=np.zeros((count, 3)),
        gyro_b_rad_s=np.zeros((count, 3)), accel_b_m_s2=nothing, rate_b_rad_s=nothing,
        field_b=nothing, R_nb=np.full((count, 3, 3), np.nan), soft_iron=np.full((3, 3), np.nan),
        covariates=dict(columns),
    )  # fmt: skip
    try:
        made = EFFECTS[term.identifier].simulate(silent, term.value, term.setting)
    except KeyError:  # the file lacks a setting that this effect needs
        return np.full((2, count, 3), np.nan)
    return np.stack([made.mag_b_gauss, made.gyro_b_rad_s])
