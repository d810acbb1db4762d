"""Errors of the gyro."""

from __future__ import annotations

import numpy as np

from blind_trials.world.chain import Planted, gyroscope, nine, xyz
from blind_trials.world.motion import DEG
from blind_trials.world.on_sensor import after, ceiling, moment, stepped
from blind_trials.world.rotations import direction, to_body
from blind_trials.world.world import BEFORE_S

EARTH_RAD_S = 7.292115e-5


def gyro_scale(world, stages, strength, rng):
    """Scale factors."""
    scale = direction(rng) * strength
    stages.rate.append(lambda w: w * (1 + scale))
    return Planted("gyro", xyz("scale", scale, "1"))


def gyro_nonorthogonality(world, stages, strength, rng):
    """Axes that are not at right angles."""
    yz, xz, xy = direction(rng) * strength
    S = np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
    stages.rate.append(lambda w: w + w @ S.T)
    return Planted(
        "gyro",
        tuple((f"shear_{n}", float(v), "rad") for n, v in (("xy", xy), ("xz", xz), ("yz", yz))),
    )


def gyro_g_sensitivity(world, stages, strength, rng):
    """A rate that follows specific force; strength in rad/s per m/s^2."""
    G = rng.normal(size=(3, 3))
    G *= strength / np.linalg.norm(G) * np.sqrt(3)
    stages.gyro_bias.append(world.motion.force_b @ G.T)
    return Planted("gyro", nine("per_g", 9.81 * G, "rad/s/g"))


def vibration_rectification(world, stages, strength, rng):
    """A rate that follows the vibration's power; strength at the strongest."""
    bias = direction(rng) * strength
    power = (world.vibration / world.vibration.max()) ** 2
    stages.gyro_bias.append(power[:, None] * bias)
    return Planted("gyro")


def gyro_bias_temperature(world, stages, strength, rng):
    """A bias that follows temperature, rad/s per degree."""
    per_degree = direction(rng) * strength
    stages.gyro_bias.append((world.temperature - world.temperature.mean())[:, None] * per_degree)
    return Planted("gyro", xyz("per_degree", per_degree, "rad/s/degC"))


def gyro_bias_drift(world, stages, strength, rng):
    """A bias that walks at random; strength is the standard deviation at the end."""
    t = world.time_s
    knots = np.arange(0, t[-1] + 2)
    walk = np.cumsum(rng.normal(size=(len(knots), 3)), axis=0) * strength / np.sqrt(len(knots))
    stages.gyro_bias.append(np.stack([np.interp(t, knots, walk[:, i]) for i in range(3)], axis=1))
    return Planted("gyro")


def gyro_bias_step(world, stages, strength, rng):
    """A shock or a re-zeroing on board."""
    t0, step = moment(world, rng), direction(rng) * strength
    stages.gyro_bias.append(after(world, t0)[:, None] * step)
    return stepped(world, t0, "gyro", xyz("step", step, "rad/s"))


def gyro_nonlinearity(world, stages, strength, rng):
    """Scale that depends on the size of the rate; strength at 1 rad/s."""
    size = direction(rng) * strength
    stages.rate.append(lambda w: w + size * np.abs(w) * w)
    return Planted("gyro", xyz("per_rate", size, "s/rad"))


def gyro_saturation(world, stages, strength, rng):
    """The converter ends where a share `strength` of the readings, on one axis, would be larger."""

    def edit(rows):
        rows.gyro = np.clip(rows.gyro, -limit, limit)
        return rows

    limit = ceiling(gyroscope(world, stages), strength)
    stages.edits.append(edit)
    return Planted("gyro", (("limit", limit, "rad/s"),))


def earth_rotation(world, stages, strength, rng):
    """What a gyro reads of the Earth's own rotation; strength in rad/s, it has but one value."""
    latitude = rng.uniform(-70, 70) * DEG
    rate_n = strength * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])
    stages.gyro_bias.append(to_body(world.motion.R_nb, rate_n))
    return Planted(
        "gyro", (("north", float(rate_n[0]), "rad/s"), ("down", float(rate_n[2]), "rad/s"))
    )


def gyro_integration(world, stages, strength, rng):
    """The rate at the instant of the sample instead of its mean over the step."""
    stages.gyro_at_instant = True
    return Planted("gyro")


def gyro_startup(world, stages, strength, rng):
    """A bias that settles after power-on."""
    bias, tau = direction(rng) * strength, rng.uniform(25, 80)
    stages.gyro_bias.append(np.exp(-(world.time_s - BEFORE_S) / tau)[:, None] * bias)
    return Planted("gyro", xyz("at_start", bias, "rad/s"))


def gyro_time_lag(world, stages, strength, rng):
    """A delay of the gyro."""
    stages.gyro_delay_s += strength
    return Planted("gyro", (("lag", strength, "s"),))
