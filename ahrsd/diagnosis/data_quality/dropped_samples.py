"""Samples that are missing although the time stamps do not show it.

With a lost sample its turn is lost.  The field is then ahead of the prediction by a whole multiple
of one step's turn, v = A (h x w) dt, at one sample and, since the filter forgets slowly, at the
following ones.  Noise causes such jumps forwards and backwards equally often: the backward ones
show how many of the forward ones are chance.

Lost turns are corrected one by one (`recover_lost_steps`): for each step, by how many more steps
than its gyro reading the sensor turned.  Jumps that stand out are corrected first, and the search
is repeated for those that they hid: the filter takes long to forget a jump, and the next one occurs
while it recovers.  A jump back by one step, near a corrected one, cancels that one: it had been
counted twice.

A lost step before row k moves the field that the filter predicts by v = h x w dt from there on.
Turned by the gyro into one frame, v is constant.  So the mean over the `L` rows from k on, less the
mean over the `L` rows before, is m v for m lost steps, with a standard deviation s that is
estimated from the differences:

    nats(m) = m z - m^2 I / 2 - ln(1 / share) - 3 - (m - 1) ln 4,   z = v . jump / s^2,
                                                                    I = |v|^2 / s^2

share is the share of rows before which turns were lost.  One in four such gaps is longer by one
more step.  Quick turns show over few rows, slow turns over many, as long as the next jump is not
among them.

If no single jump stands out, turns may still be lost.  With a share p of all rows that have a jump
by one step,

    nats(p) = 1/L sum log(1 - p + p exp(z - I / 2)).

Noise or a changing field gives as much for jumps by minus one step, or for jumps by much more or
less than one.  A gyro with too low a scale has z = e I in all rows; that is removed first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.innovation_filter.innovation import Filtered, run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Track
from ahrsd.printable import counted
from ahrsd.samples import Array

#: entry of the setting: number of long jumps
LONG = "long"
#: entry of the setting if only all jumps together show that turns were lost: their approximate
#: number
UNSEEN = "unseen"
_MEAN_LENGTHS = (3, 6, 12, 24, 48)  # rows that are averaged before and after a jump
_MOST_ROUNDS = 20
_NEAR_JUMP_SHARES = (0.01, 0.03, 0.1)  # share of rows whose mean contains a jump
_NEAR_SHARE = 0.25  # of a mean's rows: distance to the step that causes its jump
#: a quarter of the absolute values of a standard normal variable are below it
QUARTER_QUANTILE = 0.3186


def find_lost_turns_at_start(track: Track, model: NullModel) -> list[Fact]:
    """`find_lost_turns` at the recorded rate, with the calibration from which the fit starts."""
    done = run_filter(track, model, with_sensitivities=False)
    return find_lost_turns(done, track.gyro_b_rad_s - model.gyro_bias_rad_s)


def find_lost_turns(done: Filtered, rate_b_rad_s: Array) -> list[Fact]:
    """Where the filter's innovation jumps by whole steps.  rate_b_rad_s: (N, 3) without bias.

    Jumps that stand out are searched over few samples first, which shows quick turns, then over
    more, which shows slower ones.  If the evidence of all jumps together says that less than half
    of them stand out, all are recovered together.
    """
    track, zeros = done.track, np.zeros(len(done.track), dtype=np.int64)
    jumps = _significant_jumps(done, rate_b_rad_s)
    expected = count_from_all_jumps(done, rate_b_rad_s)
    if jumps is not None and 2 * len(jumps.forward) >= expected:
        lost = zeros.copy()
        lost[jumps.forward] = np.round(jumps.steps[jumps.forward])
        setting: dict[str, float] = {LONG: jumps.long} if jumps.long else {}
        turns = recover_lost_steps(done, rate_b_rad_s, lost)
    elif expected:
        setting = {UNSEEN: expected}
        turns = recover_lost_steps(done, rate_b_rad_s, zeros, expected)
    else:
        return []
    if np.count_nonzero(turns.lost) < priors.LOST_TURNS_FEWEST:
        return []
    return [_lost_samples_fact(track, turns, setting)]


def _significant_jumps(done: Filtered, rate_b_rad_s: Array) -> _Jumps | None:
    """Jumps by whole steps that noise does not explain; None if there are none.

    The shortest averaging that shows them decides.
    """
    for samples, least in priors.LOST_TURN_AVERAGED:
        if len(done.track) < 10 * samples:
            break
        found = _find_jumps(done, rate_b_rad_s, samples, least)
        jumps = found.forward
        fewest = priors.LOST_TURNS_FEWEST + 3 * len(found.backward) + found.others
        threshold = max(priors.LOST_TURNS_NATS, priors.LOST_TURN_EACH_NATS * len(jumps))
        evidence = whole_step_evidence(found.steps[jumps], found.scatter[jumps])
        if len(jumps) >= fewest and evidence > threshold:
            return found
    return None


def corrections_differ(before: Sequence[Fact], after: Sequence[Fact]) -> bool:
    """Whether two searches correct different turns."""
    first, then = (
        [fact.turned for fact in facts if fact.turned is not None] for facts in (before, after)
    )
    pairs = zip(first, then, strict=False)
    return len(first) != len(then) or not all(np.array_equal(a, b) for a, b in pairs)


def correction_cost(facts: Sequence[Fact]) -> float:
    """Nats that lost turns cost: the choice of their rows, and each further step of a gap."""
    turned = [fact.turned for fact in facts if fact.turned is not None]
    steps = np.round(np.concatenate([np.empty(0), *turned]) - 1.0)
    rows = int(np.count_nonzero(steps > 0))
    if not rows:
        return 0.0
    longer = float(np.sum(steps[steps > 0] - 1.0))
    return rows * float(np.log(len(steps) / rows)) + longer * priors.LONGER_GAP_NATS


@dataclass(frozen=True, slots=True, eq=False)
class _Jumps:
    """Jumps of the innovation, over one length of averaging.

    steps: (N,) by how many steps the field is ahead
    scatter: (N,) deviation of `steps` due to noise
    forward, backward: rows of jumps by whole steps
    others: number of jumps that no lost turn causes
    long: number of forward jumps far beyond noise: near lost turns, where a second or so was lost
    """

    steps: Array
    scatter: Array
    forward: NDArray[np.intp]
    backward: NDArray[np.intp]
    others: int
    long: int


def _find_jumps(done: Filtered, rate_b_rad_s: Array, samples: int, least: float) -> _Jumps:
    """Jumps of the means over `samples` rows.

    least: size of one step's turn, in deviations of the mean, from which on it can be measured
    """
    dt = np.nan_to_num(done.track.dt_s, nan=0.0)[:, None]
    v = np.cross(done.predicted_b, rate_b_rad_s * dt) @ done.model.soft_iron
    size = np.linalg.norm(v, axis=1)
    ahead = np.zeros_like(v)
    behind = np.zeros_like(v)
    stop = len(v) - samples
    total = np.concatenate([[0], np.cumsum(done.used)])
    complete = np.zeros(len(v), dtype=bool)
    complete[samples:stop] = total[2 * samples : -1] - total[: -2 * samples - 1] == 2 * samples
    for k in range(samples):
        ahead[:stop] += done.innovation[k : stop + k] / samples
        behind[samples:] += done.innovation[samples - 1 - k : len(v) - 1 - k] / samples
    jump = ahead - behind
    sigma = _jump_deviation(done, jump[complete], samples)
    steps = np.sum(jump * v, axis=1) / np.maximum(size**2, 1e-300)
    residual = np.linalg.norm(jump - steps[:, None] * v, axis=1)
    begins_here = np.sum(behind * v, axis=1) < 0.5 * size**2
    measurable = (size > least * sigma) & (residual < 5 * sigma) & complete & begins_here
    whole = np.abs(steps - np.round(steps)) < priors.LOST_TURN_NEAR
    forward = _local_maxima(
        measurable & whole & (steps > 1 - priors.LOST_TURN_NEAR), steps, samples
    )
    far = np.linalg.norm(jump, axis=1)
    clear = complete & (far > priors.JUMP_CLEAR * sigma)
    for k in forward.tolist():  # shortly before and after a jump its mean is not along the turn
        clear[max(0, k - 2 * samples) : k + 2 * samples] = False
    sudden = clear & (np.linalg.norm(behind, axis=1) < 0.5 * far)
    long = _local_maxima(
        sudden & (far > priors.JUMP_LONG * sigma) & (steps > 1.0 + 2 * priors.LOST_TURN_NEAR),
        far,
        samples,
    )
    # while the filter recovers from a long jump it makes many that no lost turn causes
    across = (sudden if len(long) else clear) & (
        (residual > priors.JUMP_ACROSS * far) | (steps < 0)
    )
    return _Jumps(
        steps,
        sigma / np.maximum(size, 1e-300),
        forward,
        _local_maxima(measurable & whole & (steps < -1 + priors.LOST_TURN_NEAR), -steps, samples),
        len(_local_maxima(across, far, samples)),
        len(long),
    )


def whole_step_evidence(steps: Array, scatter: Array) -> float:
    """Nats by which forward jumps (n,) of deviation `scatter` are whole steps and no tail of noise.

    Jumps by whole steps lie near an integer.  Of noise only the tail counts as a jump, and most of
    it lies close to the threshold.
    """
    whole = -0.5 * ((steps - np.round(steps)) / scatter) ** 2
    tail = -0.5 * (steps / scatter) ** 2 - log_ndtr(-(1 - priors.LOST_TURN_NEAR) / scatter)
    return float(np.sum(whole - tail))


def _jump_deviation(done: Filtered, jump: Array, samples: int) -> float:
    """Deviation of a mean over so many samples: the filter's, or that of the jumps if it is larger.

    Slow noise jumps by more than white noise does.  The smallest quarter of the jumps is taken as
    noise.
    """
    white = float(np.sqrt(np.median(done.gains.innovation_covariance[:, 0, 0]) / samples))
    if not len(jump):
        return white
    lowest = float(np.quantile(np.abs(jump), 0.25)) / QUARTER_QUANTILE
    return max(white, lowest / float(np.sqrt(2.0)))


def _lost_samples_fact(track: Track, turns: LostSteps, setting: Mapping[str, float]) -> Fact:
    """The lost samples as a fact; where a step may have been missed, the mean turn is corrected."""
    rows = np.flatnonzero(turns.lost)
    per_row = float(turns.lost.sum()) / max(float(np.sum(1.0 - turns.missed)), len(rows))
    share = per_row / (per_row + 1.0)
    missed = np.where(turns.lost > 0, 0.0, per_row * turns.missed)
    turned = np.asarray(1.0 + turns.lost + missed, np.float64)
    times = tuple((float(track.time_s[k - 1]), float(track.time_s[k])) for k in rows)
    words = (
        f"at {counted(len(rows), 'sample')} the field is ahead by whole steps of the "
        "rotation: samples are missing there, and the time stamps do not show it"
    )
    if UNSEEN in setting:
        words += "; most of them show only in all jumps together, not individually"
    where = Where(times, ("x", "y", "z"), "link")
    parameters = (Value("part", share, share / float(np.sqrt(len(rows))), "1"),)
    full_setting = {"hidden": True, **setting}
    return Fact(
        "dropped_samples",
        words,
        where,
        priors.SURE_OF_NOISE,
        parameters,
        full_setting,
        turned=turned,
        unseen=missed,
    )


def _local_maxima(rows: NDArray[np.bool], size: Array, samples: int) -> NDArray[np.intp]:
    """The rows with the largest `size` among those closer together than the averaging."""
    out: list[int] = []
    for k in np.flatnonzero(rows).tolist():
        if out and k - out[-1] < 2 * samples:
            if size[k] > size[out[-1]]:
                out[-1] = k
        else:
            out.append(k)
    return np.array(out, dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class LostSteps:
    """Lost steps before each row.

    lost: (N,) their number;  missed: (N,) probability that a lost step is not detected

    A lost step has I / 2 nats on average, with a standard deviation of sqrt(I).  It is missed if
    it has less than the cost of the share of rows.
    """

    lost: NDArray[np.int64]
    missed: Array


def recover_lost_steps(
    done: Filtered, rate_b_rad_s: Array, lost: NDArray[np.int64], expected: float = 1.0
) -> LostSteps:
    """The lost steps, corrected in rounds as long as the likelihood of the recording rises.

    rate_b_rad_s: (N, 3) without bias;  lost: (N,) steps that stood out at first
    expected: their number according to all jumps together (`count_from_all_jumps`)
    """
    model, A = done.model, done.model.soft_iron
    clean = done.predicted_b @ A.T + done.innovation + model.hard_iron_gauss
    has_reading = np.isfinite(done.track.mag_b_gauss).all(axis=1, keepdims=True)
    mag = np.where(has_reading, clean, np.nan)
    best, highest = LostSteps(lost, np.where(lost > 0, 0.0, 1.0)), -np.inf
    found, selected = None, np.zeros(0, dtype=np.int64)
    for _ in range(_MOST_ROUNDS):
        gyro = model.gyro_bias_rad_s + rate_b_rad_s * (1 + lost)[:, None]
        track = replace(done.track, mag_b_gauss=mag, gyro_b_rad_s=gyro)
        filtered = run_filter(track, model, with_sensitivities=False)
        likelihood = float(np.sum(filtered.log_likelihood[filtered.used]))
        if likelihood > highest:
            found = _most_probable_jumps(
                filtered, rate_b_rad_s, max(float(lost.sum()), expected), lost
            )
            best, highest = LostSteps(lost, found.missed), likelihood
            selected = _select_rows(found.nats, found.rows)
        else:  # some of them were wrong: retry the half with more evidence
            selected = selected[: len(selected) // 2]
        if found is None or not len(selected):
            break
        lost = _apply_jumps(best.lost, found, selected)
    return best


def _apply_jumps(
    lost: NDArray[np.int64], found: _RowJumps, selected: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The lost steps with those of the selected rows; a jump back reduces the nearest lost step.

    Two jumps back may be near the same lost step: the number never falls below 0.
    """
    now = lost.copy()
    for row in selected.tolist():
        now[row if found.steps[row] > 0 else _nearest_lost_row(lost, row)] += found.steps[row]
    return np.maximum(now, 0)


