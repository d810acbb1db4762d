"""Streams of sensors that are broken in random ways, alone and together.

    python tests/fuzz/broken_sensors.py [--cases N] [--first SEED] [--diagnose]

A sensor that moves in one of several ways; then one to three things are wrong with its readings.
Whatever they are, the core and `diagnose` end in words: no exception of another kind, no warning of
numpy, no number that is not finite where one is promised.
"""

from __future__ import annotations

import argparse
import json
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import NothingToFit, Track
from ahrsd.inputs import RegistersKnown, Samples, Stop
from ahrsd.offline.track import check_track, track_of
from ahrsd.report.summary import summary_json
from ahrsd.samples import SampleBlock, known_force

Array = NDArray[np.float64]
RATE_HZ = 20.0


@dataclass
class Readings:
    """What a sensor said: times (N,), field in gauss, rates in rad/s and force in m/s^2 (N, 3)."""

    time_s: Array
    mag: Array
    gyro: Array
    accel: Array


def moving(draw: np.random.Generator, seconds: float = 120.0) -> Readings:
    """A sound sensor that tumbles, circles, rocks or rests."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rate = {
        0: np.column_stack([0.5 * np.sin(0.9 * t), 0.4 * np.sin(0.6 * t), 0.4 + 0.2 * np.sin(t)]),
        1: np.column_stack([0 * t, 0 * t, 0.2 + 0.1 * np.sin(0.3 * t)]),
        2: np.column_stack([0.1 * np.sin(t), 0.15 * np.sin(0.7 * t), 0.05 * np.sin(0.2 * t)]),
        3: np.zeros((len(t), 3)),
    }[int(draw.integers(4))]
    R = so3.products(so3.exp(rate / RATE_HZ))
    noise = draw.choice([0.0, 1.0])
    return Readings(
        t,
        np.einsum("nji,j->ni", R, [0.25, 0.0, 0.43])
        + draw.uniform(-0.2, 0.2, 3)
        + noise * 1e-3 * draw.normal(size=rate.shape),
        rate + draw.uniform(-0.01, 0.01, 3) + noise * 7e-4 * draw.normal(size=rate.shape),
        np.einsum("nji,j->ni", R, [0.0, 0.0, -9.80665])
        + noise * 0.02 * draw.normal(size=rate.shape),
    )


def _one(draw: np.random.Generator, r: Readings) -> Array:
    return [r.mag, r.gyro, r.accel][int(draw.integers(3))]


def _rows(draw: np.random.Generator, r: Readings) -> slice:
    a, b = sorted(int(x) for x in draw.integers(0, len(r.time_s) + 1, 2))
    return slice(0, None) if draw.random() < 0.5 else slice(a, b)


def _constant(draw: np.random.Generator, r: Readings) -> None:
    _one(draw, r)[_rows(draw, r)] = draw.choice([0.0, 0.1, -2.5])


def _axis_constant(draw: np.random.Generator, r: Readings) -> None:
    _one(draw, r)[_rows(draw, r), int(draw.integers(3))] = draw.choice([0.0, 0.1, 2.5])


def _scaled(draw: np.random.Generator, r: Readings) -> None:
    one = _one(draw, r)
    one *= draw.choice([1e-12, 1e-3, -1.0, 57.3, 1e3, 1e9])


def _nan(draw: np.random.Generator, r: Readings) -> None:
    one = _one(draw, r)
    share = draw.choice([0.001, 0.1, 0.9, 1.0])
    one[draw.random(len(one)) < share] = draw.choice([np.nan, np.inf])


def _coarse(draw: np.random.Generator, r: Readings) -> None:
    one, step = _one(draw, r), draw.choice([0.01, 0.3, 10.0])
    one[:] = step * np.rint(one / step)


def _held(draw: np.random.Generator, r: Readings) -> None:
    one, every = _one(draw, r), int(draw.choice([2, 20, 1000]))
    one[:] = one[np.arange(len(one)) // every * every]


def _swapped(draw: np.random.Generator, r: Readings) -> None:
    one = _one(draw, r)
    one[:] = one[:, draw.permutation(3)]


def _clipped(draw: np.random.Generator, r: Readings) -> None:
    one, limit = _one(draw, r), draw.choice([1e-6, 0.1, 0.3])
    np.clip(one, -limit, limit, out=one)


def _spikes(draw: np.random.Generator, r: Readings) -> None:
    one = _one(draw, r)
    rows = draw.integers(0, len(one), int(draw.choice([1, 30])))
    one[rows] = draw.choice([1e30, -1e5, 9.0])


def _noise_only(draw: np.random.Generator, r: Readings) -> None:
    one = _one(draw, r)
    one[:] = draw.choice([1e-9, 1.0]) * draw.normal(size=one.shape)


def _time(draw: np.random.Generator, r: Readings) -> None:
    match int(draw.integers(3)):
        case 0:
            r.time_s[int(draw.integers(len(r.time_s))) :] += draw.choice([1.0, 3600.0, 1e7])
        case 1:
            r.time_s[:] = np.cumsum(draw.exponential(1.0 / RATE_HZ, len(r.time_s)))
        case 2:
            r.time_s *= draw.choice([1e-2, 50.0])


FAULTS: tuple[Callable[[np.random.Generator, Readings], None], ...] = (
    _constant, _axis_constant, _scaled, _nan, _coarse, _held, _swapped, _clipped, _spikes,
    _noise_only, _time,
)  # fmt: skip


def broken(seed: int) -> tuple[Readings, str]:
    """A sensor with one to three faults, and their names."""
    draw = np.random.default_rng(seed)
    readings = moving(draw)
    chosen = draw.choice(len(FAULTS), int(draw.integers(1, 4)), replace=False)
    for k in chosen:
        FAULTS[k](draw, readings)
    return readings, " ".join(FAULTS[k].__name__.strip("_") for k in chosen)


def blocks(r: Readings, rows: int = 50) -> list[SampleBlock]:
    """As the stream's front end hands them on: finite field and rates, time that increases."""
    usable = np.isfinite(np.hstack([r.mag, r.gyro])).all(axis=1)
    usable &= (np.abs(r.mag) < 1e3).all(axis=1) & (np.abs(r.gyro) < 1e3).all(axis=1)
    kept = np.flatnonzero(usable)
    dt = np.concatenate([[np.nan], np.diff(r.time_s[kept])])
    gap = (dt > 1.5 / RATE_HZ * max(np.median(dt[1:]) * RATE_HZ, 1e-9)) if len(dt) > 1 else dt > 0
    starts = sorted({0, *np.flatnonzero(gap).tolist(), *range(0, len(kept), rows)})
    out = []
    for a, b in zip(starts, [*starts[1:], len(kept)], strict=True):
        at, steps = kept[a:b], dt[a:b].copy()
        begins = a == 0 or bool(gap[a])
        if begins and len(steps):
            steps[0] = np.nan
        if len(at):
            out.append(
                SampleBlock(
                    r.time_s[at], steps, r.time_s[at], r.mag[at], r.gyro[at],
                    known_force(r.accel[at]),
                    gap_before=begins,
                )
            )  # fmt: skip
    return out


