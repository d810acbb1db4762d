"""The recording linearised at a model: rows by frequency, products of components band by band.

At the point (calibration c, coefficients w) the innovations are e = y - B w - C (c - c0) to first
order; y = e + B w + C (c - c0), so every hypothesis is judged with zero-mean priors at one point,
whichever components hold at it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct, next_fast_len

from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.null_fit import prior_of
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.inference.components.component import Component, Fixed
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.diagnosis.inference.likelihood.directed_noise import Directed, directed
from ahrsd.diagnosis.inference.likelihood.evidence import At, Products
from ahrsd.diagnosis.innovation_filter.context import build_context
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    batch_columns,
    filtered_for_regression,
    join_columns,
    nuisance_columns,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.model import Columns, Context, NullModel
from ahrsd.diagnosis.where_and_when.narrow_band import BAND_HZ
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

CALIBRATION = "calibration"
#: columns that pass the filter together, at most, and numbers that they have
_BATCH, _NUMBERS = 96, 4_000_000
#: number of the readings among the batches
_Y = -1
#: rows whose products are made at once
_ROWS = 8192


@dataclass(frozen=True, slots=True, eq=False)
class _Named:
    """What a context is made of."""

    filtered: Filtered
    terms_gyro: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Where everything is linearised.

    values: coefficients by component that are taken out of the readings
    terms_mag, terms_gyro: (N, 3) what they add;  loud: rows of the noise
    exact: components that are taken out of the track itself: the delay
    misread: (N, 3) rad/s of terms_gyro that a name stands for.  Columns are made of rates without
             it, but with all that has none: of rates less their own squares, squares run away
    directed: what makes the noise louder along one direction, None where nothing does
    """

    problem: Problem
    filtered: Filtered
    values: Mapping[str, Array]
    terms_mag: Array | None
    terms_gyro: Array | None
    loud: noise_model.Loudness
    exact: tuple[str, ...] = ()
    misread: Array | None = None
    directed: Directed | None = None

    @property
    def context(self) -> Context:
        """The recording as columns are made of it."""
        return build_context(self.problem.track, _Named(self.filtered, self.misread))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A component and where its rows are: columns of one of the arrays that passed together."""

    component: Component
    batch: int
    columns: slice


@dataclass(eq=False)
class Linearised:
    """A point, the context there, and products of components, each made once.

    batches: (3 M, p) rows of components that passed the filter together, as the noise sees them,
             in single precision, which is one part in ten million of a column
    apart: what has a batch of its own: each that was a member of a model
    alone: numbers of bands of the noise that stand alone, None where there are none
    whitening: (B, 3, 3) that make each band alike on all axes, None where it is
    """

    point: Point
    context: Context
    regressing: Filtered
    edges: NDArray[np.intp]
    y: Array
    seen: dict[str, Seen] = field(default_factory=dict)
    batches: list[Array] = field(default_factory=list)
    blocks: dict[tuple[int, int], Array] = field(default_factory=dict)
    alone: slice | None = None
    whitening: Array | None = None
    apart: set[str] = field(default_factory=set)

    def add(self, components: Sequence[Component]) -> None:
        """Pass components through the filter; what is known already is left out.

        Components that have their columns in common pass once.
        """
        unknown = [one for one in components if one.key not in self.seen]
        had = {id(one.component.columns): one for one in self.seen.values()}
        for one in unknown:
            if id(one.columns) in had:
                self.seen[one.key] = replace(had[id(one.columns)], component=one)
        unknown = [one for one in unknown if one.key not in self.seen]
        first = {id(one.columns): one for one in reversed(unknown)}
        new = list(reversed(first.values()))
        parts = [Columns(one.columns.mag, one.columns.gyro) for one in new]
        amplitude = self.point.loud.amplitude[:, None, None]
        for batch in batch_columns(parts, self._together()):
            cube = sensitivities(self.regressing, join_columns([parts[k] for k in batch]))
            rows = by_frequency(np.divide(cube, amplitude, dtype=np.float32, casting="same_kind"))
            self.batches.append(self.as_loud(rows))
            at = 0
            for k in batch:
                columns = slice(at, at + new[k].width)
                self.seen[new[k].key] = Seen(new[k], len(self.batches) - 1, columns)
                at += new[k].width
        for one in unknown:
            twin = self.seen[first[id(one.columns)].key]
            self.seen[one.key] = replace(twin, component=one)

    def as_loud(self, rows: Array) -> Array:
        """Rows by frequency (3 M, p) in axes along which the noise is alike."""
        return rows if self.whitening is None else self._turned(rows, self.whitening)

    def as_read(self, rows: Array) -> Array:
        """The inverse of that."""
        if self.whitening is None:
            return rows
        return self._turned(rows, np.asarray(np.linalg.inv(self.whitening)))

    def _turned(self, rows: Array, by: Array) -> Array:
        """Rows by frequency (3 M, p), the three of each multiplied by its band's matrix."""
        out = rows.reshape(-1, 3, rows.shape[1]).copy()
        for matrix, (a, b) in zip(
            by.astype(rows.dtype), itertools.pairwise(self.edges), strict=True
        ):
            out[a:b] = np.einsum("ij,njp->nip", matrix, out[a:b])
        return out.reshape(rows.shape)

    def _together(self) -> int:
        """Columns that pass the filter together: fewer of a long recording, to save memory."""
        return int(np.clip(_NUMBERS // (3 * len(self.point.loud.amplitude)), 1, _BATCH))

    def copied(self) -> Linearised:
        """The same, to which components can be added that end with it."""
        seen, rows, blocks = dict(self.seen), list(self.batches), dict(self.blocks)
        return replace(self, seen=seen, batches=rows, blocks=blocks, apart=set(self.apart))

    def rows(self, key: str) -> Array:
        """(3 M, q) of a component, by frequency, lowest first."""
        one = self.seen[key]
        return self.batches[one.batch][:, one.columns].astype(float)

    def keep_lightly(self, components: Sequence[Component]) -> None:
        """Keep no columns of effects that have passed: they are made again when asked for."""
        for one in components:
            known = self.seen[one.key]
            if known.component is one:
                self.seen[one.key] = replace(known, component=one.lightly(self.context))

    def _apart(self, keys: Sequence[str]) -> None:
        """Give each a batch of its own: it meets all others, and its neighbours need not."""
        for key in set(keys) - self.apart:
            one = self.seen[key]
            self.batches.append(self.batches[one.batch][:, one.columns].copy())
            own = slice(0, one.component.width)
            self.seen[key] = replace(one, batch=len(self.batches) - 1, columns=own)
        self.apart.update(keys)

    def put_back(self, values: Mapping[str, Array]) -> None:
        """Add what is taken out of the readings to y, for components that are known here."""
        for key, value in values.items():
            self.y = self.y + self.rows(key) @ value
        self.blocks = {pair: found for pair, found in self.blocks.items() if _Y not in pair}

    def block(self, left: int, right: int) -> Array:
        """(B, p, p') products of two batches band by band; of _Y (B, p, 1) with y."""
        if (left, right) not in self.blocks:
            X = self.batches[left]
            Y = self.y[:, None] if right == _Y else self.batches[right]
            bands = self._bands()
            found = np.stack([X[a:b].astype(float).T @ Y[a:b].astype(float) for a, b in bands])
            self.blocks[left, right] = found
            if right != _Y:
                self.blocks[right, left] = np.swapaxes(found, 1, 2)
        return self.blocks[left, right]

    def meet(self, left: Sequence[int], right: Sequence[int]) -> None:
        """Make the products of two groups of batches together: each is widened to double once."""
        alike = left is right
        mine, its = (self._places(one) for one in (left, right))
        out = np.zeros((len(self.edges) - 1, mine[-1].stop, its[-1].stop))
        for k, (begin, end) in enumerate(self._bands()):
            for a in range(begin, end, _ROWS):
                rows = slice(a, min(end, a + _ROWS))
                X = self._widened(left, rows)
                out[k] += X.T @ (X if alike else self._widened(right, rows))
        for one, own in zip(left, mine, strict=True):
            for other, part in zip(right, its, strict=True):
                found = out[:, own, part]
                self.blocks[one, other] = found
                self.blocks[other, one] = np.swapaxes(found, 1, 2)

    def _widened(self, numbers: Sequence[int], rows: slice) -> Array:
        return np.concatenate([self.batches[k][rows] for k in numbers], axis=1, dtype=float)

    def _places(self, numbers: Sequence[int]) -> list[slice]:
        ends = np.cumsum([0, *(self.batches[k].shape[1] for k in numbers)]).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    def pair(self, left: str, right: str) -> Array:
        """(B, q, q') products of two components, band by band."""
        one, other = self.seen[left], self.seen[right]
        return self.block(one.batch, other.batch)[:, one.columns, other.columns]

    def cross(self, key: str) -> Array:
        """(B, q) products of a component with y."""
        one = self.seen[key]
        return self.block(one.batch, _Y)[:, one.columns, 0]

    def _bands(self) -> list[tuple[int, int]]:
        return [(3 * int(a), 3 * int(b)) for a, b in itertools.pairwise(self.edges)]

    def products(self, keys: Sequence[str], step: float) -> Products:
        """All that the data say of these components; step: prior of the noise's spectrum."""
        self._apart(keys)
        own = [self.seen[key].batch for key in keys]
        new = [k for k in own if (k, k) not in self.blocks]
        had = [k for k in own if (k, k) in self.blocks]
        if new:
            self.meet(new, new)
        if new and had:
            self.meet(new, had)
        ends = np.cumsum([0, *(self.seen[key].component.width for key in keys)])
        parts = [(key, slice(a, b)) for key, (a, b) in zip(keys, itertools.pairwise(ends))]
        G = np.empty((len(self.edges) - 1, ends[-1], ends[-1]))
        for (one, mine), (other, its) in itertools.combinations_with_replacement(parts, 2):
            found = self.pair(one, other)
            G[:, mine, its] = found
            G[:, its, mine] = np.swapaxes(found, 1, 2)
        s = self._crossed(keys)
        square = np.array([float(self.y[a:b] @ self.y[a:b]) for a, b in self._bands()])
        used = float(np.count_nonzero(self.point.filtered.used)) / int(self.edges[-1])
        rows = np.array([(b - a) * used for a, b in self._bands()])
        return Products(G, s, square, rows, step, self.alone)

    @property
    def log_whitening(self) -> float:
        """By how much the rows are denser than readings, nats: makes points comparable."""
        done, used, loud = self.point.filtered, self.point.filtered.used, self.point.loud
        own = done.log_likelihood + 0.5 * np.sum(done.whitened**2, axis=1) + 1.5 * np.log(2 * np.pi)
        nats = float(loud.tails + np.sum(own[used]) - 3.0 * np.sum(np.log(loud.amplitude[used])))
        if self.whitening is not None:
            share = float(np.count_nonzero(used)) / int(self.edges[-1])
            nats += share * float(np.diff(self.edges) @ np.linalg.slogdet(self.whitening)[1])
        return nats

    def candidates(
        self, keys: Sequence[str], others: Sequence[str], inverse: Array
    ) -> tuple[Array, list[Array], Array]:
        """Products of a model's components with many others, in noise of inverse powers (B,).

        (q, p) with the model, each other with itself, and (p,) with y
        """
        self._apart(keys)
        own_batches = [self.seen[key].batch for key in keys]
        for batch in dict.fromkeys(self.seen[other].batch for other in others):
            new = [k for k in own_batches if (k, batch) not in self.blocks]
            if new:
                self.meet(new, [batch])
        mean: dict[tuple[int, int], Array] = {}

        def part(left: str, right: str) -> Array:
            one, other = self.seen[left], self.seen[right]
            pair = one.batch, other.batch
            if pair not in mean:
                found = self.block(*pair)
                mean[pair] = np.tensordot(inverse, found, 1)
            return mean[pair][one.columns, other.columns]

        across = [np.concatenate([part(key, other) for other in others], axis=1) for key in keys]
        own = [part(other, other) for other in others]
        return np.concatenate(across), own, inverse @ self._crossed(others)

    def _crossed(self, keys: Sequence[str]) -> Array:
        """(B, q) products of components with y."""
        return np.concatenate([self.cross(key) for key in keys], axis=1)

    def left_by(self, keys: Sequence[str], at: At) -> Array:
        """(N, 3) the residual of a model in time, its colour taken out and its levels left in."""
        rows, begin = self.y.copy(), 0
        for key in keys:
            width = self.seen[key].component.width
            rows -= self.rows(key) @ at.mean[begin : begin + width]
            begin += width
        for (a, b), level in zip(self._bands(), at.log_noise, strict=True):
            rows[a:b] *= np.exp(-0.5 * level)
        white = idct(rows.reshape(-1, 3), axis=0, norm="ortho")[: len(self.point.loud.amplitude)]
        return np.asarray(white * self.point.loud.amplitude[:, None])


def by_frequency(cube: Array) -> Array:
    """(3 M, p) orthonormal cosines of (N, 3, p), frequency by frequency.

    M: rows with none behind the last, which are not counted: a count without large factors is fast
    """
    count = length(len(cube))
    return np.asarray(dct(cube, n=count, axis=0, norm="ortho")).reshape(3 * count, -1)


def length(rows: int) -> int:
    """Cosines for so many rows."""
    return int(next_fast_len(rows, real=True))


def as_columns_say(point: Point, components: Sequence[Component]) -> Point:
    """The same coefficients taken out of the readings as these components' columns have them.

    Columns follow the point (an attitude, a rate), and those of the point before took out another
    field: put back by the new ones, the difference would be a mismatch of our own making.  What no
    component stands for any more is in the readings again.
    """
    known = {one.key: one for one in components}
    values = {key: value for key, value in point.values.items() if key in known}
    out = {key: value for key, value in values.items() if key not in point.exact}
    if not out and point.terms_mag is None and point.terms_gyro is None:
        return point
    mag, gyro = added(len(point.filtered.track), known, out)
    again = run_filter(
        point.problem.track, point.filtered.model, mag, gyro, gains_from=point.filtered
    )
    return replace(point, filtered=again, values=values, terms_mag=mag, terms_gyro=gyro)


def unread(point: Point, spans_s: Sequence[tuple[float, float]]) -> Point:
    """The same point without the magnetometer's readings of some spans, from and to, s.

    The gyro carries the field across.
    """
    recorded = point.problem.recorded
    mag = recorded.mag_b_gauss.copy()
    for begin_s, end_s in spans_s:
        mag[(recorded.time_s >= begin_s) & (recorded.time_s <= end_s)] = np.nan
    problem = replace(
        point.problem,
        recorded=replace(recorded, mag_b_gauss=mag),
        unread_s=_together([*point.problem.unread_s, *spans_s]),
    ).lagging(point.problem.lag_s)
    model = point.filtered.model
    filtered = run_filter(problem.track, model, point.terms_mag, point.terms_gyro)
    return replace(point, problem=problem, filtered=filtered)


def _together(spans_s: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Spans in their order, those that overlap as one."""
    out: list[tuple[float, float]] = []
    for begin_s, end_s in sorted(spans_s):
        if out and begin_s <= out[-1][1]:
            out[-1] = (out[-1][0], max(end_s, out[-1][1]))
        else:
            out.append((begin_s, end_s))
    return tuple(out)


def regained(point: Point) -> Point:
    """The same point with the filter's noise estimated anew, and gains of that."""
    problem, mag, gyro = point.problem, point.terms_mag, point.terms_gyro
    model = point.filtered.model
    filtered = run_filter(problem.track, model, mag, gyro)
    again = _no_louder(noise_fit.estimated(filtered, problem.spec, mag, gyro, walk=False), model)
    return replace(point, filtered=run_filter(problem.track, again, mag, gyro))


def linearised(
    point: Point, context: Context, band_hz: tuple[float, float] | None = None
) -> Linearised:
    """The recording at a point, the calibration known and put back.

    context: of which all columns are made;  band_hz: in which the noise may have any power
    """
    smooth = filtered_for_regression(point.filtered, context.rate_b_rad_s)
    count = length(len(point.filtered.whitened))
    scaled = point.filtered.whitened / point.loud.amplitude[:, None]
    white = by_frequency(scaled[:, :, None])[:, 0]
    edges, alone = noise_model.octaves(count), None
    if band_hz is not None:
        low, high = (round(2 * count * one / point.problem.rate_hz) for one in band_hz)
        width = round(2 * count * BAND_HZ / point.problem.rate_hz)
        edges, alone = noise_model.with_band(edges, low, min(high, count), width)
    whitening = None
    if point.directed is not None:
        edges_hz = edges.astype(float) * point.problem.rate_hz / (2.0 * count)
        whitening = point.directed.whitening((edges_hz[1:] + edges_hz[:-1]) / 2.0)
    made = Linearised(point, context, smooth, edges, white, alone=alone, whitening=whitening)
    made.y = made.as_loud(white[:, None])[:, 0]
    prior = prior_of(point.problem.track)
    law = Fixed(prior.deviation**2)
    made.add([Component(CALIBRATION, "sensor", nuisance_columns(smooth), law)])
    made.put_back({CALIBRATION: coefficients(point.filtered.model) - prior.mean})
    return made


def coefficients(model: NullModel) -> Array:
    """(11,) soft iron about I, hard iron, gyro bias, in the order of `nuisance_columns`."""
    off = np.asarray(model.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    return np.concatenate([soft, model.hard_iron_gauss, model.gyro_bias_rad_s])


def model_of(values: Array, like: NullModel) -> NullModel:
    """The model with these 11 coefficients and the noise of another."""
    return replace(
        like,
        soft_iron=np.eye(3) + np.einsum("a,aij->ij", values[:5], TRACELESS),
        hard_iron_gauss=values[5:8],
        gyro_bias_rad_s=values[8:11],
    )


def first_point(problem: Problem, filtered: Filtered, exact: tuple[str, ...]) -> Point:
    """The null's calibration in the sensors' own noise, nothing taken out, all rows alike.

    Own noise is that of differences from reading to reading: the null's is the mismatch's as well.
    """
    own = noise_fit.first_guess(problem.track, problem.spec)
    quiet = _no_louder(replace(filtered.model, sigma_mag_gauss=own.sigma_mag_gauss), filtered.model)
    again = run_filter(problem.track, quiet)
    return Point(problem, again, {}, None, None, noise_model.even(len(again.whitened)), exact)


def moved(
    made: Linearised, keys: Sequence[str], at: At, share: float = 1.0, *, delayed: bool = True
) -> Point:
    """The point at a model's likeliest coefficients, in the noise of the point before.

    A delay is taken out of the track exactly, all else out of the readings, and these are averaged
    to the working rate by what is known there.  Gains that followed
    would whiten what is not yet taken out by another filter: no linear model tells that.
    share: of the way there;  delayed: whether the delay moves too
    """
    point, problem = made.point, made.point.problem
    values = {
        key: value + (1.0 - share) * (point.values.get(key, np.zeros(len(value))) - value)
        for key, value in by_key(made, keys, at).items()
        if key != CALIBRATION
    }
    if not delayed:
        values |= {key: point.values.get(key, np.zeros(1)) for key in point.exact}
    middle = prior_of(problem.track).mean
    here = coefficients(point.filtered.model) - middle
    found = here + share * (by_key(made, keys, at)[CALIBRATION] - here)
    model = model_of(found + middle, point.filtered.model)
    out = {key: value for key, value in values.items() if key not in point.exact}
    known = {key: made.seen[key].component for key in out}
    mag, gyro = added(len(made.context.track), known, out)
    riding = {key: value for key, value in out.items() if known[key].frame == "sensor"}
    lag_s = sum(float(values[key][0]) for key in point.exact if key in values)
    problem = problem.averaged_beside(
        added(len(made.context.track), known, riding)[0], model, lag_s
    )
    filtered = run_filter(problem.track, model, mag, gyro, gains_from=point.filtered)
    named = {key: value for key, value in out.items() if known[key].effect is not None}
    _, misread = added(len(made.context.track), known, named)
    rest = point.loud, point.exact, misread, point.directed
    return Point(problem, filtered, values, mag, gyro, *rest)


def relevelled(made: Linearised, keys: Sequence[str], at: At) -> Point:
    """The same point with the noise's level that a model leaves."""
    left, point = made.left_by(keys, at), made.point
    loud = noise_model.loudness(left, point.filtered.used, point.problem.rate_hz)
    return replace(point, loud=loud)


def along_one_direction(made: Linearised, keys: Sequence[str], at: At) -> Directed:
    """What is louder along one direction of the sensor, of what a model leaves."""
    point = made.point
    left = made.left_by(keys, at) / point.loud.amplitude[:, None]
    left = np.where(point.filtered.used[:, None], left, 0.0)
    if made.whitening is not None:
        count = int(made.edges[-1])
        rows = made.as_read(dct(left, n=count, axis=0, norm="ortho").reshape(-1, 1))
        left = np.asarray(idct(rows.reshape(-1, 3), axis=0, norm="ortho")[: len(left)])
    used = float(np.mean(point.filtered.used))
    return directed(left, made.context.field_b, point.problem.rate_hz, used)


def step_of(made: Linearised, keys: Sequence[str], at: At) -> tuple[Array, Array]:
    """How far the likeliest calibration and delay are from the point, and how well known."""
    prior = prior_of(made.point.problem.track).mean
    before = {
        CALIBRATION: coefficients(made.point.filtered.model) - prior,
        **{key: made.point.values.get(key, np.zeros(1)) for key in made.point.exact},
    }
    value = by_key(made, keys, at)
    deviation = by_key(made, keys, replace(at, mean=at.deviation))
    asked = [key for key in keys if key in before]
    off = [value[key] - before[key] for key in asked]
    return np.concatenate(off), np.concatenate([deviation[key] for key in asked])


def _no_louder(found: NullModel, before: NullModel) -> NullModel:
    """The noise that was found, but for what is louder than before: that would be the misfit's."""
    return replace(
        found,
        sigma_mag_gauss=min(found.sigma_mag_gauss, before.sigma_mag_gauss),
        sigma_gyro_rad_s=min(found.sigma_gyro_rad_s, before.sigma_gyro_rad_s),
    )


def by_key(made: Linearised, keys: Sequence[str], at: At) -> dict[str, Array]:
    """Likeliest coefficients of each component."""
    out, begin = {}, 0
    for key in keys:
        width = made.seen[key].component.width
        out[key] = at.mean[begin : begin + width]
        begin += width
    return out


def added(
    count: int, components: Mapping[str, Component], values: Mapping[str, Array]
) -> tuple[Array, Array]:
    """(count, 3) gauss and rad/s, what components add to the readings."""
    mag, gyro = np.zeros((count, 3)), np.zeros((count, 3))
    for key, value in values.items():
        columns = components[key].columns
        if columns.mag is not None:
            mag += columns.mag @ value
        if columns.gyro is not None:
            gyro += columns.gyro @ value
    return mag, gyro
