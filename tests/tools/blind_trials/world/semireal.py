"""Real recordings with an exactly known effect on top: real motion, real noise, true key.

Every real recording also has effects of its own (a lag of some 12 ms in all of BROAD, for one).
So each variant appears once untouched, as a control, and a tool is judged by what it says beyond
the answer to the control of the same variant: rows and machines are the same but for the effect.

A limit is the strength that stands out of this recording's own remainder with a signal to noise of
7 (`remainder`), or the table's where that is more.  Where the recording has more of such an effect
at other times than its spectrum says, the noise is taken to be that much larger.  An effect that
would have to be stronger than physics allows is replaced by another one.  A delay that goes
against the recording's own has to make up for that first.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from blind_trials.world import remainder
from blind_trials.world.bases import BASES, Variant, add_machines, read_rows, thinned
from blind_trials.world.cases import SEEN
from blind_trials.world.injected import INJECTED, LAGS
from blind_trials.world.limits import FRAMES

_A_VARIANT = 6  # cases, its control among them
_MULTIPLES = (0.5, 8.0)
_SMALL = 0.05  # of the table's limit: there every effect is in proportion
_PLACEBOS = 12
_WHOLE = ("frame_error", "unit_error_gyro", "unit_error_mag")  # nothing else can be told beside


def plan(cases, seed):
    """(Variant, keys of INJECTED by preference) for every case; a control has no keys."""
    rng = np.random.default_rng([seed, 4712])
    count = max(1, round(cases / _A_VARIANT))
    bases = _cycle(rng, BASES, count)
    variants = [
        Variant(base, int(rng.choice(base.every)), int(rng.integers(2**31))) for base in bases
    ]
    out = [(variant, ()) for variant in variants][:cases]
    queue, had = [], [[] for _ in variants]
    for n in range(cases - len(out)):
        before = had[n % count]
        if not set(queue) - set(before):
            queue += _cycle(rng, tuple(INJECTED), len(INJECTED))
        key = next((k for k in queue if k not in before), queue[0])
        queue.remove(key)
        before.append(key)
        rest = [k for k in _cycle(rng, tuple(INJECTED), len(INJECTED)) if k not in _WHOLE]
        rest.sort(key=before.count)  # what the variant has not had yet comes first
        out.append((variants[n % count], (key, *(k for k in rest if k != key))))
    rng.shuffle(out)
    return out


def _cycle(rng, items, count):
    """`count` items, each as often as the others, in random order."""
    out = []
    while len(out) < count:
        out += [items[k] for k in rng.permutation(len(items))]
    return out[:count]


def make_semireal(folder, variant, keys, entropy):
    """(Rows, spec, truth) of a variant with the first effect of `keys` that it can show."""
    plain = read_rows(folder, variant)
    add_machines(plain, np.random.default_rng([variant.seed, 2]))
    few = thinned(plain, variant.every)
    own = remainder.fit(few.time_s, few.mag, few.gyro)
    rows, effects = few, []
    for n, key in enumerate(keys):
        made = _injected(plain, few, own, variant, INJECTED[key], [*entropy, n])
        if made is not None:
            rows, effects = made[0], [made[1]]
            break
    step = float(np.median(np.diff(rows.time_s)))
    truth = {
        "kind": "semireal" if effects else "control",
        "noise_law": "real",
        "noise": {"own_delay_s": own.own_delay_s},
        "allowed": list(LAGS) if abs(own.own_delay_s) >= INJECTED["mag_time_lag"].least else [],
        "motion": variant.name,
        "rate_hz": 1 / step,
        "duration_s": float(np.ptp(rows.time_s)),
        "withheld": None,
        "columns_left_out": [],
        "effects": effects,
        "oracle_gain_nats_per_sample": None,
    }
    return rows, {"rate_hz": round(1 / step, 3)}, truth


def _injected(plain, few, own, variant, row, entropy):
    """(Rows, entry of the key), or None where the recording cannot show the effect."""

    def with_effect(strength, apply=row.apply):
        rows = replace(plain)
        planted = apply(rows, strength, np.random.default_rng([*entropy, 2]))
        return thinned(rows, variant.every), planted

    limit, seen, against = row.least, None, 0.0
    if row.scaled:
        reference = _SMALL * row.least
        rows, _ = with_effect(reference, row.shown or row.apply)
        seen = own.signal_to_noise(rows.mag - few.mag, rows.gyro - few.gyro) / reference
        seen /= _excess(few, own, row) if row.timed else 1.0
        limit = max(row.least, SEEN / max(seen, 1e-12))
        against = max(0.0, -row.own * own.own_delay_s)
    if row.key == "frame_error" and not _turns(few):
        return None
    if limit + against > row.most:
        return None
    draw = np.random.default_rng([*entropy, 1]).uniform(*np.log(_MULTIPLES))
    multiple = float(np.exp(draw))
    strength = min(limit * multiple + against, row.most)
    if row.key in _WHOLE:
        strength = 1.0
    rows, planted = with_effect(strength)
    return rows, _entry(row, strength, limit, against, seen, planted)


def _excess(few, own, row):
    """How much more of an effect the recording has by itself than noise of its spectrum has."""
    scores = []
    for n in range(_PLACEBOS):
        rows = add_machines(replace(few), np.random.default_rng([n, 1]))
        row.apply(rows, _SMALL * row.least, np.random.default_rng([n, 2]))
        scores.append(own.score(rows.mag - few.mag, rows.gyro - few.gyro))
    return max(1.0, float(np.sqrt(np.mean(np.square(scores)))))


def _turns(rows):
    """Whether it turns about every axis, so that no two of the gyro's can be taken for another."""
    spread = np.linalg.eigvalsh(np.cov(rows.gyro.T))
    return spread[0] > 0.05 * spread[2]


def _entry(row, strength, limit, against, seen, planted):
    names = row.names
    return {
        "effect": row.key if row.key in names else names[0],
        "source": row.key,
        "frame": planted.frame,
        "frames": [planted.frame, *FRAMES.get(names[0], ())],
        "either_half": False,
        "strength": strength,
        "unit": row.unit,
        "limit": limit,
        "multiple": (strength - against) / limit,
        "snr": None if seen is None else seen * (strength - against),
        "right": list(names),
        "parents": [],
        "parameters": [{"name": n, "value": v, "unit": u} for n, v, u in planted.parameters],
        "onset_s": planted.onset_s,
        "intervals_s": [list(span) for span in planted.intervals_s],
    }
