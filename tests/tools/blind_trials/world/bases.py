"""Real recordings that an effect is injected into, and what is made of them first.

A base is a part of a recording.  A variant is a base, thinned, in other axes: a turn of all three
sensors together is an exact symmetry of everything that is asked.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blind_trials.world.chain import Rows
from blind_trials.world.rotations import direction, turned

_SENSORS = ("mag_{}_gauss", "gyro_{}_rad_s", "accel_{}_m_s2")


@dataclass(frozen=True)
class Base:
    """Rows of `file` from begin to end; `every`: the thinnings that there may be."""

    file: str
    begin_s: float = 0.0
    end_s: float = float("inf")
    every: tuple = (1,)
    gauss: float = 1.0  # of the file's unit


@dataclass(frozen=True)
class Variant:
    """A base, one row of `every`, and the seed of its axes, its machines and its name."""

    base: Base
    every: int
    seed: int

    @property
    def name(self):
        """What a report calls it; no two of a ring have the same."""
        base = self.base
        part = "" if base.begin_s == 0 and np.isinf(base.end_s) else f" {_span(base)} s"
        thin = f" 1/{self.every}" if self.every > 1 else ""
        return f"{Path(base.file).name.removesuffix('.csv.gz')}{part}{thin} #{self.seed % 10000}"


def _span(base):
    end = "" if np.isinf(base.end_s) else f"{base.end_s:.0f}"
    return f"{base.begin_s:.0f}-{end}"


def _halves(file, middle_s, **more):
    return (
        Base(file, **more),
        Base(file, end_s=middle_s, **more),
        Base(file, begin_s=middle_s, **more),
    )


_FAST = (4, 5, 7)  # of 286 Hz
BASES = (
    *_halves("broad/01_undisturbed_slow_rotation_A.csv.gz", 100.0, every=_FAST),
    *_halves("broad/02_undisturbed_slow_rotation_B.csv.gz", 93.0, every=_FAST),
    *_halves("broad/21_undisturbed_fast_combined.csv.gz", 94.0, every=_FAST),
    # after the magnet was taken off again
    Base("broad/34_disturbed_attached_magnet_3cm.csv.gz", 102.0, every=_FAST),
    Base("broad/36_disturbed_attached_magnet_5cm.csv.gz", 102.0, every=_FAST),
    *_halves("vn100/hand_2023_thumatti.csv.gz", 151.0),
    *_halves("vn100/punch_2024_shaked.csv.gz", 94.0),
    Base("vn100/punch_2024_satish.csv.gz"),
    Base("vn100/circles_2022_rahul.csv.gz"),
    Base("vn100/drive_2022_rahul.csv.gz", end_s=216.0),
    Base("vn100_distorters/clearIMU.csv.gz"),
    Base("vn100_distorters/vn7Hard.csv.gz"),
    Base("vn100_distorters/vn30Soft.csv.gz"),
    Base("repoimu/TStick_Test11_Trial1.csv.gz", every=(2, 3), gauss=0.5),
)


def read_rows(folder, variant):
    """A variant at the recording's full rate, from time zero on, without covariates."""
    base = variant.base
    with gzip.open(Path(folder) / base.file, "rt") as file:
        header = file.readline().strip().split(",")
        wanted = ["time_s", *(column.format(a) for column in _SENSORS for a in "xyz")]
        data = np.loadtxt(file, delimiter=",", usecols=[header.index(w) for w in wanted])
    data = data[(data[:, 0] >= base.begin_s) & (data[:, 0] < base.end_s)]
    rng = np.random.default_rng([variant.seed, 1])
    angle = direction(rng) * np.pi * np.cbrt(rng.random())
    mag, gyro, force = (turned(data[:, k : k + 3], angle) for k in (1, 4, 7))
    return Rows(data[:, 0] - data[0, 0], base.gauss * mag, gyro, force, {})


def thinned(rows, every):
    """One row of `every`; its gyro is the mean over the step that ends there."""
    if every == 1:
        return rows
    K = len(rows.time_s) // every
    last = np.arange(1, K + 1) * every - 1
    out = rows.kept(last)
    out.gyro = rows.gyro[: K * every].reshape(K, every, 3).mean(axis=1)
    return out


def add_machines(rows, rng):
    """Columns of machines that were not there: only an injected effect makes them matter."""
    t = rows.time_s
    throttle, lamp, at, on = np.empty_like(t), np.zeros_like(t), t[0], False
    while at <= t[-1]:
        length = rng.uniform(4, 15)
        inside = (t >= at) & (t < at + length)
        throttle[inside], lamp[inside] = rng.uniform(0.1, 1), float(on)
        at, on = at + length, not on
    tau = rng.uniform(0.3, 0.6) * t[-1]
    rows.columns = {
        "temperature_c": np.round(15 + 8 * (1 - np.exp(-(t - t[0]) / tau)), 2),
        "motor_current_a": 10 * throttle**1.5,
        "lamp_on": lamp,
    }
    return rows