def _is_near_lost_step(lost: NDArray[np.int64], reach: int) -> NDArray[np.bool]:
    """(N,) rows with a lost step within `reach` rows."""
    ends = np.concatenate([np.zeros(reach + 1, np.int64), np.cumsum(lost > 0)])
    last = np.minimum(np.arange(len(lost)) + 2 * reach + 1, len(ends) - 1)
    return np.asarray(ends[last] > ends[: len(lost)])


def _nearest_lost_row(lost: NDArray[np.int64], row: int) -> int:
    """The row with a lost step that is nearest to this one."""
    rows = np.flatnonzero(lost)
    return int(rows[np.argmin(np.abs(rows - row))])


@dataclass(frozen=True, slots=True, eq=False)
class _RowJumps:
    """The most probable jump of each row, by the averaging length with most evidence for it.

    rows: that length;  missed: as in `LostSteps`
    """

    steps: NDArray[np.int64]
    nats: Array
    rows: NDArray[np.int64]
    missed: Array


@dataclass(frozen=True, slots=True, eq=False)
class JumpMeans:
    """Evidence of means over `length` rows: for rows k (n,), z (n,) and I (n,) of one step.

    size: I;  across: (n,) chi square, of two axes, of the part of the jump that no turn causes
    """

    length: int
    k: NDArray[np.int64]
    z: Array
    size: Array
    across: Array


