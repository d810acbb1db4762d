"""Compare a recording with a simulation that the user supplies: common time, and differing effects.

The two have the same motion if their rates agree, so the rates align them: at the shift of largest
correlation between the two gyros or, where their axes differ, between the magnitudes.  A
simulation contains the effects that its author put in.  An effect that both have to the same size
is no difference; one that only the recording has was left out of the simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

LONGEST_SHIFT_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """Both over their common time, and notes on the alignment."""

    real: Track
    simulated: Track
    notes: tuple[str, ...]


def align(real: Track, simulated: Track) -> Overlap:
    """The common time of both.  ValueError where there is none, or where the motions differ."""
    shift_s, correlation = _clock_shift(real, simulated)
    begin = max(real.time_s[0], simulated.time_s[0] - shift_s)
    end = min(real.time_s[-1], simulated.time_s[-1] - shift_s)
    if end - begin < priors.OVERLAP_S:
        raise ValueError(
            f"overlaps the recording by {max(end - begin, 0.0):.1f} s only: it covers "
            f"{simulated.time_s[0]:.1f} to {simulated.time_s[-1]:.1f} s, the recording "
            f"{real.time_s[0]:.1f} to {real.time_s[-1]:.1f} s"
        )
    if correlation < priors.SAME_MOTION:
        raise ValueError(
            f"is of another motion: its rates correlate with the recording's by only "
            f"{correlation:.2f}, {priors.SAME_MOTION} is needed"
        )
    notes = [f"compared over {end - begin:.1f} s, from {begin:.1f} to {end:.1f} s"]
    if abs(shift_s) > 0.5 * _step_s(real):
        notes.append(
            f"the simulation was shifted by {shift_s:+.3f} s to match the recording's rates"
        )
    moved = replace(simulated, time_s=simulated.time_s - shift_s)
    return Overlap(cut_track(real, begin, end), cut_track(moved, begin, end), tuple(notes))


def _step_s(track: Track) -> float:
    return float(np.nanmedian(track.dt_s))


def _clock_shift(real: Track, simulated: Track) -> tuple[float, float]:
    """Shift in s of the simulation's clock against the recording's, and the correlation there."""
    step = max(_step_s(real), _step_s(simulated))
    reach = round(LONGEST_SHIFT_S / step)
    begin = max(real.time_s[0], simulated.time_s[0])
    end = min(real.time_s[-1], simulated.time_s[-1])
    if end - begin < priors.OVERLAP_S:
        return 0.0, 1.0  # the caller raises the error
    grid = np.arange(begin, end, step)
    a, b = (_resampled_rates(track, grid) for track in (real, simulated))
    reach = min(reach, len(grid) // 4)
    found = _best_lag(a, b, reach)
    if found[1] < priors.SAME_MOTION:  # the axes of one may be swapped
        found = max(
            found,
            _best_lag(_rate_magnitudes(a), _rate_magnitudes(b), reach),
            key=lambda one: one[1],
        )
    return found[0] * step, found[1]


def _best_lag(a: Array, b: Array, reach: int) -> tuple[int, float]:
    """Lag in rows of b (N, k) behind a, within reach, and the correlation at that lag."""
    best = (0, -1.0)
    for lag in range(-reach, reach + 1):
        x = a[max(0, -lag) : len(a) - max(0, lag)]
        y = b[max(0, lag) : len(b) - max(0, -lag)]
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
        power = float(np.sum(x * x) * np.sum(y * y))
        if power > 0.0:
            best = max(best, (lag, float(np.sum(x * y)) / power**0.5), key=lambda one: one[1])
    return best


def _resampled_rates(track: Track, grid_s: Array) -> Array:
    axes = [np.interp(grid_s, track.time_s, values) for values in track.gyro_b_rad_s.T]
    return np.stack(axes, axis=1)


def _rate_magnitudes(rates: Array) -> Array:
    """(N, 1) magnitudes, with the median subtracted as the bias."""
    return np.asarray(np.linalg.norm(rates - np.median(rates, axis=0), axis=1))[:, None]


def cut_track(track: Track, begin_s: float, end_s: float) -> Track:
    """The rows between two times."""
    rows = slice(
        int(np.searchsorted(track.time_s, begin_s, "left")),
        int(np.searchsorted(track.time_s, end_s, "right")),
    )
    dt_s = track.dt_s[rows].copy()
    dt_s[:1] = np.nan
    starts = [*np.flatnonzero(np.isnan(dt_s)).tolist(), len(dt_s)]
    return Track(
        track.time_s[rows],
        dt_s,
        track.mag_b_gauss[rows],
        track.gyro_b_rad_s[rows],
        None if track.accel_b_m_s2 is None else track.accel_b_m_s2[rows],
        {name: values[rows] for name, values in track.covariates.items()},
        tuple(slice(a, b) for a, b in pairwise(starts)),
    )


def remove_common_findings(real: Diagnosis, simulated: Diagnosis) -> Diagnosis:
    """The recording's diagnosis without the findings that the simulation has to the same size."""
    remaining: list[Finding] = []
    notes: list[str] = []
    by_effect = {finding.effect: finding for finding in simulated.findings}
    for finding in real.findings:
        counterpart = by_effect.get(finding.effect)
        if counterpart is not None and _same_size(finding, counterpart):
            notes.append(f"{finding.effect} is in the simulation already, to the same size")
        else:
            remaining.append(finding)
    only = [effect for effect in by_effect if effect not in {one.effect for one in real.findings}]
    notes += [f"the simulation has {effect}, the recording does not show it" for effect in only]
    notes += _calibration_notes(real, simulated)
    mismatch = bool(remaining) or real.unexplained.detected or bool(only)
    return replace(real, findings=tuple(remaining), mismatch=mismatch, notes=(*real.notes, *notes))


def _same_size(one: Finding, other: Finding) -> bool:
    """True if all parameters agree within their standard deviations."""
    values = {value.name: value for value in other.parameters}
    for value in one.parameters:
        counterpart = values.get(value.name)
        if counterpart is None:
            return False
        sigma = float(np.hypot(value.std, counterpart.std))
        if not abs(value.value - counterpart.value) <= priors.SAME_SIGMAS * max(sigma, 1e-12):
            return False
    return True


def _calibration_notes(real: Diagnosis, simulated: Diagnosis) -> list[str]:
    """Differences between the two calibrations: not a mismatch, but worth a note."""
    if real.model is None or simulated.model is None:
        return []
    hard = real.model.hard_iron_gauss - simulated.model.hard_iron_gauss
    bias = real.model.gyro_bias_rad_s - simulated.model.gyro_bias_rad_s
    return [
        "calibration of the recording less that of the simulation: hard iron "
        + ", ".join(f"{v * 1e3:+.2f}" for v in hard)
        + " mG, gyro bias "
        + ", ".join(f"{v * 1e3:+.3f}" for v in bias)
        + " mrad/s"
    ]
