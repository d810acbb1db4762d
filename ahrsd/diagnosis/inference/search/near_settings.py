"""The slopes of an effect's columns in its setting: onset, scale, angle, lateness, memory.

    columns(s + d) w = columns(s) w + sum_i d_i (d columns / d s_i) w

A setting is chosen and not averaged over, but its uncertainty is a part of the coefficients': if a
cause begins earlier, its coefficients are smaller.  With the slopes as further columns, each
coefficient has the deviation that is marginal over the settings nearby.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.effects.effect import ANGLES, SCALES, Setting
from ahrsd.diagnosis.inference.components.component import MOMENTS, Component, FixedLaw
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

#: changes of a setting for its slopes: of an onset as a share of the recording, of a scale as a
#: share of it, of an angle in degrees, of a lateness in s, of a memory as a share of the largest
_ONSET, _SCALE, _TURN_DEG, _LATE_S, _MEMORY = 1 / 2000, 0.02, 1.0, 0.02, 0.01


def perturbed_settings(component: Component, context: Context) -> dict[str, Setting]:
    """The setting with each of its numbers changed a little, by what is changed."""
    setting, perturbed = component.setting, dict[str, Setting]()
    for name in MOMENTS:
        if setting.get(name) is not None:
            at_s = float(setting[name]) + _ONSET * context.track.duration_s
            perturbed[name] = {**setting, name: at_s}
    for name in SCALES:
        if name in setting:
            perturbed[name] = {**setting, name: float(setting[name]) * (1.0 + _SCALE)}
    for name in ANGLES:
        if name in setting:
            perturbed[name] = {**setting, name: float(setting[name]) + _TURN_DEG}
    if "late_s" in setting:
        perturbed["late_s"] = {**setting, "late_s": float(setting["late_s"]) + _LATE_S}
    if component.row is not None and component.row.remembers:
        memory = np.array(setting.get("memory", (0.0, 0.0, 0.0)))
        for axis, part in enumerate(_MEMORY * component.row.remembers * np.eye(3)):
            perturbed[f"memory {axis}"] = {**setting, "memory": tuple((memory + part).tolist())}
    return perturbed


def with_setting_slopes(
    component: Component, context: Context, value: Array, perturbed: Mapping[str, Setting]
) -> Component | None:
    """An effect with its slopes at these coefficients as further columns, behind its own.

    Coefficients of slopes are in units of the changes in `perturbed`.  None if that is empty or the
    component is not in the library.
    """
    if component.row is None or not perturbed:
        return None
    shifted = [component.row.columns(context, setting) for setting in perturbed.values()]
    here = component.row.columns(context, component.setting)
    mag = _with_slopes(component.columns.mag, here.mag, [each.mag for each in shifted], value)
    gyro = _with_slopes(component.columns.gyro, here.gyro, [each.gyro for each in shifted], value)
    largest = component.law.log_variance(component.law.high)
    law = FixedLaw(
        np.concatenate([np.exp(largest), np.full(len(perturbed), priors.SETTING_OFF**2)])
    )
    key = (
        f"{component.key}, open in {', '.join(perturbed)} at {np.array2string(value, precision=6)}"
    )
    return replace(component, key=key, columns=Columns(mag, gyro), law=law)


def _with_slopes(
    own: Array | None, here: Array | None, shifted: list[Array | None], value: Array
) -> Array | None:
    """(N, 3, p + k) columns of one sensor and their slopes."""
    if own is None or here is None:
        return None
    slopes = [(each - here) @ value for each in shifted if each is not None]
    return np.concatenate([own, np.stack(slopes, axis=2)], axis=2)
