"""The memory that iron has from before the recording, along each axis, fitted given a model.

The middle of a play operator, or how far viscous iron lags the field, at the start of the recording
(setting `memory`) is not a coefficient: it is in the columns.  Near its present value the columns
change linearly with it, and one step leads to the memory of the largest posterior.  Where they do
not (a play that has reached its end) each axis is changed separately.  All of it is done at the
sensor's own noise: at a higher noise level, what is not yet explained still counts as noise.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis.effects.effect import Setting
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.likelihood.candidates import CandidateScan
from ahrsd.diagnosis.inference.search.near_settings import perturbed_settings, with_setting_slopes
from ahrsd.samples import Array

#: digits to which the memory is rounded, relative to the largest one
_DIGITS = 3


def memory_settings(scan: CandidateScan, component: Component, round_: int) -> list[Setting]:
    """Settings of an effect with another memory, nearer in each round; none if it has no memory."""
    row = component.row
    if row is None or not row.remembers:
        return []
    most, memory = row.remembers, np.array(component.setting.get("memory", (0.0, 0.0, 0.0)))
    axis_steps = memory + np.vstack([np.eye(3), -np.eye(3)]) * most / 2**round_
    proposals = np.clip(
        np.vstack([axis_steps, memory + _memory_step(scan, component, memory)]), -most, most
    )
    proposals = np.round(proposals / most, _DIGITS) * most
    kept = {tuple(each) for each in proposals.tolist()} - {tuple(memory.tolist())}
    return [{**component.setting, "memory": each} for each in sorted(kept)]


def _memory_step(scan: CandidateScan, component: Component, memory: Array) -> Array:
    """(3,) the linear step to the most probable memory."""
    context = scan.made.context
    perturbed = {
        k: each
        for k, each in perturbed_settings(component, context).items()
        if k.startswith("memory")
    }
    with_slopes = with_setting_slopes(component, context, scan.estimate(component)[0], perturbed)
    if with_slopes is None:
        return np.zeros(3)
    parts = np.array([each["memory"] for each in perturbed.values()]) - memory
    return np.asarray(scan.estimate(with_slopes)[0][-len(perturbed) :] @ parts)
