"""Effects of sources that ride with the vehicle, and of the magnetometer itself."""

from __future__ import annotations

import numpy as np

from blind_trials.world.chain import Planted, magnetometer, nine, six, xyz
from blind_trials.world.motion import STEP_S
from blind_trials.world.rotations import direction
from blind_trials.world.world import BEFORE_S, low_passed

_SCALE_G = 0.5  # the field at which strengths of nonlinear terms are meant


def symmetric(rng):
    """A symmetric traceless matrix of norm 1."""
    a = rng.normal(size=(3, 3))
    a = a + a.T
    a -= np.eye(3) * np.trace(a) / 3
    return a / np.linalg.norm(a)


def moment(world, rng):
    """An instant in the middle six tenths of the recording, on the world's clock."""
    return BEFORE_S + rng.uniform(0.2, 0.8) * (world.time_s[-1] - BEFORE_S)


def after(world, t0):
    """1 from t0 on."""
    return (world.time_s >= t0).astype(float)


def share(world):
    """0 at the first sample, 1 at the last."""
    t = world.time_s
    return (t - BEFORE_S) / (t[-1] - BEFORE_S)


def ceiling(readings, part):
    """The size that a part of the readings exceeds on the axis that exceeds it most."""
    return float(np.max(np.quantile(np.abs(readings), 1 - part, axis=0)))


def stepped(world, t0, frame, parameters):
    """The key's entry of something that begins at t0 and stays."""
    onset = t0 - BEFORE_S
    return Planted(frame, parameters, onset, ((onset, world.time_s[-1] - BEFORE_S),))


def _follows(world, stages, strength, rng, signal, unit):
    """A field along one direction that follows a signal; `strength` at its extreme."""
    per_unit = direction(rng) * strength / np.max(np.abs(signal))
    stages.body.append(signal[:, None] * per_unit)
    return Planted("sensor", xyz("field", per_unit, unit))


def hard_iron_step(world, stages, strength, rng):
    """A payload moved."""
    t0, step = moment(world, rng), direction(rng) * strength
    stages.body.append(after(world, t0)[:, None] * step)
    return stepped(world, t0, "sensor", xyz("step", step, "gauss"))


def hard_iron_drift(world, stages, strength, rng):
    """Magnetisation that creeps."""
    drift = direction(rng) * strength
    stages.body.append(share(world)[:, None] * drift)
    return Planted("sensor", xyz("change", drift, "gauss"))


def soft_iron_step(world, stages, strength, rng):
    """Soft iron came or went."""
    t0 = moment(world, rng)
    dA = strength * symmetric(rng)
    stages.soft_iron.append((after(world, t0), dA))
    return stepped(world, t0, "sensor", six("change", dA, "1"))


def motor_current_field(world, stages, strength, rng):
    """Ampere's field of the main motor's lead."""
    return _follows(world, stages, strength, rng, world.current, "gauss/A")


def yaw_current_field(world, stages, strength, rng):
    """The same of the yaw thruster, whose current follows the heading's acceleration."""
    return _follows(world, stages, strength, rng, world.yaw_current, "gauss/A")


def current_derivative_field(world, stages, strength, rng):
    """Induced by the change of the main current."""
    slope = np.gradient(world.current, STEP_S)
    return _follows(world, stages, strength, rng, slope, "gauss s/A")


def speed_field(world, stages, strength, rng):
    """A source that follows speed."""
    return _follows(world, stages, strength, rng, world.motion.speed, "gauss s/m")


def switched_device(world, stages, strength, rng):
    """A lamp's field."""
    return _follows(world, stages, strength, rng, world.switch, "gauss")


def moving_iron(world, stages, strength, rng):
    """A magnet on a joint: its field turns with the joint."""
    axis = direction(rng)
    first = np.cross(axis, direction(rng))
    first /= np.linalg.norm(first)
    cosine, sine = strength * first, strength * np.cross(axis, first)
    psi = world.joint[:, None]
    stages.body.append(np.cos(psi) * cosine + np.sin(psi) * sine)
    return Planted("sensor", xyz("cosine", cosine, "gauss") + xyz("sine", sine, "gauss"))


def _line_hz(world, rng):
    """A frequency of 40 to 400 Hz whose alias at 25, 40 and 50 Hz is a line of its own."""
    while True:
        f = rng.uniform(40, 400)
        alias = [abs(f - fs * round(f / fs)) for fs in (25, 40, 50)]
        if all(0.8 < a < fs / 2 - 0.8 for a, fs in zip(alias, (25, 40, 50))):
            return f


