"""What iron has from before the recording, along each axis, sought beside a model.

The middle of a play operator, or what is behind by when the recording begins (setting `memory`), is
no coefficient: it is in the columns.  Near where it is sought its change is linear,

    columns(m + d) w = columns(m) w + sum_i d_i (d columns / d m_i) w,

and the likeliest d beside w is one step; where it is not (a play that has met its end) each axis is
moved by itself.  All of it in the sensor's own noise: what is not yet explained is noise still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.effects.base import Effect, Setting
from ahrsd.diagnosis.one_model.component import Component, Fixed
from ahrsd.diagnosis.one_model.model_search import Beside
from ahrsd.diagnosis.values import Columns
from ahrsd.samples import Array

#: part of what may be remembered by which columns are changed for their slopes
_SLOPE = 0.01
#: digits to which it is sought, of what may be remembered
_DIGITS = 3


def remembered(scan: Beside, one: Component, round_: int) -> list[Setting]:
    """Settings of an effect with another memory, nearer by the round; none where it has none."""
    row = one.row
    if row is None or not row.remembers:
        return []
    memory = np.array(one.setting.get("memory", (0.0, 0.0, 0.0)))
    moved = memory + np.vstack([np.eye(3), -np.eye(3)]) * row.remembers / 2**round_
    found = np.vstack([moved, memory + _step(scan, one, row, memory)])
    found = np.clip(found, -row.remembers, row.remembers)
    found = np.round(found / row.remembers, _DIGITS) * row.remembers
    kept = {tuple(each) for each in found.tolist()} - {tuple(memory.tolist())}
    return [{**one.setting, "memory": each} for each in sorted(kept)]


def _step(scan: Beside, one: Component, row: Effect, memory: Array) -> Array:
    """(3,) to the likeliest memory as it is seen from here."""
    value = scan.likeliest(one)
    here = _mag(row, scan, one.setting, memory)
    slopes = [
        (_mag(row, scan, one.setting, memory + part) - here) @ value / np.max(part)
        for part in _SLOPE * row.remembers * np.eye(3)
    ]
    both = np.concatenate([here, np.stack(slopes, axis=2)], axis=2)
    largest = np.exp(0.5 * one.law.log_variance(one.law.high))
    law = Fixed(np.square([*largest, *np.full(3, row.remembers)]))
    key = f"{one.key} and its memory"
    return scan.likeliest(replace(one, key=key, columns=Columns(mag=both), law=law))[-3:]


def _mag(row: Effect, scan: Beside, setting: Setting, memory: Sequence[float] | Array) -> Array:
    """(N, 3, p) gauss per unit of the coefficients."""
    there = {**setting, "memory": tuple(float(each) for each in memory)}
    found = row.columns(scan.made.context, there).mag
    if found is None:
        raise ValueError(f"{row.identifier} is not of the magnetometer")
    return found
