"""One case: a world, effects at a strength, noise, and the rows that a logger would have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blind_trials.world import ideal, noise
from blind_trials.world.chain import Rows, Stages, body_field, readings
from blind_trials.world.limits import EFFECTS, FRAMES, GROUPS, PARENTS
from blind_trials.world.world import BEFORE_S, make_world

SEEN = 7.0  # signal to noise at which an ideal observer is sure among some sixty candidates
_TRIES = 12
_TOO_WEAK = 30.0  # times the published limit: such a motion does not show the effect at all
_BLIND = 2.0  # signal to noise below which nobody could see it

#: motion -> weight in a draw
MOTIONS = {
    "wam": 0.2, "wam_rov": 0.2, "mam": 0.1, "lam": 0.07, "lam_rov": 0.1, "lawn_mower": 0.1,
    "car": 0.08, "drone": 0.12, "tiny": 0.03,
}  # fmt: skip


@dataclass(frozen=True)
class Order:
    """What a case shall be.

    kind:      null, single, pair, withheld, outside or unidentifiable
    effects:   keys of EFFECTS, with a multiple of the limit for each
    """

    kind: str
    effects: tuple = ()  # (key, multiple)
    law: str = "white"
    motion: str | None = None
    withheld: str | None = None
    warm_up_c: float | None = None


@dataclass(frozen=True, eq=False)
class Case:
    """Rows, what the user may know, and the truth."""

    rows: Rows
    spec: dict
    truth: dict


class NotVisibleError(Exception):
    """This motion does not show the effect (or shows what it must not); draw another one."""


def make_case(order, entropy):
    """The Case of an Order; the same entropy gives the same bytes."""
    for attempt in range(_TRIES):
        try:
            return _attempt(order, [*entropy, attempt])
        except NotVisibleError:
            continue
    raise RuntimeError(f"no motion in {_TRIES} draws shows {order.effects}")


def _attempt(order, entropy):
    rng = np.random.default_rng(entropy)
    setting = _setting(order, rng)
    world = make_world(setting.motion, rng, setting.duration_s, warm_up_c=order.warm_up_c)
    seeds = [[*entropy, 77, n] for n in range(len(order.effects))]
    strengths, shown = _strengths(order, world, setting, seeds)
    stages, planted = _planted(order, world, strengths, seeds)
    at, mag, gyro = readings(world, stages, setting.rate_hz)
    rows = _logged(world, at, mag, gyro, rng)
    factors = stages.mag_noise_factor
    step = 1 / setting.rate_hz
    drawn = noise.add_noise(
        rows, order.law, rng, step, setting.sigma_mag, setting.sigma_gyro, factors
    )
    for edit in stages.edits:
        rows = edit(rows)
    if order.law == "drops_jitter":
        rows, drawn = noise.drop_and_jitter(rows, rng, step)
    hidden = _hidden(order, rng)
    for group in hidden:
        for name in GROUPS[group]:
            del rows.columns[name]
    truth = {
        "kind": order.kind,
        "noise_law": order.law,
        "noise": drawn,
        "allowed": list(noise.ALLOWED[order.law]),
        "motion": setting.motion,
        "rate_hz": setting.rate_hz,
        "duration_s": setting.duration_s,
        "sigma_mag_gauss": setting.sigma_mag,
        "sigma_gyro_rad_s": setting.sigma_gyro,
        "withheld": order.withheld,
        "columns_left_out": sorted(hidden),
        "effects": [
            _entry(key, multiple, strength, plant, see, order)
            for (key, multiple), strength, plant, see in zip(
                order.effects, strengths, planted, shown
            )
        ],
        "oracle_gain_nats_per_sample": shown[0]["gain"] if order.kind == "single" else None,
    }
    return Case(rows, _spec(world, setting, rng), truth)


@dataclass(frozen=True)
class _Setting:
    motion: str
    rate_hz: float
    duration_s: float
    sigma_mag: float
    sigma_gyro: float


def _setting(order, rng):
    names = list(MOTIONS)
    weights = np.array([MOTIONS[name] for name in names])
    drawn = names[rng.choice(len(names), p=weights / weights.sum())]
    coarse = rng.random() < 0.1  # the thesis' gyro, ten times the VN-100's
    return _Setting(
        motion=order.motion or drawn,
        rate_hz=float(rng.choice([25, 40, 50])),
        duration_s=float(rng.integers(300, 421)),
        sigma_mag=float(rng.uniform(0.6e-3, 1.2e-3)),
        sigma_gyro=float(5e-3 if coarse else rng.uniform(0.3e-3, 0.7e-3)),
    )


def _alone(key, world, strength, seed, rate_hz):
    stages = Stages()
    EFFECTS[key].make(world, stages, strength, np.random.default_rng(seed))
    _, mag, gyro = readings(world, stages, rate_hz)
    return mag, gyro * (1 + stages.clock_error)  # what a wrong step does to the rate


def _strengths(order, world, setting, seeds):
    """Strength of every effect, and what an ideal observer sees of each, all others known."""
    if not order.effects:
        return [], []
    at, mag, gyro = readings(world, Stages(), setting.rate_hz)
    column, gram, others = watched(world, setting, at)
    strengths, shown = [], []
    for (key, multiple), seed in zip(order.effects, seeds):
        effect = EFFECTS[key]
        if not effect.scaled:
            strengths.append(min(effect.limit * multiple, effect.most))
            shown.append({"limit": effect.limit, "snr": None, "gain": None})
            continue
        reference = _alone(key, world, effect.limit, seed, setting.rate_hz)
        effect_column = column(reference[0] - mag, reference[1] - gyro)
        seen = ideal.signal_to_noise(gram, [effect_column], others)[0]
        limit = _limit(effect, seen, order)
        strength = min(limit * multiple, effect.most)
        snr = seen * strength / effect.limit
        strengths.append(strength)
        gain = ideal.held_out_gain(gram, effect_column * strength / effect.limit, others, len(at))
        shown.append({"limit": limit, "snr": float(snr), "gain": gain})
    return strengths, shown


def watched(world, setting, at):
    """What an ideal observer of the world has at these instants: column, Gram, nuisances."""
    index = np.rint(at * 1000).astype(int)
    R_nb, h_b = world.motion.R_nb[index], body_field(world, Stages())[index]
    column, gram = ideal.observer(
        R_nb, h_b, world.soft_iron, 1 / setting.rate_hz, setting.sigma_mag, setting.sigma_gyro
    )
    return column, gram, ideal.nuisances(column, R_nb, h_b, world.soft_iron)


def _limit(effect, seen, order):
    """The published limit, or where this motion shows less, what an ideal observer needs."""
    if order.kind == "unidentifiable":
        if seen * 5 > _BLIND:  # at the largest multiple
            raise NotVisibleError
        return effect.limit
    factor = SEEN / max(seen, 1e-12)
    if factor > _TOO_WEAK or (effect.limit * factor > effect.most < np.inf and factor > 1):
        raise NotVisibleError
    return effect.limit * max(1.0, factor)


def _planted(order, world, strengths, seeds):
    stages, planted = Stages(), []
    for (key, _), strength, seed in zip(order.effects, strengths, seeds):
        planted.append(EFFECTS[key].make(world, stages, strength, np.random.default_rng(seed)))
    return stages, planted


def _entry(key, multiple, strength, planted, seen, order):
    effect = EFFECTS[key]
    right = [effect.identifier] if effect.identifier else []
    parents = PARENTS.get(key, ()) if order.kind in ("withheld", "outside") else ()
    return {
        "effect": effect.identifier,
        "source": key,
        "frame": planted.frame,
        "frames": [planted.frame, *FRAMES.get(key, ())],
        "either_half": key == "unlogged_switch",
        "strength": strength,
        "unit": effect.unit,
        "limit": seen["limit"],
        "multiple": strength / seen["limit"],
        "snr": seen["snr"],
        "right": [*right, *(name for name in effect.alike if name not in right)],
        "parents": list(parents),
        "parameters": [{"name": n, "value": v, "unit": u} for n, v, u in planted.parameters],
        "onset_s": planted.onset_s,
        "intervals_s": [list(span) for span in planted.intervals_s],
    }


def _logged(world, at, mag, gyro, rng):
    """Rows without the sensors' noise; covariates as their own sensors see them."""
    k = np.rint(at * 1000).astype(int)
    p = world.motion.position_n[k] + rng.normal(scale=0.02, size=(len(k), 3))
    shake = 0.02 + 0.15 * world.vibration[k, None] * rng.normal(size=(len(k), 3))
    columns = {
        "temperature_c": np.round(world.temperature[k] / 0.05) * 0.05,
        "motor_current_a": world.current[k] + rng.normal(scale=0.03, size=len(k)),
        "yaw_motor_current_a": world.yaw_current[k] + rng.normal(scale=0.02, size=len(k)),
        "motor_rpm": np.round(world.rpm[k] / 5) * 5,
        "pump_rpm": np.full(len(k), round(world.pump_hz * 60, 1)),
        "speed_m_s": world.motion.speed[k] + rng.normal(scale=0.01, size=len(k)),
        "position_north_m": p[:, 0],
        "position_east_m": p[:, 1],
        "position_down_m": p[:, 2],
        "rudder_angle_rad": world.joint[k] + rng.normal(scale=0.002, size=len(k)),
        "lamp_on": world.switch[k],
    }
    return Rows(at - BEFORE_S, mag, gyro, world.motion.force_b[k] + shake, columns)


