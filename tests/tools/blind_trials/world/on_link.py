"""Clocks, links and people: what happens to rows after the sensors."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from blind_trials.world.chain import Planted


def clock_rate(world, stages, strength, rng):
    """The logger's clock runs at another rate than the sensor's."""
    error = strength * rng.choice([-1.0, 1.0])

    def edit(rows):
        rows.time_s = rows.time_s * (1 + error)
        return rows

    stages.clock_error += error
    stages.edits.append(edit)
    return Planted("link", (("rate", float(error), "1"),))


def timestamp_jitter(world, stages, strength, rng):
    """Host stamps that jitter; strength in seconds, never so much that order is lost."""

    def edit(rows):
        step = rows.time_s[1] - rows.time_s[0]
        jitter = np.clip(
            rng.normal(scale=strength, size=len(rows.time_s)), -0.45 * step, 0.45 * step
        )
        rows.time_s = rows.time_s + jitter
        return rows

    stages.edits.append(edit)
    return Planted("link", (("jitter", strength, "s"),))


def dropped_samples(world, stages, strength, rng):
    """A part `strength` of the rows is lost, and the host, which counts rows, does not know."""

    def edit(rows):
        first = rows.time_s
        kept = rng.random(len(first)) >= strength
        kept[:2] = True
        rows = rows.kept(kept)
        rows.time_s = first[: len(rows.time_s)]
        return rows

    stages.edits.append(edit)
    return Planted("link", (("lost", strength, "1"),))


def signed_permutations():
    """The 48, without the identity."""
    found = []
    for order, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        if order != (0, 1, 2) or signs != (1, 1, 1):
            found.append((list(order), np.array(signs, dtype=float)))
    return found


def frame_error(world, stages, strength, rng):
    """Axes of the gyro swapped or with the wrong sign."""
    choices = signed_permutations()
    order, signs = choices[rng.integers(len(choices))]

    def edit(rows):
        rows.gyro = rows.gyro[:, order] * signs
        return rows

    stages.edits.append(edit)
    return Planted("link")


def unit_error(world, stages, strength, rng):
    """Rates in degrees per second under a name that says rad/s."""

    def edit(rows):
        rows.gyro = np.degrees(rows.gyro)
        return rows

    stages.edits.append(edit)
    return Planted("link")
