"""How well a cause that nobody logged can be seen at all: by one who knows all but its course.

    python tests/benchmarks/diagnosis/bench_unlogged_limit.py KEY.json ... [--below 2]

For every case of a ring, by its key (`ahrsd challenge make --seed` makes it), whose cause was
withheld: the generator draws the same kind of cause `DRAWS` times more, with other courses,
directions and places, along the very motion of the case. Their covariance, at the case's
strength, is all that anyone can know of a course that was not logged. The observer knows it,
besides the noise, the attitude and the field; calibration, gyro bias and the outside field are
projected out, as of all that `world.ideal` sees. Of a gyro's bias the noise is also a walk of an
ordinary gyro (5e-6 rad/s per root second).

Of tests that know no more of a signal than its covariance the best is the likelihood ratio

    L = 1/2 sum_i ( z_i^2 l_i / (1 + l_i) - ln(1 + l_i) ),

l_i the signal's variances in the noise's units, z_i what is seen.  Its bar is what noise alone
passes once in `1 / FALSE` recordings; told is how often the case's own signal passes, over draws of
the noise.  The diagnosis knows none of that law, and looks for all kinds of causes at once.  Prints
a line per case, and means by kind and strength.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from blind_trials.world import cases
from blind_trials.world.__main__ import case_ids
from blind_trials.world.chain import Stages, readings
from blind_trials.world.curves import wave
from blind_trials.world.limits import EFFECTS
from blind_trials.world.motion import MOTIONS, _box, _course
from blind_trials.world.rings import orders
from blind_trials.world.rotations import to_body
from blind_trials.world.world import _joint, _throttle

DRAWS, NOISES = 240, 4000
WALKS, WALK_RAD_S_SQRT_S = 100, 5e-6
FALSE = 0.002  # a quarter of what is allowed for recordings in which nothing is
STRENGTHS = (1.0, 1.25, 1.6, 2.0, 6.0)


def told(order, entropy, rng):
    """(probability that the observer tells it, its signal to noise) for one case."""
    world, setting, strength, seed = _made(order, entropy)
    ((key, _),) = order.effects
    at, mag, gyro = readings(world, Stages(), setting.rate_hz)
    column, gram, others = cases.watched(world, setting, at)
    index = np.rint(at * 1000).astype(int)
    own = cases._alone(key, world, strength, seed, setting.rate_hz)
    signals = [column(own[0] - mag, own[1] - gyro)]
    for _ in range(DRAWS):
        drawn = _other_course(key, world, rng)
        signals.append(column(*_signal(key, drawn, index, rng)))
    if key == "gyro_bias_temperature":
        # an ordinary gyro's bias walks, and nobody can know its path
        size = WALK_RAD_S_SQRT_S / setting.rate_hz**0.5
        walks = size * rng.normal(size=(WALKS, len(at), 3)).cumsum(axis=1)
        signals += [column(np.zeros_like(mag), walk) for walk in walks]
    G = _projected(gram([*others, *signals]), len(others))
    return _power(G, DRAWS, rng)


def _made(order, entropy):
    """World, setting, strength and seed of the case, as the generator has them."""
    seen = {}
    kept = cases._strengths

    def strengths(order, world, setting, seeds):
        found = kept(order, world, setting, seeds)
        seen.update(world=world, setting=setting, strength=found[0][0], seed=seeds[0])
        return found

    cases._strengths = strengths
    try:
        cases.make_case(order, entropy)
    finally:
        cases._strengths = kept
    return seen["world"], seen["setting"], seen["strength"], seen["seed"]


def _other_course(key, world, rng):
    """The same world with another course of what was withheld; it turns as it did."""
    t, motion = world.time_s, world.motion
    if key == "motor_current_field":
        return replace(world, current=10.0 * _throttle(rng, t) ** 1.5)
    if key == "moving_iron":
        return replace(world, joint=_joint(rng, t))
    if key in ("mag_bias_temperature", "gyro_bias_temperature"):
        warm = rng.uniform(5, 10)
        weather = wave(rng, 0.05 * warm, 0.005, 0.01).at(t)[0]
        return replace(world, temperature=warm * (1 - np.exp(-t / rng.uniform(90, 250))) + weather)
    _, (kind, size) = MOTIONS[motion.name]
    position, _, speed = (_box if kind == "box" else _course)(rng, t, size, motion.yaw)
    return replace(world, motion=replace(motion, position_n=position, speed=speed))


def _signal(key, world, index, rng):
    """What the effect adds to the readings (K, 3) of magnetometer and gyro, at its limit."""
    stages = Stages()
    EFFECTS[key].make(world, stages, EFFECTS[key].limit, rng)
    mag, gyro = np.zeros((len(index), 3)), np.zeros((len(index), 3))
    for extra in stages.body:
        mag = mag + extra[index]
    for extra in stages.field_n:
        mag = mag + to_body(world.motion.R_nb[index], extra[index]) @ world.soft_iron.T
    for extra in stages.gyro_bias:
        gyro = gyro + extra[index]
    return mag, gyro


def _projected(G, count):
    """The Gram matrix of the columns behind the first `count`, those projected out."""
    scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
    whole = G / np.outer(scale, scale)
    inner, cross = whole[:count, :count], whole[:count, count:]
    left = whole[count:, count:] - cross.T @ np.linalg.pinv(inner, rcond=1e-9) @ cross
    return left * np.outer(scale[count:], scale[count:])


def _power(G, draws, rng):
    """Probability that the first signal passes the bar, the next so many its law; and its s/n.

    What comes behind those is noise, besides the white one.
    """
    own = float(G[0, 0])
    values, vectors = np.linalg.eigh(G[1:, 1:])
    kept = values > 1e-9 * values[-1]
    values, vectors = values[kept], vectors[:, kept]
    coordinates = vectors.T * np.sqrt(values)[:, None]  # of the drawn signals, one per column
    mean = vectors.T @ G[1:, 0] / np.sqrt(values)
    size = np.sqrt(np.maximum(np.diag(G)[1 : draws + 1], 1e-12))
    drawn = coordinates[:, :draws] * np.sqrt(own / draws) / size
    noise = np.eye(len(values))
    if coordinates.shape[1] > draws:
        others = coordinates[:, draws:]
        noise += others @ others.T / others.shape[1]
    root = np.linalg.cholesky(noise)
    drawn, mean = np.linalg.solve(root, drawn), np.linalg.solve(root, mean)
    axes, sizes, _ = np.linalg.svd(drawn, full_matrices=False)
    variance, mean = sizes**2, axes.T @ mean

    def ratio(z):
        return 0.5 * np.sum(z**2 * variance / (1 + variance) - np.log1p(variance), axis=1)

    seen = rng.normal(size=(NOISES, len(variance)))
    bar = float(np.quantile(ratio(seen), 1 - FALSE))
    return float(np.mean(ratio(mean + rng.normal(size=seen.shape)) > bar)), float(np.sqrt(own))


def main():
    """Print a line per case, then means."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("keys", type=Path, nargs="+", metavar="key.json")
    parser.add_argument("--below", type=float, default=np.inf, help="only cases of fewer limits")
    asked = parser.parse_args()
    found, strong = defaultdict(list), 0
    print("case      source                 limits  s/n   told by one who knows all but the course")
    for path in asked.keys:
        key = json.loads(path.read_text(encoding="utf-8"))
        count, seed = len(key["cases"]), key["seed"]
        work = zip(case_ids(count, seed), orders(key["ring"], count, seed), strict=True)
        for n, (name, order) in enumerate(work):
            if order.kind != "withheld":
                continue
            ((source, multiple),) = order.effects
            if multiple >= asked.below:
                strong += 1
                continue
            power, snr = told(order, [seed, n], np.random.default_rng([seed, n, 99]))
            print(f"{name}  {source:22s} {multiple:5.2f} {snr:6.1f}   {power:.3f}", flush=True)
            for group in (source, *_groups(multiple), "all of these"):
                found[group].append(power)
    for name, powers in found.items():
        print(f"{name:24s} {np.mean(powers):.3f} of {len(powers)}")
    powers = found["all of these"]
    share = (sum(powers) + strong) / (len(powers) + strong)
    print(f"{'if all others are told':24s} {share:.3f} of {len(powers) + strong}")


def _groups(multiple):
    """The span of strengths that it is in."""
    spans = pairwise(STRENGTHS)
    return [f"{low:g} to {high:g} limits" for low, high in spans if low <= multiple < high]


if __name__ == "__main__":
    main()