def _hidden(order, rng):
    """Groups of columns that this logger does not have; never what the effect needs."""
    needed = {EFFECTS[key].group for key, _ in order.effects}
    free = [group for group in GROUPS if group not in needed]
    drop, which = rng.random() < 0.4, free[rng.integers(len(free))]
    hidden = {which} if drop else set()
    return hidden | ({order.withheld} if order.withheld else set())


def _spec(world, setting, rng):
    """What the user says: always the rate, half the time the data sheet's noise and the field."""
    spec = {"rate_hz": setting.rate_hz}
    if rng.random() < 0.5:
        spec |= {
            "sigma_mag_gauss": setting.sigma_mag,
            "sigma_gyro_rad_s": setting.sigma_gyro,
            "field_gauss": float(np.linalg.norm(world.field_n)),
        }
    return spec


def without_noise(order, entropy):
    """(world, instants, magnetometer, gyro) of an order before noise, at the limits' strengths."""
    rng = np.random.default_rng([*entropy, 0])
    setting = _setting(order, rng)
    world = make_world(setting.motion, rng, setting.duration_s, warm_up_c=order.warm_up_c)
    seeds = [[*entropy, 77, n] for n in range(len(order.effects))]
    strengths = [multiple * EFFECTS[key].limit for key, multiple in order.effects]
    stages, _ = _planted(order, world, strengths, seeds)
    return (world, *readings(world, stages, setting.rate_hz))
