"""An onset or a phase moved together with a scale, by the derivatives of the whole fit.

Later with a shorter time constant looks nearly the same, and so does a longer wave with another
phase: sought one after the other they end between.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.effects.base import ANGLES, Setting
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.settings import scale_of, scaled
from ahrsd.samples import Array

#: steps for the derivatives by both, and how far an onset may move at once, of the recording
ONSET_STEP_S, SCALE_STEP, ONSET_SHARE = 0.5, 0.05, 0.05
#: by how much a time constant's logarithm may still change in the joint fit
SCALE_AGAIN = 0.3


def both(candidate: Candidate) -> tuple[str, ...]:
    """Its onset or phase and its scale where it has both: one makes up for the other."""
    key = scale_of(candidate)
    others = [one for one in ("onset_s", *ANGLES) if one in candidate.setting and one != key]
    return (others[0], key) if others and key is not None else ()


def moved_together(basis: Base, at: Candidate, keys: tuple[str, ...], value: Array) -> Setting:
    """The setting with both where the whole fit's linear model has them."""
    time_s = basis.context.track.time_s
    steps = [ONSET_STEP_S if key == "onset_s" else SCALE_STEP for key in keys]
    moved = [
        _moved(at.setting, key, sign * step)
        for key, step in zip(keys, steps, strict=True)
        for sign in (1, -1)
    ]
    columns = [at.effect.columns(basis.context, setting) for setting in moved]
    sides = [part @ value for part in basis.whitened(columns)]
    slopes = [(sides[2 * k] - sides[2 * k + 1]) / (2 * step) for k, step in enumerate(steps)]
    D = np.stack(slopes, axis=2)
    Z = np.concatenate([basis.known, D], axis=2).reshape(-1, basis.known.shape[2] + len(keys))
    change = solve(Z.T @ Z, (Z.T @ basis.innovation.ravel())[:, None])[-len(keys) :, 0]
    setting = at.setting
    for key, much in zip(keys, change, strict=True):
        on = key == "onset_s"
        reach = ONSET_SHARE * basis.context.track.duration_s if on else SCALE_AGAIN
        setting = _moved(setting, key, float(np.clip(much, -reach, reach)))
    if "onset_s" in keys:
        onset_s = float(np.clip(setting["onset_s"], time_s[0], time_s[-1]))
        setting = {**setting, "onset_s": round(onset_s, 4)}
    return setting


def _moved(setting: Setting, key: str, change: float) -> Setting:
    """The setting with its onset later by seconds, or its scale or phase changed (`scaled`)."""
    if key == "onset_s":
        return {**setting, key: float(setting[key]) + change}
    return scaled(setting, key, change)
