"""An answer with columns that have holes.

What such a column can still say is asked first; it counts only if an effect is named by it.  Else
the answer is the one that the recording gives without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.track import Spec, Track

#: a diagnosis of a track and what is known of the sensor
Ask = Callable[[Track, Spec | None], Diagnosis]


def with_holes(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """An answer, with columns that have holes where an effect is named by one."""
    holed = roles.holed(track)
    if holed:
        filled = track.with_columns(
            {**track.covariates, **{k: one.values for k, one in holed.items()}}
        )
        missing = np.zeros(len(track), dtype=bool)
        for one in holed.values():
            missing |= one.missing
        found = ask(_blind(filled, missing), spec)
        used = [name for name in holed if name in _causes(found)]
        if used:
            notes = tuple(holed[name].words for name in used)
            return replace(found, notes=(*notes, *found.notes))
    return ask(track, spec)


def _causes(found: Diagnosis) -> tuple[str, ...]:
    """Columns by which effects are named."""
    names = (one.setting.get("covariate") for one in found.findings)
    by_place = any(one.effect in ("field_gradient", "field_anomaly") for one in found.findings)
    position = ("position_north_m", "position_east_m", "position_down_m") if by_place else ()
    return (*(name for name in names if isinstance(name, str)), *position)


def _blind(track: Track, rows: NDArray[np.bool]) -> Track:
    """The track without the magnetometer's readings of these rows."""
    return replace(track, mag_b_gauss=np.where(rows[:, None], np.nan, track.mag_b_gauss))