def _jump_means(done: Filtered, rate_b_rad_s: Array) -> Iterator[JumpMeans]:
    """The evidence for each averaging length that fits into the recording."""
    if not done.used.any():  # no reading was used: no jumps
        return
    dt = np.nan_to_num(done.track.dt_s, nan=0.0)[:, None]
    v = np.einsum("nij,nj->ni", done.orientation, np.cross(done.predicted_b, rate_b_rad_s * dt))
    field_residual = done.innovation @ np.linalg.inv(done.model.soft_iron).T
    total = _cumulative_sums(np.einsum("nij,nj->ni", done.orientation, field_residual))
    usable = _cumulative_sums(done.used.astype(np.float64))
    white = float(np.sqrt(np.median(done.gains.innovation_covariance[done.used, 0, 0])))
    for length in _MEAN_LENGTHS:
        k = np.arange(length, len(v) - length)
        k = k[usable[k + length] - usable[k - length] == 2 * length]
        if len(k) < priors.LOST_TURN_ROWS * length:
            break
        jump = (total[k + length] - 2 * total[k] + total[k - length]) / length
        s = float(np.quantile(np.abs(jump), 0.25)) / QUARTER_QUANTILE
        s = max(s, white * float(np.sqrt(2.0 / length)))
        z, size = np.sum(jump * v[k], axis=1) / s**2, np.sum(v[k] ** 2, axis=1) / s**2
        along = z**2 / np.maximum(size, 1e-300)
        yield JumpMeans(length, k, z, size, np.sum(jump**2, axis=1) / s**2 - along)


