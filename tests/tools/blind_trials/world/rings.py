"""Which cases a ring has, in the proportions of the dossier's 4.2."""

from __future__ import annotations

import numpy as np

from blind_trials.world import noise
from blind_trials.world.cases import Order
from blind_trials.world.limits import EFFECTS

#: kind -> cases of 600
FULL = {
    "null": 150, "single": 240, "pair": 90, "withheld": 50, "outside": 40, "unidentifiable": 30,
}  # fmt: skip
RINGS = {
    "full": tuple(FULL),
    "nulls": ("null",),
    "singles": ("single",),
    "pairs": ("pair",),
    "withheld": ("withheld",),
    "outside": ("outside",),
    "unidentifiable": ("unidentifiable",),
}

SINGLES = tuple(key for key, effect in EFFECTS.items() if effect.identifier is not None)
OUTSIDE = tuple(key for key, effect in EFFECTS.items() if effect.identifier is None)
#: what does not go with another effect: it hides it, or is found by hygiene and ends the diagnosis
_ALONE = {"frame_error", "unit_error", "stuck_magnetometer", "dropped_samples", "mag_saturation",
          "gyro_saturation", "mag_sample_hold", "earth_rotation", "gyro_integration",
          "noise_level", "noise_burst", "mag_quantisation", "timestamp_jitter"}  # fmt: skip
PAIRED = tuple(key for key in SINGLES if key not in _ALONE)
WITHHELD = (
    ("motor_current_field", "motor"),
    ("mag_bias_temperature", "temperature"),
    ("field_gradient", "position"),
    ("moving_iron", "joint"),
    ("speed_field", "speed"),
    ("gyro_bias_temperature", "temperature"),
)
UNIDENTIFIABLE = (
    ("mag_bias_temperature", "wam", 0.0),
    ("gyro_bias_temperature", "mam", 0.0),
    ("mag_time_lag", "spin", None),
    ("mag_gyro_misalignment", "straight", None),
    ("gyro_scale", "straight", None),
    ("mag_cross_axis", "straight", None),
)


def shares(kinds, cases):
    """How many cases of each kind, by largest remainder."""
    weights = np.array([FULL[kind] for kind in kinds], dtype=float)
    exact = weights / weights.sum() * cases
    counts = np.floor(exact).astype(int)
    for k in np.argsort(-(exact - counts), kind="stable")[: cases - counts.sum()]:
        counts[k] += 1
    return dict(zip(kinds, counts.tolist()))


def orders(ring, cases, seed):
    """The Orders of a ring, shuffled."""
    rng = np.random.default_rng([seed, 4711])
    out = []
    for kind, count in shares(RINGS[ring], cases).items():
        out += _KINDS[kind](rng, count)
    rng.shuffle(out)
    return out


def _multiple(rng, low=0.5, high=5.0):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _cycle(rng, items, count):
    """`count` items, each as often as the others, in random order."""
    out = []
    while len(out) < count:
        out += [items[k] for k in rng.permutation(len(items))]
    return out[:count]


def _nulls(rng, count):
    return [Order("null", law=law) for law in _cycle(rng, noise.LAWS, count)]


def _singles(rng, count):
    return [Order("single", ((key, _multiple(rng)),)) for key in _cycle(rng, SINGLES, count)]


def _pairs(rng, count):
    out = []
    while len(out) < count:
        a, b = (PAIRED[k] for k in rng.choice(len(PAIRED), 2, replace=False))
        first, second = EFFECTS[a], EFFECTS[b]
        same = first.identifier == second.identifier or first.identifier in second.alike
        if not same and second.identifier not in first.alike:
            out.append(Order("pair", ((a, _multiple(rng, 1.0)), (b, _multiple(rng, 1.0)))))
    return out


def _withheld(rng, count):
    return [
        Order("withheld", ((key, _multiple(rng, 1.0)),), withheld=group)
        for key, group in _cycle(rng, WITHHELD, count)
    ]


def _outside(rng, count):
    return [Order("outside", ((key, _multiple(rng, 1.0)),)) for key in _cycle(rng, OUTSIDE, count)]


def _unidentifiable(rng, count):
    return [
        Order("unidentifiable", ((key, _multiple(rng)),), motion=motion, warm_up_c=warm)
        for key, motion, warm in _cycle(rng, UNIDENTIFIABLE, count)
    ]


_KINDS = {
    "null": _nulls,
    "single": _singles,
    "pair": _pairs,
    "withheld": _withheld,
    "outside": _outside,
    "unidentifiable": _unidentifiable,
}
