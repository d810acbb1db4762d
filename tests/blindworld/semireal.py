"""Real recordings with an exactly known effect on top: real motion, real noise, true key.

Every real recording also has effects of its own (a lag of 11.5 ms in all of BROAD, for one). So
each one appears once untouched, as a control, and a tool is judged by what it says beyond that.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from blindworld.chain import Planted, Rows, xyz
from blindworld.limits import FRAMES
from blindworld.motion import DEG
from blindworld.on_link import signed_permutations
from blindworld.rotations import direction, turned

#: file -> every how many samples a row is kept; the gyro is averaged over them
BASES = {
    "broad/01_undisturbed_slow_rotation_A.csv.gz": 5,
    "broad/02_undisturbed_slow_rotation_B.csv.gz": 5,
    "broad/21_undisturbed_fast_combined.csv.gz": 5,
    "vn100/hand_2023_thumatti.csv.gz": 1,
    "vn100/circles_2022_rahul.csv.gz": 1,
    "vn100/punch_2024_shaked.csv.gz": 1,
    "vn100_distorters/clearIMU.csv.gz": 1,
}
_SENSORS = ("mag_{}_gauss", "gyro_{}_rad_s", "accel_{}_m_s2")


@dataclass(frozen=True)
class Injected:
    """A row of the table: least and largest strength, drawn log-uniform."""

    key: str
    least: float
    most: float
    unit: str
    apply: object
    right: tuple[str, ...]


def read_rows(folder, name):
    """A real recording at full rate, with the sensors' columns only."""
    with gzip.open(Path(folder) / name, "rt") as file:
        header = file.readline().strip().split(",")
        wanted = ["time_s", *(column.format(a) for column in _SENSORS for a in "xyz")]
        data = np.loadtxt(file, delimiter=",", usecols=[header.index(w) for w in wanted])
    return Rows(data[:, 0], data[:, 1:4], data[:, 4:7], data[:, 7:10], {})


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


def _moment(rows, rng):
    return float(rows.time_s[0] + rng.uniform(0.3, 0.7) * np.ptp(rows.time_s))


def _lag(rows, strength, rng):
    spline = CubicSpline(rows.time_s, rows.mag, axis=0)
    rows.mag = spline(np.maximum(rows.time_s - strength, rows.time_s[0]))
    return Planted("sensor", (("lag", strength, "s"),))


def _misalign(rows, strength, rng):
    angle = direction(rng) * strength
    rows.mag = turned(rows.mag, angle)
    return Planted("sensor", xyz("angle", angle, "rad"))


def _scale(rows, strength, rng):
    scale = direction(rng) * strength
    rows.gyro = rows.gyro * (1 + scale)
    return Planted("gyro", xyz("scale", scale, "1"))


def _stepped(rows, t0, frame, parameters):
    return Planted(frame, parameters, t0, ((t0, float(rows.time_s[-1])),))


def _iron_step(rows, strength, rng):
    t0, step = _moment(rows, rng), direction(rng) * strength
    rows.mag = rows.mag + (rows.time_s >= t0)[:, None] * step
    return _stepped(rows, t0, "sensor", xyz("step", step, "gauss"))


def _gyro_step(rows, strength, rng):
    t0, step = _moment(rows, rng), direction(rng) * strength
    rows.gyro = rows.gyro + (rows.time_s >= t0)[:, None] * step
    return _stepped(rows, t0, "gyro", xyz("step", step, "rad/s"))


def _follows(column, unit):
    def apply(rows, strength, rng):
        signal = rows.columns[column]
        signal = signal - signal.min() * (column == "temperature_c")
        per_unit = direction(rng) * strength / np.max(signal)
        rows.mag = rows.mag + signal[:, None] * per_unit
        return Planted("sensor", xyz("field", per_unit, unit))

    return apply


def _swapped(rows, strength, rng):
    order, signs = signed_permutations()[rng.integers(47)]
    rows.gyro = rows.gyro[:, order] * signs
    return Planted("link")


_LAGS = ("mag_time_lag", "gyro_time_lag", "gyro_integration", "mag_low_pass")
_ROWS = (
    Injected("mag_time_lag", 4e-3, 60e-3, "s", _lag, _LAGS),
    Injected("mag_gyro_misalignment", 0.6 * DEG, 5 * DEG, "rad", _misalign,
             ("mag_gyro_misalignment",)),
    Injected("gyro_scale", 0.01, 0.06, "1", _scale, ("gyro_scale", "clock_rate")),
    Injected("hard_iron_step", 4e-3, 60e-3, "gauss", _iron_step, ("hard_iron_step",)),
    Injected("gyro_bias_step", 0.06 * DEG, 0.8 * DEG, "rad/s", _gyro_step, ("gyro_bias_step",)),
    Injected("motor_current_field", 4e-3, 60e-3, "gauss", _follows("motor_current_a", "gauss/A"),
             ("motor_current_field",)),
    Injected("switched_device", 4e-3, 60e-3, "gauss", _follows("lamp_on", "gauss"),
             ("switched_device",)),
    Injected("mag_bias_temperature", 4e-3, 60e-3, "gauss",
             _follows("temperature_c", "gauss/degC"), ("mag_bias_temperature",)),
    Injected("frame_error", 1.0, 1.0, "1", _swapped, ("frame_error",)),
)  # fmt: skip


INJECTED = {row.key: row for row in _ROWS}


def plan(cases, seed):
    """(base, key of INJECTED or None) for every case; each base is there once untouched."""
    rng = np.random.default_rng([seed, 4712])
    bases = list(BASES)
    used = [bases[k] for k in rng.permutation(len(bases))][: max(1, min(len(bases), cases // 3))]
    out = [(base, None) for base in used]
    pairs = [(base, key) for key in INJECTED for base in used]
    while len(out) < cases:
        out += [pairs[k] for k in rng.permutation(len(pairs))]
    out = out[:cases]
    rng.shuffle(out)
    return out


def make_semireal(folder, base, key, entropy):
    """(Rows, spec, truth) of a real recording with an effect, or without one."""
    rng = np.random.default_rng(entropy)
    rows = read_rows(folder, base)
    machines = np.random.default_rng(rng.integers(2**32))
    rows = add_machines(rows, machines)
    effects = []
    if key is not None:
        row = INJECTED[key]
        strength = float(np.exp(rng.uniform(np.log(row.least), np.log(row.most))))
        planted = row.apply(rows, strength, rng)
        effects.append(
            {
                "effect": row.key,
                "source": row.key,
                "frame": planted.frame,
                "frames": [planted.frame, *FRAMES.get(row.key, ())],
                "either_half": False,
                "strength": strength,
                "unit": row.unit,
                "limit": row.least,
                "multiple": strength / row.least,
                "snr": None,
                "right": list(row.right),
                "parents": [],
                "parameters": [
                    {"name": n, "value": v, "unit": u} for n, v, u in planted.parameters
                ],
                "onset_s": planted.onset_s,
                "intervals_s": [list(span) for span in planted.intervals_s],
            }
        )
    rows = thinned(rows, BASES[base])
    step = float(np.median(np.diff(rows.time_s)))
    truth = {
        "kind": "control" if key is None else "semireal",
        "noise_law": "real",
        "noise": {},
        "allowed": [],
        "motion": base,
        "rate_hz": 1 / step,
        "duration_s": float(np.ptp(rows.time_s)),
        "withheld": None,
        "columns_left_out": [],
        "effects": effects,
        "oracle_gain_nats_per_sample": None,
    }
    return rows, {"rate_hz": round(1 / step, 3)}, truth