def count_from_all_jumps(done: Filtered, rate_b_rad_s: Array) -> float:
    """Number of lost turns according to all jumps together, even if none stands out; or 0."""
    results = [forward_excess_evidence(mean) for mean in _jump_means(done, rate_b_rad_s)]
    nats, count = max(results, default=(0.0, 0.0))
    return count if nats > priors.LOST_TURNS_TOGETHER_NATS else 0.0


def forward_excess_evidence(mean: JumpMeans) -> tuple[float, float]:
    """Nats for jumps by one step ahead, less those for backward ones, and their approximate number.

    No nats if jumps of another size are more probable.  A mean contains rows near the jump, most of
    which have only a part of it: hence a part of a step is tested.
    """
    measurable = mean.size > 1.0
    scale = (
        float(np.median(mean.z[measurable] / mean.size[measurable])) if measurable.any() else 0.0
    )
    along_turn = mean.across < priors.JUMP_ACROSS_CHI2
    z, size = mean.z[along_turn] - scale * mean.size[along_turn], mean.size[along_turn]

    def nats(step: float) -> tuple[float, float]:
        odds = np.exp(np.minimum(step * z - step**2 * size / 2, priors.JUMP_MOST_NATS)) - 1.0
        candidates = [(float(np.sum(np.log1p(share * odds))), share) for share in _NEAR_JUMP_SHARES]
        total, share = max(candidates)
        return total / mean.length, share * len(z) / mean.length

    forward, count = nats(priors.LOST_TURN_PART)
    if forward < priors.LOST_TURNS_TOGETHER_NATS or forward < max(
        nats(step)[0] for step in priors.OTHER_PARTS
    ):
        return 0.0, 0.0
    return forward - priors.LOST_TURNS_BACKWARD * max(nats(-priors.LOST_TURN_PART)[0], 0.0), count


