"""A quick source of one direction, as what a set leaves shows it.

Noise of a colour is as loud along each axis, and swallows what is quicker than a course: iron that
moves, a current.  Such a source rides with the vehicle or stands in the world, along one direction:

    x(t) = u sum_k w_k cos(pi k (t - t0) / T),    k up to MOST

The direction is that along which the residual is loudest, where that is beyond chance.  Along the
field and across it noise differs: across, a filter follows what is slow.  So the residual is first
made as loud along as across.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import dct

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.components.gaussian_process import CourseLaw
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.model import Columns, Context, directions
from ahrsd.diagnosis.where_and_when.locate import Frame, unit_columns
from ahrsd.samples import Array

#: frames in which it is asked
FRAMES: tuple[Frame, ...] = ("sensor", "world")
#: half waves among which the residual is held to be alike on all axes;  of the source, so many
#: times as many, but no more than MOST
_AMONG, _TIMES, MOST = (30, 60, 120, 200), 2, 200


def one_direction(all_sets: Hypotheses, here: Hypothesis) -> list[Component]:
    """What a set leaves along one direction, in each frame; none where it is alike along all."""
    made = all_sets.made
    left = made.left_by(here.keys, here.at) / made.point.loud.amplitude[:, None]
    left = np.where(made.point.filtered.used[:, None], left, 0.0)
    among = [count for count in _AMONG if count <= len(left) // 4]
    even = {count: as_loud_along(left, made.context.field_b, count) for count in among}
    found = []
    for frame in FRAMES:
        axes = unit_columns(made.context, frame)
        turned = {count: np.einsum("nia,ni->na", axes, one) for count, one in even.items()}
        seen = {count: unalike(_slow(one, count)) for count, one in turned.items()}
        count = max(seen, key=lambda one: seen[one][0], default=0)
        if count and seen[count][0] > priors.UNALIKE:
            found.append(along(made.context, frame, seen[count][1], min(_TIMES * count, MOST)))
    return found


def _slow(left: Array, count: int) -> Array:
    """The first so many cosines of a residual, but for the constant."""
    return np.asarray(dct(left, axis=0, norm="ortho")[1 : count + 1])


def as_loud_along(left: Array, field_b: Array, count: int) -> Array:
    """A residual (N, 3) with as much power along the field as on each axis across, of its cosines.

    field_b: (N, 3), none where it is not known;  count: of the cosines
    """
    unit = directions(field_b)
    along = np.sum(left * unit, axis=1, keepdims=True) * unit
    own, across = (float(np.sum(_slow(one, count) ** 2)) for one in (along, left - along))
    return np.asarray(left - along + along * np.sqrt(across / 2.0 / max(own, 1e-300)))


def unalike(rows: Array) -> tuple[float, Array]:
    """Nats by which rows (n, 3) have a covariance and not one power; the loudest direction."""
    powers, axes = np.linalg.eigh(rows.T @ rows / len(rows))
    powers = np.maximum(powers, 1e-300)
    nats = 0.5 * len(rows) * (3.0 * np.log(np.mean(powers)) - np.sum(np.log(powers)))
    return float(nats), axes[:, -1]


def along(context: Context, frame: Frame, direction: Array, count: int) -> Component:
    """A course of so many half waves along one direction (3,) of a frame."""
    time_s, order = context.track.time_s, np.arange(1, count + 1)
    phase = np.pi * (time_s - time_s[0]) / (time_s[-1] - time_s[0])
    axis = unit_columns(context, frame) @ direction
    columns = Columns(mag=axis[:, :, None] * np.cos(phase[:, None] * order)[:, None, :])
    corners = (priors.COURSE_CORNERS[0], float(count))
    law = CourseLaw(order.astype(float), priors.COURSE_UNIT[frame], corners=corners)
    odds = float(np.log(priors.COURSE) - np.log(priors.DIRECTIONS))
    x, y, z = (round(float(part), 3) for part in direction)
    return Component(f"{frame} along {x} {y} {z}, {count} half waves", frame, columns, law, odds)