def ac_interference(world, stages, strength, rng):
    """A speed controller's or the mains' alternating field, aliased by the sampling."""
    phase = 2 * np.pi * _line_hz(world, rng) * world.time_s + rng.uniform(0, 6.283)
    stages.body.append(np.cos(phase)[:, None] * direction(rng) * strength)
    return Planted("sensor")


def rotor_field(world, stages, strength, rng):
    """A magnetised rotor that runs at constant speed: a field that turns about its shaft."""
    shaft = direction(rng)
    first = np.cross(shaft, direction(rng))
    first /= np.linalg.norm(first)
    phase = (2 * np.pi * world.pump_hz * world.time_s)[:, None]
    turning = np.cos(phase) * first + np.sin(phase) * np.cross(shaft, first)
    stages.body.append(strength * turning)
    return Planted("sensor")


def sync_pulses(world, stages, strength, rng):
    """A sonar's pulses, 60 ms each."""
    every = rng.uniform(1.0, 3.0)
    on = (world.time_s + rng.uniform(0, every)) % every < 0.06
    stages.body.append(on[:, None] * direction(rng) * strength)
    return Planted("sensor")


def mag_bias_temperature(world, stages, strength, rng):
    """An offset that follows temperature; strength in gauss per degree."""
    per_degree = direction(rng) * strength
    stages.body.append((world.temperature - world.temperature.mean())[:, None] * per_degree)
    return Planted("sensor", xyz("per_degree", per_degree, "gauss/degC"))


def mag_scale_temperature(world, stages, strength, rng):
    """A sensitivity that follows temperature; strength per degree."""
    per_degree = direction(rng) * strength
    gain = np.diag(per_degree) @ world.soft_iron
    stages.soft_iron.append((world.temperature - world.temperature.mean(), gain))
    return Planted("sensor", xyz("per_degree", per_degree, "1/degC"))


def mag_cross_axis(world, stages, strength, rng):
    """The reading of an axis depends on the field across it; strength in gauss at 0.5 G."""
    size = strength * direction(rng)
    stages.electronics.append(lambda m: m + size * m * np.roll(m, 1, axis=1) / _SCALE_G**2)
    return Planted("sensor")


def mag_nonlinearity(world, stages, strength, rng):
    """Cubic; strength in gauss at 0.5 G."""
    size = strength * direction(rng)
    stages.electronics.append(lambda m: m + size * (m / _SCALE_G) ** 3)
    return Planted("sensor", xyz("cubic", size, "gauss"))


def mag_saturation(world, stages, strength, rng):
    """The converter ends where a share `strength` of the samples, on one axis, would be larger."""

    def edit(rows):
        rows.mag = np.clip(rows.mag, -limit, limit)
        return rows

    limit = ceiling(magnetometer(world, stages), strength)
    stages.edits.append(edit)
    return Planted("sensor", (("limit", limit, "gauss"),))


def mag_quantisation(world, stages, strength, rng):
    """A step of `strength` in the converter, behind the noise."""

    def edit(rows):
        rows.mag = np.round(rows.mag / strength) * strength
        return rows

    stages.edits.append(edit)
    return Planted("sensor", (("step", strength, "gauss"),))


def _play(values, width):
    last, out = values[0], []
    for now in values:
        last = min(max(last, now - width), now + width)
        out.append(last)
    return out


def hysteresis(world, stages, strength, rng):
    """Play: iron that follows the field only beyond a friction; amplitude is the strength."""
    width = rng.uniform(0.02, 0.05)
    weight = strength / width * np.abs(direction(rng)) * np.sqrt(3) / 1.2

    def play(m):
        every = 10  # play does not depend on the rate: 100 Hz follow these motions exactly enough
        coarse = m[::every]
        at, whole = np.arange(len(coarse)) * every, np.arange(len(m))
        follows = [np.interp(whole, at, _play(coarse[:, i].tolist(), width)) for i in range(3)]
        return m + weight * (np.stack(follows, axis=1) - m)

    stages.electronics.append(play)
    return Planted("sensor", xyz("width", weight * width, "gauss"))