def through_the_core(r: Readings) -> dict[str, object]:
    """All of it as a passive run; the summary."""
    core = Core(core_settings(Config(mode="passive"), stream_rate_hz=RATE_HZ))
    core.handle(RegistersKnown(0, {}, "test"))
    for block in blocks(r):
        core.handle(Samples(round(float(block.time_s[-1]) * 1e9), block))
    core.handle(Stop(round(float(r.time_s[-1]) * 1e9), "end"))
    return summary_json(core, "broken")


def through_the_diagnosis(r: Readings) -> str:
    """What is found, in words; ValueError of `diagnose` counts as words."""
    made = blocks(r)
    if not made:
        return "no samples"
    track: Track = check_track(track_of(made))[0]
    try:
        done = diagnose(track)
    except NothingToFit as error:
        assert "\n" not in str(error)
        return str(error)
    except np.linalg.LinAlgError:  # told as a fit that finds no end
        return "no fit"
    return json.dumps(done.to_json(), allow_nan=False)


def check(seed: int, *, diagnosed: bool) -> str:
    """What became of one case; raises what must not be raised."""
    readings, names = broken(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        if diagnosed:
            return f"{names}: {through_the_diagnosis(readings)}"
        body = through_the_core(readings)
    return f"{names}: {body['samples'] if 'samples' in body else sorted(body)[:4]}"


def main() -> int:
    """Each case; how many ended in what they must not."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--diagnose", action="store_true")
    options = parser.parse_args()
    wrong = 0
    for seed in range(options.first, options.first + options.cases):
        try:
            check(seed, diagnosed=options.diagnose)
        except (Exception, RuntimeWarning):  # noqa: BLE001 - each kind is a finding
            wrong += 1
            print(f"seed {seed}: {broken(seed)[1]}\n{traceback.format_exc(limit=-6)}")
    print(f"{options.cases} cases, {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
