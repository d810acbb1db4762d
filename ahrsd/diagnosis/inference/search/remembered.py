"""What iron has from before the recording, along each axis, sought beside a model.

The middle of a play operator, or what is behind by when the recording begins (setting `memory`), is
no coefficient: it is in the columns.  Near where it is sought its change is linear, and the
likeliest change beside the coefficients is one step; where it is not (a play that has met its end)
each axis is moved by itself.  All of it in the sensor's own noise: what is not yet explained is
noise still.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.effects.effect import Setting
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.likelihood.candidates import Beside
from ahrsd.diagnosis.inference.search.near_settings import perturbed_settings, with_setting_slopes
from ahrsd.samples import Array

#: digits to which it is sought, of what may be remembered
_DIGITS = 3


def memory_settings(scan: Beside, one: Component, round_: int) -> list[Setting]:
    """Settings of an effect with another memory, nearer by the round; none where it has none."""
    row = one.row
    if row is None or not row.remembers:
        return []
    most, memory = row.remembers, np.array(one.setting.get("memory", (0.0, 0.0, 0.0)))
    axis_steps = memory + np.vstack([np.eye(3), -np.eye(3)]) * most / 2**round_
    proposals = np.clip(
        np.vstack([axis_steps, memory + _memory_step(scan, one, memory)]), -most, most
    )
    proposals = np.round(proposals / most, _DIGITS) * most
    kept = {tuple(each) for each in proposals.tolist()} - {tuple(memory.tolist())}
    return [{**one.setting, "memory": each} for each in sorted(kept)]


def _memory_step(scan: Beside, one: Component, memory: Array) -> Array:
    """(3,) to the likeliest memory as it is seen from here."""
    context = scan.made.context
    perturbed = {
        k: each for k, each in perturbed_settings(one, context).items() if k.startswith("memory")
    }
    with_slopes = with_setting_slopes(one, context, scan.likeliest(one)[0], perturbed)
    if with_slopes is None:
        return np.zeros(3)
    parts = np.array([each["memory"] for each in perturbed.values()]) - memory
    return np.asarray(scan.likeliest(with_slopes)[0][-len(perturbed) :] @ parts)