def eddy_current(world, stages, strength, rng):
    """Currents in a plate: E dh/dt; strength in seconds."""
    E = rng.normal(size=(3, 3))
    E *= strength / np.linalg.norm(E) * np.sqrt(3)
    stages.field_rate.append(E)
    return Planted("sensor", nine("eddy", E, "s"))


def viscous_magnetisation(world, stages, strength, rng):
    """Induced magnetisation that follows within 15 to 60 s."""
    dA, tau = strength * symmetric(rng), rng.uniform(15, 60)
    stages.from_field.append(lambda h: (low_passed(h, tau) - h) @ dA.T)
    return Planted("sensor", six("lagging_part", dA, "1"))


def mag_time_lag(world, stages, strength, rng):
    """A pure delay."""
    stages.mag_delay_s += strength
    return Planted("sensor", (("lag", strength, "s"),))


def mag_low_pass(world, stages, strength, rng):
    """A first-order filter in the sensor, exact for what is straight within 1 ms.

    One of values that are held until the next would trail by half a step less.
    """
    stages.electronics.append(lambda m: low_passed((m + np.vstack([m[:1], m[:-1]])) / 2, strength))
    return Planted("sensor", (("time_constant", strength, "s"),))


def mag_sample_hold(world, stages, strength, rng):
    """A sensor that has a new value only every few samples; strength in seconds."""

    def edit(rows):
        every = max(2, round(strength / (rows.time_s[1] - rows.time_s[0])))
        rows.mag = rows.mag[np.arange(len(rows.mag)) // every * every]
        return rows

    stages.edits.append(edit)
    return Planted("sensor", (("hold", strength, "s"),))


def flexible_mount(world, stages, strength, rng):
    """The mount bends under load; strength in rad per g."""
    C = rng.normal(size=(3, 3))
    C *= strength / np.linalg.norm(C) / 9.81 * np.sqrt(3)
    stages.mount.append(world.motion.force_b @ C.T)
    return Planted("sensor", nine("bend", 9.81 * C, "rad/g"))


def mag_gyro_misalignment(world, stages, strength, rng):
    """The magnetometer sits at an angle to the gyro; strength in rad."""
    angle = direction(rng) * strength
    stages.mount.append(angle)
    return Planted("sensor", xyz("angle", angle, "rad"))


def onboard_calibration_active(world, stages, strength, rng):
    """The device's own calibration runs: every few seconds it takes off more of the iron.

    Strength is the part of the iron that it takes off in the end.
    """
    t = world.time_s
    every, tau = rng.uniform(4, 10), rng.uniform(60, 150)
    held = np.floor(t / every) * every
    learnt = strength * (1 - np.exp(-held / tau)) / (1 - np.exp(-t[-1] / tau))
    undo = np.linalg.inv(world.soft_iron).T
    stages.electronics.append(lambda m: m + learnt[:, None] * ((m - world.hard_iron) @ undo - m))
    return Planted("sensor", (("part", strength, "1"),))


def stuck_magnetometer(world, stages, strength, rng):
    """The magnetometer repeats itself for `strength` seconds, twice."""
    length = world.time_s[-1] - BEFORE_S
    begins = np.array([rng.uniform(0.15, 0.4), rng.uniform(0.55, 0.85)]) * length

    def edit(rows):
        for begin in begins:
            inside = np.flatnonzero((rows.time_s >= begin) & (rows.time_s < begin + strength))
            if len(inside):
                rows.mag[inside] = rows.mag[inside[0]]
        return rows

    stages.edits.append(edit)
    return Planted("sensor", intervals_s=tuple((b, b + strength) for b in begins))


def noise_burst(world, stages, strength, rng):
    """Noise `strength` times as large for some seconds, now and then."""
    length = world.time_s[-1] - BEFORE_S
    begins = np.sort(rng.uniform(0.05, 0.9, 4)) * length
    spans = tuple((float(b), float(b + rng.uniform(3, 8))) for b in begins)
    stages.mag_noise_factor.append(
        lambda t: 1.0 + (strength - 1) * sum((t >= a) & (t < b) for a, b in spans)
    )
    return Planted("sensor", intervals_s=spans)


def noise_level(world, stages, strength, rng):
    """Noise `strength` times as large from a moment on."""
    t0 = moment(world, rng)
    stages.mag_noise_factor.append(lambda t: np.where(t >= t0 - BEFORE_S, strength, 1.0))
    return stepped(world, t0, "sensor", ())
