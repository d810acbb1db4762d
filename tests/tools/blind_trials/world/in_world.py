"""Effects of sources that stay outside: they turn with the attitude."""

from __future__ import annotations

import numpy as np

from blind_trials.world.chain import Planted
from blind_trials.world.on_sensor import after, moment, share, stepped, symmetric
from blind_trials.world.rotations import direction
from blind_trials.world.world import BEFORE_S

_WAYS = ("north", "east", "down")


def dipole(away, moment_vector):
    """Field of a dipole at displacements (N, 3), up to a constant factor."""
    r = np.linalg.norm(away, axis=1, keepdims=True)
    n = away / r
    return (3 * n * (n @ moment_vector)[:, None] - moment_vector) / r**3


def strong_spans(world, field_n, part=0.2):
    """Intervals, on the recording's clock, in which a field is above a part of its peak."""
    size = np.linalg.norm(field_n, axis=1)
    inside = np.concatenate([[False], size > part * size.max(), [False]])
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    t = np.append(world.time_s, world.time_s[-1]) - BEFORE_S
    return tuple((max(0.0, float(t[a])), float(t[b])) for a, b in zip(edges[::2], edges[1::2]))


def north_east_down(name, vector, unit):
    """Parameters of a vector in the world."""
    return tuple((f"{name}_{way}", float(v), unit) for way, v in zip(_WAYS, vector))


def field_gradient(world, stages, strength, rng):
    """A field that changes from place to place, gauss per metre."""
    G = strength * symmetric(rng)
    stages.field_n.append((world.motion.position_n - world.motion.position_n.mean(axis=0)) @ G.T)
    names = ("nn", "ne", "nd", "ee", "ed")
    values = (G[0, 0], G[0, 1], G[0, 2], G[1, 1], G[1, 2])
    return Planted("world", tuple((n, float(v), "gauss/m") for n, v in zip(names, values)))


def field_anomaly(world, stages, strength, rng):
    """An iron object beside the track; strength is the field at the closest point."""
    p = world.motion.position_n
    near = p[np.argmin(np.abs(world.time_s - moment(world, rng)))]
    place = near + direction(rng) * rng.uniform(2.0, 4.0)
    field = dipole(p - place, direction(rng))
    field *= strength / np.max(np.linalg.norm(field, axis=1))
    stages.field_n.append(field)
    return Planted("world", intervals_s=strong_spans(world, field))


def geomagnetic_drift(world, stages, strength, rng):
    """The Earth's field changes over the recording."""
    drift = direction(rng) * strength
    stages.field_n.append(share(world)[:, None] * drift)
    return Planted("world", north_east_down("change", drift, "gauss"))


def altitude_field(world, stages, strength, rng):
    """A field that follows the height above ground, gauss per metre."""
    per_metre = direction(rng) * strength
    down = world.motion.position_n[:, 2]
    stages.field_n.append(-(down - down.mean())[:, None] * per_metre)
    return Planted("world", north_east_down("per_metre", per_metre, "gauss/m"))


def field_step(world, stages, strength, rng):
    """Iron beside the vehicle is left behind, or comes."""
    t0, step = moment(world, rng), direction(rng) * strength
    stages.field_n.append(after(world, t0)[:, None] * step)
    return stepped(world, t0, "world", north_east_down("step", step, "gauss"))
