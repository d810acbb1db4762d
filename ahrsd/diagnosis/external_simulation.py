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
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Contribution, Diagnosis, Finding, Unexplained
from ahrsd.diagnosis.answer.text import setting_text, value_text, where_text
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

LONGEST_SHIFT_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """Both over their common time, and notes on the alignment.

    other_axes: how the simulation's axes lie in the recording's; empty where they are the same
    """

    real: Track
    simulated: Track
    notes: tuple[str, ...]
    other_axes: str = ""


def align(real: Track, simulated: Track) -> Overlap:
    """The common time of both.  ValueError where there is none, or where the motions differ."""
    shift_s, correlation, other_axes = _clock_shift(real, simulated)
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
    both = cut_track(real, begin, end), cut_track(moved, begin, end)
    return Overlap(*both, tuple(notes), other_axes)


def _step_s(track: Track) -> float:
    return float(np.nanmedian(track.dt_s))


def _clock_shift(real: Track, simulated: Track) -> tuple[float, float, str]:
    """Shift in s of the simulation's clock against the recording's, the correlation there, and how
    the simulation's axes lie in the recording's, where they are others."""
    step = max(_step_s(real), _step_s(simulated))
    reach = round(LONGEST_SHIFT_S / step)
    begin = max(real.time_s[0], simulated.time_s[0])
    end = min(real.time_s[-1], simulated.time_s[-1])
    if end - begin < priors.OVERLAP_S:
        return 0.0, 1.0, ""  # the caller raises the error
    grid = np.arange(begin, end, step)
    a, b = (_resampled_rates(track, grid) for track in (real, simulated))
    reach = min(reach, len(grid) // 4)
    lag, most = _best_lag(a, b, reach)
    if most >= priors.SAME_MOTION:
        # an axis that turns little hardly counts in a correlation over all axes
        axes = _nearest_axes(*_at_lag(a, b, lag))
        return lag * step, most, _axes_words(axes) if _differ(axes) else ""
    turned = _best_lag(_rate_magnitudes(a), _rate_magnitudes(b), reach)
    if turned[1] <= most:
        return lag * step, most, ""
    return turned[0] * step, turned[1], _axes_words(_nearest_axes(*_at_lag(a, b, turned[0])))


def _nearest_axes(a: Array, b: Array) -> dict[int, tuple[int, float]]:
    """For each axis of a (N, 3), the axis of b (N, 3) that turns as it does, and the sign.

    Left out are axes that turn too little by themselves, or as no axis of b does.
    """
    own, others = _own_rates(a), _own_rates(b)
    found = {}
    for axis in range(3):
        correlation = [_correlation(own[:, axis], other) for other in others.T]
        nearest = int(np.argmax(np.abs(correlation)))
        if abs(correlation[nearest]) >= priors.SAME_MOTION:
            found[axis] = (nearest, float(np.sign(correlation[nearest])))
    return found


def _own_rates(rates: Array) -> Array:
    """(N, 3) rates about their means, each without what the other two axes explain; zero where an
    axis turns too little by itself.

    An axis at rest reads a share of the others' rates if it is misaligned, of either sign.
    """
    centred = rates - rates.mean(axis=0)
    least = priors.TURNS_BY_ITSELF * float(np.sqrt(np.mean(np.sum(centred**2, axis=1))))
    own = np.zeros_like(centred)
    for axis in range(3):
        others = np.delete(centred, axis, axis=1)
        explained = others @ np.linalg.lstsq(others, centred[:, axis], rcond=None)[0]
        by_itself = centred[:, axis] - explained
        if float(np.std(by_itself)) > least:
            own[:, axis] = by_itself
    return np.asarray(own)


def _correlation(a: Array, b: Array) -> float:
    power = float(np.sum(a * a) * np.sum(b * b))
    return float(np.sum(a * b)) / power**0.5 if power > 0.0 else 0.0


def _differ(axes: dict[int, tuple[int, float]]) -> bool:
    """Whether any axis is not the one of the same name."""
    return any(one != (axis, 1.0) for axis, one in axes.items())


def _axes_words(axes: dict[int, tuple[int, float]]) -> str:
    """The axes of the simulation that are x, y and z of the recording."""
    pairs = [
        f"{'+' if sign > 0.0 else '-'}{'xyz'[nearest]} is the recording's {'xyz'[axis]}"
        for axis, (nearest, sign) in axes.items()
    ]
    return f"its {', its '.join(pairs)}" if pairs else "no axis of it is one of the recording's"


def _best_lag(a: Array, b: Array, reach: int) -> tuple[int, float]:
    """Lag in rows of b (N, k) behind a, within reach, and the correlation at that lag.

    Over the rows that both have at each lag, about their means there.
    """
    from scipy.signal import correlate  # slow to import, and seldom needed

    lags = np.arange(-reach, reach + 1)
    begins, ends = np.maximum(0, -lags), len(a) - np.maximum(0, lags)
    x, y = a - a.mean(axis=0), b - b.mean(axis=0)
    products = sum(
        correlate(of_y, of_x, method="fft")[len(a) - 1 + lags]
        for of_x, of_y in zip(x.T, y.T, strict=True)
    )
    sum_x, square_x = _sums(x, begins, ends)
    sum_y, square_y = _sums(y, begins + lags, ends + lags)
    rows = (ends - begins)[:, None]
    covariance = products - np.sum(sum_x * sum_y / rows, axis=1)
    power_x, power_y = (
        np.sum(square - total**2 / rows, axis=1)
        for square, total in ((square_x, sum_x), (square_y, sum_y))
    )
    power = np.sqrt(np.maximum(power_x, 0.0) * np.maximum(power_y, 0.0))
    if not power.any():
        return 0, -1.0
    correlation = np.divide(covariance, power, out=np.full(len(lags), -1.0), where=power > 0.0)
    best = int(np.argmax(correlation))
    return int(lags[best]), float(correlation[best])


def _sums(values: Array, begins: NDArray[np.intp], ends: NDArray[np.intp]) -> tuple[Array, Array]:
    """Sums (L, k) of values (N, k) and of their squares, of the rows from `begins` to `ends`."""
    total, square = (
        np.cumsum(np.pad(one, ((1, 0), (0, 0))), axis=0) for one in (values, values**2)
    )
    return total[ends] - total[begins], square[ends] - square[begins]


def _at_lag(a: Array, b: Array, lag: int) -> tuple[Array, Array]:
    """The rows that both have where b is `lag` rows behind a."""
    return a[max(0, -lag) : len(a) - max(0, lag)], b[max(0, lag) : len(b) - max(0, -lag)]


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


def remove_common_findings(real: Diagnosis, simulated: Diagnosis, other_axes: str) -> Diagnosis:
    """The recording's diagnosis without what the simulation has to the same size at the same times.

    other_axes: as in `Overlap`
    """
    notes = [] if not other_axes else [f"the simulation has other axes: {other_axes}"]
    remaining, only, finding_notes = _compare_findings(real, simulated)
    left, unknown_only, unknown_notes = _compare_unexplained(real, simulated)
    notes += [*finding_notes, *unknown_notes]
    if simulated.undecided is not None:
        notes.append(f"the simulation cannot be judged: {simulated.undecided}")
    elif simulated.model is None:
        notes.append("the simulation was compared no further: correct this first")
    if not other_axes:
        notes += _calibration_notes(real, simulated)
    by_recording = bool(remaining) or left.detected
    by_simulation = only or unknown_only or bool(other_axes)
    if by_simulation:
        p_value = min(real.p_value if by_recording else 1.0, simulated.p_value)
    elif not by_recording and real.mismatch:
        p_value = 1.0  # all that the recording shows is in the simulation
    else:
        p_value = real.p_value
    return replace(
        real,
        findings=remaining,
        unexplained=left,
        mismatch=by_recording or by_simulation,
        p_value=0.0 if other_axes else p_value,
        notes=(*real.notes, *notes),
    )


def _compare_findings(
    real: Diagnosis, simulated: Diagnosis
) -> tuple[tuple[Finding, ...], bool, list[str]]:
    """The findings that only the recording has, whether the simulation has others, and notes."""
    remaining: list[Finding] = []
    others = list(simulated.findings)
    notes: list[str] = []
    for finding in real.findings:
        same = next((one for one in others if _is_same(finding, real, one, simulated)), None)
        if same is None:
            remaining.append(finding)
        else:
            others.remove(same)
            where = "is in the simulation already, to the same size"
            notes.append(f"{finding.effect} {where}")
    effects = {one.effect for one in remaining}
    for one in others:
        if one.effect in effects:
            notes.append(f"{one.effect} is in the simulation too, but differs: {_described(one)}")
        else:
            words = f"the simulation has {one.effect}, the recording does not show it"
            notes.append(f"{words}: {_described(one)}")
    return tuple(remaining), bool(others), notes


def _described(one: Finding) -> str:
    """Size and place of a finding of the simulation; what was counted has it in its words."""
    if one.term is None:
        return one.words
    sizes = [value_text(value) for value in one.parameters]
    return "; ".join([*sizes, *filter(None, [setting_text(one.setting)]), where_text(one.where)])


def _compare_unexplained(
    real: Diagnosis, simulated: Diagnosis
) -> tuple[Unexplained, bool, list[str]]:
    """What only the recording has unexplained, whether only the simulation has, and notes."""
    one, other = real.unexplained, simulated.unexplained
    if not other.detected:
        return one, False, []
    place = "" if other.where is None else f": {where_text(other.where)}"
    if not one.detected:
        words = "the simulation has an unknown cause, the recording does not show it"
        return one, True, [f"{words}{place}"]
    if _is_same_unknown(one, other):
        return Unexplained(False), False, [f"the unknown cause is in the simulation too{place}"]
    return one, False, [f"the simulation has an unknown cause too, but it differs{place}"]


def _is_same_unknown(one: Unexplained, other: Unexplained) -> bool:
    """True if both have one direction in one frame, and one time series along it."""
    if one.where is None or other.where is None or one.where.frame != other.where.frame:
        return False
    if one.where.direction is None or other.where.direction is None:
        return False
    cosine = float(np.dot(one.where.direction, other.where.direction))
    if abs(cosine) < priors.SAME_DIRECTION or not one.course or not other.course:
        return False
    (time_s, course), (other_s, counterpart) = (np.array(x.course).T for x in (one, other))
    at_same_time = np.sign(cosine) * np.interp(time_s, other_s, counterpart)
    return _relative_difference(course[:, None], at_same_time[:, None]) < priors.SAME_UNKNOWN


def _is_same(one: Finding, real: Diagnosis, other: Finding, simulated: Diagnosis) -> bool:
    """True if two findings are of one effect, of one size, and add the same at the same times."""
    if one.effect != other.effect or not _same_size(one, other):
        return False
    added, counterpart = _contribution(one, real), _contribution(other, simulated)
    if added is None or counterpart is None:
        return _hulls_overlap(one, other)
    at_same_time = [
        np.interp(added.time_s, counterpart.time_s, axis) for axis in counterpart.added.T
    ]
    uncertain = float(np.hypot(_relative_deviation(one), _relative_deviation(other)))
    most = priors.SAME_COURSE + priors.SAME_SIGMAS * uncertain
    return _relative_difference(added.added, np.stack(at_same_time, axis=1)) < most


def _contribution(one: Finding, found: Diagnosis) -> Contribution | None:
    """What a finding adds to the readings over time; None for what was counted and not fitted."""
    return None if one.term is None or found.drawn is None else found.drawn.contributions[one.term]


def _relative_difference(one: Array, other: Array) -> float:
    """Deviation of the difference of two time series (N, k), over that of the smaller one.

    About their means: a constant part is calibration.
    """
    least = min(float(np.sum(np.var(values, axis=0))) for values in (one, other))
    apart = float(np.sum(np.var(one - other, axis=0)))
    return (apart / least) ** 0.5 if least > 0.0 else (0.0 if apart == 0.0 else float("inf"))


def _relative_deviation(one: Finding) -> float:
    """Standard deviation of a finding's size over its size, all parameters together."""
    power = sum((v.value / v.std) ** 2 for v in one.parameters if v.std > 0.0)
    return (len(one.parameters) / power) ** 0.5 if power > 0.0 else 0.0


def _hulls_overlap(one: Finding, other: Finding) -> bool:
    """Whether the times from first to last overlap; those of a whole recording do."""
    a, b = one.where.intervals_s, other.where.intervals_s
    return not a or not b or (a[0][0] <= b[-1][1] and b[0][0] <= a[-1][1])


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
    soft = real.model.soft_iron - simulated.model.soft_iron
    bias = real.model.gyro_bias_rad_s - simulated.model.gyro_bias_rad_s
    noises = [
        f"{one.sigma_mag_gauss * 1e3:.2g} mG and {one.sigma_gyro_rad_s * 1e3:.2g} mrad/s"
        for one in (real.model, simulated.model)
    ]
    return [
        "calibration of the recording less that of the simulation: hard iron "
        + ", ".join(f"{v * 1e3:+.2f}" for v in hard)
        + f" mG, soft iron up to {np.abs(soft).max():.2%}, gyro bias "
        + ", ".join(f"{v * 1e3:+.3f}" for v in bias)
        + f" mrad/s; noise of a sample: {noises[0]}, of the simulation {noises[1]}"
    ]
