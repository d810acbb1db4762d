"""Names held against free forms of the same kind.

A name predicts a form: a coefficient that stays the same, an error that grows with the rate in one
way.  What has another form is explained in part by the names that are nearest to it.  So
every name is compared with

    drift     its own columns with a coefficient that changes with time
    parts     its own columns with a coefficient for every sixth of what it explains
    rate      an error of the gyro that depends on the rates in any way
    memory    a field in sensor axes that depends on where the field has been: relays (Preisach's
              model of hysteresis) in directions all over the sphere
    matrix    a mount, soft iron or scales that change slowly: a matrix on the field, any in time,
              about one that stays
    shape     of a curved reading: a field in sensor axes that depends on the field's direction in
              any smooth way, as one does that goes with the vehicle's heading
    spell     of a jump or a bump of the field outside: an error of the gyro for a while around it

each a random effect whose size is found by marginal likelihood, which makes it pay for its
coefficients.  Where a free form is more likely than the name, or is there beside it and takes most
of what it explained, the name only stood in for it.  A course in time has its own test
(`stand_ins`).  Where more is left than the names explain, any form finds something of it beside
them: there it must be more likely by itself, and a coefficient may jump.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import combinations_with_replacement, product

import numpy as np

from ahrsd.diagnosis.rules.discrepancy import (
    UNIT_GAUSS,
    UNIT_RAD_S,
    by_rate,
    every_direction,
    fitted,
)
from ahrsd.diagnosis.rules.findings import added_value
from ahrsd.diagnosis.rules.regression import Base, Candidate
from ahrsd.diagnosis.rules.search import STEPS, State, term_group, without_term
from ahrsd.diagnosis.rules.together import projected
from ahrsd.diagnosis.rules.unknown import Remainder
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.diagnosis.where_and_when.locate import frame_columns
from ahrsd.samples import Array

#: nats by which a free form must be more than the name: odds of 1000 to 1
MORE_NATS = 7.0
#: and by this part of the name's own evidence: no form of ours is exact to a thousandth of its size
MORE_SHARE = 0.01
#: part of a name's evidence that must be left beside a free form that is there too
OWN_SHARE = 0.5
PARTS = 6
#: where relays flip, in parts of the field's range along their direction
RELAYS = (0.3, 0.55)
#: half waves in time with which a matrix may change
SLOW = 3
#: the name of a turn of the mount that stays: none is held against itself
MOUNT = "mag_gyro_misalignment"
#: names of a reading that is curved in the field, and degrees of a smooth function of direction
CURVED = ("mag_nonlinearity", "mag_cross_axis")
DEGREES = (3, 4)
#: reach of a spell to either side, and its stretches, seconds
SPELL_S, STRETCH_S = 60.0, 10.0
_SMALL = -5.0  # logarithm of a deviation to begin with: next to nothing


def of_another_form(
    state: State, basis: Base, courses: Collection[str], *, beside: bool = False
) -> list[int]:
    """Numbers of the terms whose names only stand in for something of another form.

    courses: names that are a course in time and nothing else
    beside: whether more is left than the names explain
    """
    noise, context = max(1.0, basis.colour), basis.context
    columns = basis.whitened(
        [by_rate(context), by_memory(context), by_matrix(context), by_mount(context)]
    )
    units = (UNIT_RAD_S, UNIT_GAUSS, UNIT_GAUSS, UNIT_GAUSS)
    *free, changing, mount = [part * unit for part, unit in zip(columns, units, strict=True)]
    bending = np.concatenate([mount, changing], axis=2)
    out = []
    for k, name in enumerate(state.names):
        scale = state.named[k].candidate.scale
        mine = basis.known[:, :, basis.groups[term_group(k)]] * scale
        left = without_term(state, k, basis)
        own = [] if name in courses else _varied(mine, added_value(state, k) / scale)
        own = own[:1] if beside else own
        spell = _spell(basis, state.named[k].candidate, mine)
        matrix = changing if name == MOUNT else bending
        shape = [_shape(basis)] if name in CURVED else []
        others = (*free, matrix, *spell, *shape)
        if any(_rivals(left, mine, part, noise, 1.0) for part in own) or any(
            _rivals(left, mine, part, noise, OWN_SHARE, alone=beside) for part in others
        ):
            out.append(k)
    return out


def of_the_rate(left: Remainder) -> Remainder:
    """The remainder, told of the gyro where an error that depends on the rates explains it best.

    Best: by itself more than the strongest frame's course, of which little is left beside it.
    What moves a vehicle draws a current, so that a course may look as if it followed the rates; and
    beside a course of a real recording, an error by the rates finds something of its own.
    """
    basis, best = left.basis, left.strongest
    if left.stood_in is not None or best.frame == "gyro":
        return left
    course = frame_columns(basis.context, best.frame, best.cut)
    mine, rate = basis.whitened([course, by_rate(basis.context)])
    noise = max(1.0, basis.colour)
    name, form, both = compared(basis, mine * UNIT_GAUSS, rate * UNIT_RAD_S, noise)
    name = max(name, best.evidence)
    if form > name + more(name) and both - form < OWN_SHARE * name:
        gyro = replace(left.located["gyro"], evidence=form)
        located = {**left.located, "gyro": gyro}
        return replace(left, located=located, stood_in="gyro", spells_s=())
    return left


def compared(left: Base, mine: Array, other: Array, noise: float) -> tuple[float, float, float]:
    """Nats of a name's columns (N, 3, p), of a free form's (N, 3, q), and of both together."""
    p, q = mine.shape[2], other.shape[2]
    G, s = projected(left, np.concatenate([mine, other], axis=2))
    group = np.repeat(np.array([0, 1], dtype=np.intp), [p, q])
    own, free = slice(0, p), slice(p, p + q)
    name, _ = fitted(G[own, own], s[own], group[own], noise, np.zeros(1))
    form, _ = fitted(G[free, free], s[free], group[free] - 1, noise, np.zeros(1))
    starts = (np.zeros(2), np.array([0.0, _SMALL]))
    return name, form, max(fitted(G, s, group, noise, start)[0] for start in starts)


def _rivals(
    left: Base, mine: Array, other: Array, noise: float, share: float, *, alone: bool = False
) -> bool:
    """Whether a free form is more than the name, which keeps less than `share` beside it.

    alone: the form without the name
    """
    name, form, both = compared(left, mine, other, noise)
    most = form if alone else max(form, both)
    return most > name + more(name) and both - form < share * name


def more(name: float) -> float:
    """Nats by which a form must be more than a name of so many."""
    return MORE_NATS + MORE_SHARE * max(name, 0.0)


def _spell(basis: Base, name: Candidate, mine: Array) -> list[Array]:
    """Whitened columns of an error of the gyro around a jump or a bump of the field outside.

    A bias that comes and goes turns the carried field away and leaves it there: a field that jumped
    halfway through it explains half of that, a bump some.  Of a jump or a bump, an error of the
    gyro that lasts explains little.
    mine: (N, 3, p) the name's columns
    """
    if name.name == STEPS["world"]:
        moment_s = name.setting["onset_s"]
    elif name.name == "field_anomaly":
        power = np.cumsum(np.sum(mine**2, axis=(1, 2)))
        moment_s = basis.context.track.time_s[np.searchsorted(power, power[-1] / 2)]
    else:
        return []
    (columns,) = basis.whitened([by_spell(basis.context, moment_s)])
    return [np.asarray(columns * UNIT_RAD_S)]


def by_spell(context: Context, moment_s: float) -> Columns:
    """An error of the gyro in stretches around a moment."""
    edges = moment_s + np.arange(-SPELL_S, SPELL_S + 1.0, STRETCH_S)
    stretch = np.searchsorted(edges, context.track.time_s, side="right")
    inside = stretch[:, None] == np.arange(1, len(edges))
    return every_direction(inside[:, inside.any(axis=0)].astype(float), gyro=True)


def _varied(columns: Array, value: Array) -> list[Array]:
    """Columns (N, 3, p) of the value (p,) with coefficients that drift, and that jump."""
    slow = np.cos(np.linspace(0.0, np.pi, len(columns)))[:, None, None]
    power = np.cumsum(np.sum((columns @ value) ** 2, axis=1))
    part = np.minimum((PARTS * power / max(float(power[-1]), 1e-300)).astype(int), PARTS - 1)
    cut = [np.where((part == k)[:, None, None], columns, 0.0) for k in range(PARTS)]
    return [np.concatenate([columns, slow * columns], axis=2), np.concatenate(cut, axis=2)]


def by_memory(context: Context) -> Columns:
    """A field in sensor axes by relays along thirteen directions."""
    corners = [np.array(v, float) for v in product((-1, 0, 1), repeat=3) if v > (0, 0, 0)]
    along = context.field_b @ np.column_stack([v / np.linalg.norm(v) for v in corners])
    values = np.column_stack([_relay(one, part) for one in along.T for part in RELAYS])
    return every_direction(values - values.mean(axis=0))


def _relay(along: Array, part: float) -> Array:
    """(N,) 1 since `along` was last above a threshold, -1 since below its opposite, 0 before."""
    middle, half = (along.max() + along.min()) / 2, part * np.ptp(along) / 2
    sign = np.where(along > middle + half, 1.0, np.where(along < middle - half, -1.0, 0.0))
    last = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign)), 0))
    return np.asarray(sign[last])


def by_matrix(context: Context) -> Columns:
    """The field times a matrix that changes slowly with time."""
    phase = np.linspace(0.0, np.pi, len(context.field_b))
    slow = np.cos(phase[:, None] * np.arange(1, SLOW + 1))
    values = slow[:, :, None] * context.field_b[:, None, :]
    return every_direction(values.reshape(len(phase), -1))


def _shape(basis: Base) -> Array:
    """Whitened columns of a field that depends on the field's direction."""
    return np.asarray(basis.whitened([by_shape(basis.context)])[0] * UNIT_GAUSS)


def by_shape(context: Context) -> Columns:
    """A field in sensor axes by products of three and four components of the field's direction.

    Lower degrees are the calibration and, on a sphere, contained in these.
    """
    unit = context.field_b / np.linalg.norm(context.field_b, axis=1, keepdims=True)
    chosen = [one for degree in DEGREES for one in combinations_with_replacement(range(3), degree)]
    values = np.column_stack([np.prod(unit[:, one], axis=1) for one in chosen])
    return every_direction(values - values.mean(axis=0))


def by_mount(context: Context) -> Columns:
    """The field times a matrix that stays: where a mount that bends is, on the average."""
    return every_direction(context.field_b)
