"""Effects that no list has: an honest tool says that it does not know them."""

from __future__ import annotations

import numpy as np

from blind_trials.world.chain import Planted
from blind_trials.world.in_world import dipole, strong_spans
from blind_trials.world.on_sensor import moment, stepped
from blind_trials.world.rotations import direction
from blind_trials.world.world import BEFORE_S, low_passed


def turret(world, stages, strength, rng):
    """A turret that counter-rotates: a body field with the fourth harmonic of the heading."""
    phase = (4 * world.motion.yaw)[:, None]
    stages.body.append(strength * (np.cos(phase) * direction(rng) + np.sin(phase) * direction(rng)))
    return Planted("sensor")


def bursts(world, stages, strength, rng):
    """Half-sine pulses of half a second to two, each in a direction of its own."""
    t = world.time_s
    field, spans, at = np.zeros((len(t), 3)), [], BEFORE_S + rng.uniform(10, 40)
    while at < t[-1] - 3:
        length = rng.uniform(0.5, 2.0)
        inside = (t >= at) & (t < at + length)
        shape = np.sin(np.pi * (t[inside] - at) / length)
        field[inside] = shape[:, None] * direction(rng) * strength * rng.uniform(0.7, 1.3)
        spans.append((float(at - BEFORE_S), float(at + length - BEFORE_S)))
        at += rng.exponential(25) + 5
    stages.body.append(field)
    return Planted("sensor", intervals_s=tuple(spans))


def passing_object(world, stages, strength, rng):
    """A vehicle drives by: a dipole that moves past within about fifteen seconds."""
    t = world.time_s
    t0, speed = moment(world, rng), rng.uniform(0.4, 0.8)
    sideways = direction(rng)
    sideways -= np.array([0.0, 0.0, sideways[2]]) * 0.5
    ahead = np.cross(sideways, direction(rng))
    ahead /= np.linalg.norm(ahead)
    away = 3.0 * sideways / np.linalg.norm(sideways) + (speed * (t - t0))[:, None] * ahead
    field = dipole(-away, direction(rng))
    field *= strength / np.max(np.linalg.norm(field, axis=1))
    stages.field_n.append(field)
    return Planted("world", intervals_s=strong_spans(world, field))


def bent_mount(world, stages, strength, rng):
    """The mount bends with temperature: a misalignment that grows, rad at the warmest."""
    warmth = (world.temperature - world.temperature[0]) / np.ptp(world.temperature)
    stages.mount.append(warmth[:, None] * direction(rng) * strength)
    return Planted("sensor")


def two_states(world, stages, strength, rng):
    """Iron with two states: it flips when the field along it passes a threshold."""
    along = direction(rng)
    threshold = rng.uniform(0.3, 0.6)

    def flipping(h):
        projected = h @ along
        low, high = np.percentile(projected, [0, 100])
        middle, half = 0.5 * (low + high), 0.5 * (high - low) * threshold
        sign = np.zeros(len(h))
        sign[projected > middle + half] = 1.0
        sign[projected < middle - half] = -1.0
        known = np.maximum.accumulate(np.where(sign != 0, np.arange(len(h)), 0))
        return strength * sign[known][:, None] * direction_of_field

    direction_of_field = direction(rng)
    stages.from_field.append(flipping)
    return Planted("sensor")


def asymmetric_scale(world, stages, strength, rng):
    """A gyro whose scale differs between the two senses of rotation."""
    size = direction(rng) * strength
    stages.rate.append(lambda w: w + size * np.abs(w))
    return Planted("gyro")


def unlogged_switch(world, stages, strength, rng):
    """A device that nobody logged goes on and off, on its own clock."""
    t = world.time_s
    state, at, on = np.zeros_like(t), BEFORE_S + rng.uniform(15, 50), True
    spans = []
    while at < t[-1]:
        end = min(at + rng.uniform(15, 60), t[-1])
        if on:
            state[(t >= at) & (t < end)] = 1.0
            spans.append((float(at - BEFORE_S), float(end - BEFORE_S)))
        at, on = end + 1e-3, not on
    stages.body.append(low_passed(state, 0.2)[:, None] * direction(rng) * strength)
    return Planted("sensor", intervals_s=tuple(spans))


def gyro_bump(world, stages, strength, rng):
    """A gyro bias that comes and goes smoothly within 40 s."""
    t0 = moment(world, rng)
    x = np.clip((world.time_s - t0) / 40.0, 0.0, 1.0)
    stages.gyro_bias.append(np.sin(np.pi * x)[:, None] ** 2 * direction(rng) * strength)
    begin = t0 - BEFORE_S
    end = min(begin + 40.0, world.time_s[-1] - BEFORE_S)
    planted = stepped(world, t0, "gyro", ())
    return Planted("gyro", (), planted.onset_s, ((begin, end),))