def _most_probable_jumps(
    done: Filtered, rate_b_rad_s: Array, count: float, lost: NDArray[np.int64]
) -> _RowJumps:
    """Jumps by whole steps, and jumps back by one step near those that were corrected, `lost`.

    count: number of steps that are known to be lost
    """
    n = len(done.track)
    least = float(np.log(n / count)) + priors.LOST_TURN_BEYOND_SHARE_NATS
    one = np.ones(n, dtype=np.int64)
    out = _RowJumps(one, np.full(n, -np.inf), one.copy(), np.ones(n))
    for mean in _jump_means(done, rate_b_rad_s):
        z, size = mean.z, mean.size
        steps = np.maximum(np.round((z - priors.LONGER_GAP_NATS) / np.maximum(size, 1e-300)), 1.0)
        nats = steps * z - steps**2 * size / 2 - least - priors.LONGER_GAP_NATS * (steps - 1)
        about = _is_near_lost_step(lost, 1 + int(_NEAR_SHARE * mean.length))
        back = np.where(about[mean.k], -z - size / 2 - priors.COUNTED_TWICE_NATS, -np.inf)
        steps, nats = np.where(back > nats, -1, steps), np.maximum(nats, back)
        better = nats > out.nats[mean.k]
        at = mean.k[better]
        out.nats[at], out.steps[at], out.rows[at] = nats[better], steps[better], mean.length
        missed = ndtr((least - size / 2) / np.sqrt(np.maximum(size, 1e-12)))
        out.missed[mean.k] = np.minimum(out.missed[mean.k], missed)
    return out


def _cumulative_sums(values: Array) -> Array:
    """Sums of the first 0, 1, ... N rows."""
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])


def _select_rows(nats: Array, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows with more than 0 nats; within the reach of their means only the one with most.

    In order of decreasing evidence.
    """
    out: list[int] = []
    candidates = np.flatnonzero(nats > 0)
    for k in candidates[np.argsort(-nats[candidates], kind="stable")].tolist():
        if all(abs(k - other) > 2 * rows[k] for other in out):
            out.append(k)
    return np.array(out, dtype=np.int64)
