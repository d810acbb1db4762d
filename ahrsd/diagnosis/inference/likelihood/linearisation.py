"""The recording linearised at a model: rows by frequency, products of components band by band.

At the point (calibration c, coefficients w) the innovations are e = y - B w - C (c - c0) to first
order.  With y = e + B w + C (c - c0), every hypothesis is judged with zero-mean priors at one
point, whichever components were subtracted there.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct, next_fast_len

from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.null_fit import calibration_prior
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.inference.components.component import Component, FixedLaw
from ahrsd.diagnosis.inference.likelihood import noise_model
from ahrsd.diagnosis.inference.likelihood.directed_noise import DirectedNoise, fit_directed_noise
from ahrsd.diagnosis.inference.likelihood.evidence import ModelFit, Products
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
#: most columns, and most numbers in them, that pass the filter together
_BATCH_COLUMNS, _BATCH_NUMBERS = 96, 4_000_000
#: numbers in the rows of tentative components that are kept for the next time they are needed
_TENTATIVE_NUMBERS = 8_000_000
#: index of y among the batches
_Y = -1
#: rows that are multiplied at once
_PRODUCT_ROWS = 8192


@dataclass(frozen=True, slots=True, eq=False)
class _ContextSource:
    """What a context is computed from."""

    filtered: Filtered
    terms_gyro: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """The point of linearisation.

    values: coefficients by component that are subtracted from the readings
    terms_mag, terms_gyro: (N, 3) their contribution;  loud: noise level of each row
    exact: components that are taken out of the track itself: the delay
    misread: (N, 3) rad/s, the part of terms_gyro that effects of the library explain.  Columns are
             computed from the rates less this part only: squares of rates from which squares were
             subtracted would diverge
    directed: noise along one direction, None for none
    """

    problem: Problem
    filtered: Filtered
    values: Mapping[str, Array]
    terms_mag: Array | None
    terms_gyro: Array | None
    loud: noise_model.NoiseLevels
    exact: tuple[str, ...] = ()
    misread: Array | None = None
    directed: DirectedNoise | None = None

    @property
    def context(self) -> Context:
        """The recording from which columns are computed."""
        return build_context(self.problem.track, _ContextSource(self.filtered, self.misread))


@dataclass(frozen=True, slots=True, eq=False)
class FilteredComponent:
    """A component and the columns that hold its rows in one of the batches."""

    component: Component
    batch: int
    columns: slice


@dataclass(eq=False)
class Linearised:
    """A point, its context, and products of components, each computed once.

    batches: (3 M, p) by index, rows of components that passed the filter together: divided by the
             noise level, by frequency, whitened across axes; in single precision, one part in ten
             million of a column
    blocks: products of two batches, band by band
    tentative: keys of components that are only compared with others and can be added again
    apart: keys of components with a batch of their own: members of some model
    alone: indices of noise bands that are not tied to their neighbours, None for none
    whitening: (B, 3, 3) that equalise the noise of all axes in each band, None if it is equal
    """

    point: Point
    context: Context
    regressing: Filtered
    edges: NDArray[np.intp]
    y: Array
    seen: dict[str, FilteredComponent] = field(default_factory=dict)
    batches: dict[int, Array] = field(default_factory=dict)
    blocks: dict[tuple[int, int], Array] = field(default_factory=dict)
    tentative: set[str] = field(default_factory=set)
    alone: slice | None = None
    whitening: Array | None = None
    apart: set[str] = field(default_factory=set)

    def add(self, components: Sequence[Component]) -> None:
        """Pass components through the filter, unless they are known.

        Components that share their columns pass once.
        """
        self.tentative.difference_update(one.key for one in components)
        new = [one for one in components if one.key not in self.seen]
        known = {id(one.component.columns): one for one in self.seen.values()}
        for one in new:
            if id(one.columns) in known:
                self.seen[one.key] = replace(known[id(one.columns)], component=one)
        new = [one for one in new if one.key not in self.seen]
        first = {id(one.columns): one for one in reversed(new)}
        distinct = list(reversed(first.values()))
        parts = [Columns(one.columns.mag, one.columns.gyro) for one in distinct]
        amplitude = self.point.loud.amplitude[:, None, None]
        for batch in batch_columns(parts, self._batch_width()):
            cube = sensitivities(self.regressing, join_columns([parts[k] for k in batch]))
            rows = cosine_rows(np.divide(cube, amplitude, dtype=np.float32, casting="same_kind"))
            number, start = self._store_batch(self.whiten_axes(rows)), 0
            for k in batch:
                columns = slice(start, start + distinct[k].width)
                self.seen[distinct[k].key] = FilteredComponent(distinct[k], number, columns)
                start += distinct[k].width
        for one in new:
            twin = self.seen[first[id(one.columns)].key]
            self.seen[one.key] = replace(twin, component=one)

    def add_tentatively(self, components: Sequence[Component]) -> None:
        """Add components that may be forgotten once `keep` was called without them.

        They stay while there is room: the same ones are compared again and again.
        """
        new = [one for one in components if one.key not in self.seen]
        self.add(new)
        self.tentative.update(one.key for one in new)

    def keep(self, keys: Sequence[str]) -> None:
        """Keep these components; forget the other tentative ones if they take too much memory."""
        self.tentative -= {*keys, *self.apart}
        kept = {one.batch for key, one in self.seen.items() if key not in self.tentative}
        numbers = {self.seen[key].batch for key in self.tentative} - kept
        if sum(self.batches[k].size for k in numbers) <= _TENTATIVE_NUMBERS:
            return
        for key in self.tentative:
            del self.seen[key]
        self.tentative.clear()
        for number in numbers:
            del self.batches[number]
        self.blocks = {
            pair: found for pair, found in self.blocks.items() if numbers.isdisjoint(pair)
        }

    def release_candidates(self) -> None:
        """Forget what only a search needs: products of components that are in no model.

        They are computed again where one is tested after all.
        """
        members = {_Y, *(self.seen[key].batch for key in self.apart)}
        self.blocks = {
            pair: found for pair, found in self.blocks.items() if members.issuperset(pair)
        }

    def _store_batch(self, rows: Array) -> int:
        """The index of rows that are stored."""
        number = max(self.batches, default=-1) + 1
        self.batches[number] = rows
        return number

    def whiten_axes(self, rows: Array) -> Array:
        """Rows by frequency (3 M, p) in axes along which the noise is equal."""
        return rows if self.whitening is None else self._multiply_bands(rows, self.whitening)

    def unwhiten_axes(self, rows: Array) -> Array:
        """The inverse of `whiten_axes`."""
        if self.whitening is None:
            return rows
        return self._multiply_bands(rows, np.asarray(np.linalg.inv(self.whitening)))

    def _multiply_bands(self, rows: Array, matrices: Array) -> Array:
        """Rows by frequency (3 M, p), the three of a frequency multiplied by its band's matrix."""
        out = rows.reshape(-1, 3, rows.shape[1]).copy()
        for matrix, (a, b) in zip(
            matrices.astype(rows.dtype), itertools.pairwise(self.edges), strict=True
        ):
            out[a:b] = np.einsum("ij,njp->nip", matrix, out[a:b])
        return out.reshape(rows.shape)

    def _batch_width(self) -> int:
        """Number of columns that pass the filter together: fewer in a long recording (memory)."""
        return int(
            np.clip(_BATCH_NUMBERS // (3 * len(self.point.loud.amplitude)), 1, _BATCH_COLUMNS)
        )

    def copy(self) -> Linearised:
        """A copy to which components can be added without changing this one."""
        return replace(
            self,
            seen=dict(self.seen),
            batches=dict(self.batches),
            blocks=dict(self.blocks),
            tentative=set(self.tentative),
            apart=set(self.apart),
        )

    def rows(self, key: str) -> Array:
        """(3 M, q) of a component, by frequency, lowest first."""
        one = self.seen[key]
        return self.batches[one.batch][:, one.columns].astype(float)

    def make_columns_lazy(self, components: Sequence[Component]) -> None:
        """Drop columns of effects that have passed the filter; each access computes them again."""
        for one in components:
            known = self.seen[one.key]
            if known.component is one:
                self.seen[one.key] = replace(known, component=one.with_lazy_columns(self.context))

    def _give_own_batches(self, keys: Sequence[str]) -> None:
        """Give each component a batch of its own.

        It is multiplied with all others; its neighbours in the old batch need not be.
        """
        for key in sorted(set(keys) - self.apart):
            one = self.seen[key]
            together = self.batches[one.batch]
            if one.component.width < together.shape[1]:
                number = self._store_batch(together[:, one.columns].copy())
                own = slice(0, one.component.width)
                self.seen[key] = replace(one, batch=number, columns=own)
        self.apart.update(keys)

    def add_back(self, values: Mapping[str, Array]) -> None:
        """Add to y what was subtracted from the readings for components that are known here."""
        for key, value in values.items():
            self.y = self.y + self.rows(key) @ value
        self.blocks = {pair: found for pair, found in self.blocks.items() if _Y not in pair}

    def block(self, left: int, right: int) -> Array:
        """(B, p, p') products of two batches band by band; (B, p, 1) with y if `right` is _Y."""
        if (left, right) not in self.blocks:
            X = self.batches[left]
            Y = self.y[:, None] if right == _Y else self.batches[right]
            bands = self._bands()
            found = np.stack([X[a:b].astype(float).T @ Y[a:b].astype(float) for a, b in bands])
            self.blocks[left, right] = found
            if right != _Y:
                self.blocks[right, left] = np.swapaxes(found, 1, 2)
        return self.blocks[left, right]

    def multiply_batches(self, left: Sequence[int], right: Sequence[int]) -> None:
        """Compute products of two groups of batches, each converted to double precision once."""
        same = left is right
        left_columns, right_columns = (self._batch_slices(one) for one in (left, right))
        out = np.zeros((len(self.edges) - 1, left_columns[-1].stop, right_columns[-1].stop))
        for k, (begin, end) in enumerate(self._bands()):
            for a in range(begin, end, _PRODUCT_ROWS):
                rows = slice(a, min(end, a + _PRODUCT_ROWS))
                X = self._double_precision_rows(left, rows)
                out[k] += X.T @ (X if same else self._double_precision_rows(right, rows))
        for one, own in zip(left, left_columns, strict=True):
            for other, part in zip(right, right_columns, strict=True):
                found = out[:, own, part]
                self.blocks[one, other] = found
                self.blocks[other, one] = np.swapaxes(found, 1, 2)

    def _double_precision_rows(self, numbers: Sequence[int], rows: slice) -> Array:
        return np.concatenate([self.batches[k][rows] for k in numbers], axis=1, dtype=float)

    def _batch_slices(self, numbers: Sequence[int]) -> list[slice]:
        ends = np.cumsum([0, *(self.batches[k].shape[1] for k in numbers)]).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    def component_products(self, left: str, right: str) -> Array:
        """(B, q, q') products of two components, band by band."""
        one, other = self.seen[left], self.seen[right]
        return self.block(one.batch, other.batch)[:, one.columns, other.columns]

    def products_with_y(self, key: str) -> Array:
        """(B, q) products of a component with y."""
        one = self.seen[key]
        return self.block(one.batch, _Y)[:, one.columns, 0]

    def _bands(self) -> list[tuple[int, int]]:
        return [(3 * int(a), 3 * int(b)) for a, b in itertools.pairwise(self.edges)]

    def products(self, keys: Sequence[str], step: float) -> Products:
        """All products of these components and y.

        step: prior deviation of the noise's spectrum from octave to octave
        """
        self._give_own_batches(keys)
        own_batches = [self.seen[key].batch for key in keys]
        new = [k for k in own_batches if (k, k) not in self.blocks]
        known = [k for k in own_batches if (k, k) in self.blocks]
        if new:
            self.multiply_batches(new, new)
        if new and known:
            self.multiply_batches(new, known)
        ends = np.cumsum([0, *(self.seen[key].component.width for key in keys)])
        parts = [(key, slice(a, b)) for key, (a, b) in zip(keys, itertools.pairwise(ends))]
        G = np.empty((len(self.edges) - 1, ends[-1], ends[-1]))
        for (one, one_columns), (other, other_columns) in itertools.combinations_with_replacement(
            parts, 2
        ):
            found = self.component_products(one, other)
            G[:, one_columns, other_columns] = found
            G[:, other_columns, one_columns] = np.swapaxes(found, 1, 2)
        s = self._all_products_with_y(keys)
        square = np.array([float(self.y[a:b] @ self.y[a:b]) for a, b in self._bands()])
        used = float(np.count_nonzero(self.point.filtered.used)) / int(self.edges[-1])
        rows = np.array([(b - a) * used for a, b in self._bands()])
        return Products(G, s, square, rows, step, self.alone)

    @property
    def log_whitening(self) -> float:
        """Log density of the readings less that of the rows, nats: makes points comparable."""
        done, used, loud = self.point.filtered, self.point.filtered.used, self.point.loud
        own = done.log_likelihood + 0.5 * np.sum(done.whitened**2, axis=1) + 1.5 * np.log(2 * np.pi)
        nats = float(loud.tails + np.sum(own[used]) - 3.0 * np.sum(np.log(loud.amplitude[used])))
        if self.whitening is not None:
            share = float(np.count_nonzero(used)) / int(self.edges[-1])
            nats += share * float(np.diff(self.edges) @ np.linalg.slogdet(self.whitening)[1])
        return nats

    def candidate_products(
        self, keys: Sequence[str], others: Sequence[str], inverse: Array
    ) -> tuple[Array, list[Array], Array]:
        """Products of a model's components with candidates, bands weighted by inverse powers (B,).

        (q, p) with the model, of each candidate with itself, and (p,) with y
        """
        self._give_own_batches(keys)
        own_batches = [self.seen[key].batch for key in keys]
        for batch in dict.fromkeys(self.seen[other].batch for other in others):
            new = [k for k in own_batches if (k, batch) not in self.blocks]
            if new:
                self.multiply_batches(new, [batch])
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
        return np.concatenate(across), own, inverse @ self._all_products_with_y(others)

    def _all_products_with_y(self, keys: Sequence[str]) -> Array:
        """(B, q) products of components with y."""
        return np.concatenate([self.products_with_y(key) for key in keys], axis=1)

    def residual(self, keys: Sequence[str], at: ModelFit) -> Array:
        """(N, 3) the residual of a model in time, white, times the noise level of each row."""
        rows, begin = self.y.copy(), 0
        for key in keys:
            width = self.seen[key].component.width
            rows -= self.rows(key) @ at.mean[begin : begin + width]
            begin += width
        for (a, b), level in zip(self._bands(), at.log_noise, strict=True):
            rows[a:b] *= np.exp(-0.5 * level)
        white = idct(rows.reshape(-1, 3), axis=0, norm="ortho")[: len(self.point.loud.amplitude)]
        return np.asarray(white * self.point.loud.amplitude[:, None])


def cosine_rows(cube: Array) -> Array:
    """(3 M, p) orthonormal cosine transform of (N, 3, p), frequency by frequency.

    M: number of rows, zeros appended: a length without large prime factors is fast.  The zeros do
    not count as readings.
    """
    count = transform_length(len(cube))
    return np.asarray(dct(cube, n=count, axis=0, norm="ortho")).reshape(3 * count, -1)


def transform_length(rows: int) -> int:
    """Length of the cosine transform of so many rows."""
    return int(next_fast_len(rows, real=True))


def refilter_with_columns(point: Point, components: Sequence[Component]) -> Point:
    """The same coefficients, with the contribution to the readings computed from these columns.

    Columns depend on the point (an attitude, a rate); those of the point before subtracted another
    field.  If the new columns added it back, the difference would be an artificial mismatch.  What
    no component explains any more remains in the readings.
    """
    known = {one.key: one for one in components}
    values = {key: value for key, value in point.values.items() if key in known}
    subtracted = {key: value for key, value in values.items() if key not in point.exact}
    if not subtracted and point.terms_mag is None and point.terms_gyro is None:
        return point
    mag, gyro = total_contribution(len(point.filtered.track), known, subtracted)
    filtered = run_filter(
        point.problem.track, point.filtered.model, mag, gyro, gains_from=point.filtered
    )
    return replace(point, filtered=filtered, values=values, terms_mag=mag, terms_gyro=gyro)


def omit_readings(point: Point, spans_s: Sequence[tuple[float, float]]) -> Point:
    """The same point without the magnetometer's readings in some intervals, from and to, s.

    The gyro carries the field across.
    """
    recorded = point.problem.recorded
    mag = recorded.mag_b_gauss.copy()
    for begin_s, end_s in spans_s:
        mag[(recorded.time_s >= begin_s) & (recorded.time_s <= end_s)] = np.nan
    problem = replace(
        point.problem,
        recorded=replace(recorded, mag_b_gauss=mag),
        unread_s=_merge_intervals([*point.problem.unread_s, *spans_s]),
    ).with_lag(point.problem.lag_s)
    model = point.filtered.model
    filtered = run_filter(problem.track, model, point.terms_mag, point.terms_gyro)
    return replace(point, problem=problem, filtered=filtered)


def _merge_intervals(spans_s: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """Intervals in order of time, overlapping ones merged."""
    out: list[tuple[float, float]] = []
    for begin_s, end_s in sorted(spans_s):
        if out and begin_s <= out[-1][1]:
            out[-1] = (out[-1][0], max(end_s, out[-1][1]))
        else:
            out.append((begin_s, end_s))
    return tuple(out)


def refit_filter_noise(point: Point) -> Point:
    """The same point with the filter's noise estimated again, and gains from that noise."""
    problem, mag, gyro = point.problem, point.terms_mag, point.terms_gyro
    model = point.filtered.model
    filtered = run_filter(problem.track, model, mag, gyro)
    refitted = _cap_noise(
        noise_fit.estimate_noise(filtered, problem.spec, mag, gyro, walk=False), model
    )
    return replace(point, filtered=run_filter(problem.track, refitted, mag, gyro))


def linearise(
    point: Point, context: Context, band_hz: tuple[float, float] | None = None
) -> Linearised:
    """Linearise the recording at a point; the calibration's contribution is added back.

    context: from which all columns are computed
    band_hz: band in which the noise may have any power
    """
    regressing_filter = filtered_for_regression(point.filtered, context.rate_b_rad_s)
    count = transform_length(len(point.filtered.whitened))
    scaled = point.filtered.whitened / point.loud.amplitude[:, None]
    white = cosine_rows(scaled[:, :, None])[:, 0]
    edges, alone = noise_model.octave_edges(count), None
    if band_hz is not None:
        low, high = (round(2 * count * one / point.problem.rate_hz) for one in band_hz)
        width = round(2 * count * BAND_HZ / point.problem.rate_hz)
        edges, alone = noise_model.insert_narrow_bands(edges, low, min(high, count), width)
    whitening = None
    if point.directed is not None:
        edges_hz = edges.astype(float) * point.problem.rate_hz / (2.0 * count)
        whitening = point.directed.whitening((edges_hz[1:] + edges_hz[:-1]) / 2.0)
    linearised = Linearised(
        point, context, regressing_filter, edges, white, alone=alone, whitening=whitening
    )
    linearised.y = linearised.whiten_axes(white[:, None])[:, 0]
    prior = calibration_prior(point.problem.track)
    law = FixedLaw(prior.deviation**2)
    linearised.add([Component(CALIBRATION, "sensor", nuisance_columns(regressing_filter), law)])
    linearised.add_back({CALIBRATION: calibration_coefficients(point.filtered.model) - prior.mean})
    return linearised


def calibration_coefficients(model: NullModel) -> Array:
    """(11,) soft iron about I, hard iron, gyro bias, in the order of `nuisance_columns`."""
    off = np.asarray(model.soft_iron) - np.eye(3)
    soft = [off[0, 0], off[1, 1], off[0, 1], off[0, 2], off[1, 2]]
    return np.concatenate([soft, model.hard_iron_gauss, model.gyro_bias_rad_s])


def model_from_coefficients(values: Array, like: NullModel) -> NullModel:
    """The model with these 11 coefficients and the noise of another."""
    return replace(
        like,
        soft_iron=np.eye(3) + np.einsum("a,aij->ij", values[:5], TRACELESS),
        hard_iron_gauss=values[5:8],
        gyro_bias_rad_s=values[8:11],
    )


def initial_point(problem: Problem, filtered: Filtered, exact: tuple[str, ...]) -> Point:
    """The null model's calibration in the magnetometer's own noise, nothing subtracted.

    Own noise is that of differences between readings; the null model's contains the mismatch too.
    All rows have the same noise level.
    """
    differences = noise_fit.first_guess(problem.track, problem.spec)
    model = _cap_noise(
        replace(filtered.model, sigma_mag_gauss=differences.sigma_mag_gauss), filtered.model
    )
    own_noise = run_filter(problem.track, model)
    return Point(
        problem,
        own_noise,
        {},
        None,
        None,
        noise_model.uniform_levels(len(own_noise.whitened)),
        exact,
    )


def step_to_maximum(
    made: Linearised, keys: Sequence[str], at: ModelFit, share: float = 1.0, *, delayed: bool = True
) -> Point:
    """The point at the most probable coefficients of a model, in the noise of the point before.

    A delay is taken out of the track exactly, all else is subtracted from the readings.  Both are
    averaged to the working rate with the new calibration.  The gains stay as they were: gains that
    followed would whiten what is not subtracted yet by another filter, which no linear model
    describes.

    share: of the whole step;  delayed: whether the delay moves too
    """
    point, problem = made.point, made.point.problem
    values = {
        key: value + (1.0 - share) * (point.values.get(key, np.zeros(len(value))) - value)
        for key, value in coefficients_by_key(made, keys, at).items()
        if key != CALIBRATION
    }
    if not delayed:
        values |= {key: point.values.get(key, np.zeros(1)) for key in point.exact}
    prior_mean = calibration_prior(problem.track).mean
    here = calibration_coefficients(point.filtered.model) - prior_mean
    calibration = here + share * (coefficients_by_key(made, keys, at)[CALIBRATION] - here)
    model = model_from_coefficients(calibration + prior_mean, point.filtered.model)
    subtracted = {key: value for key, value in values.items() if key not in point.exact}
    known = {key: made.seen[key].component for key in subtracted}
    mag, gyro = total_contribution(len(made.context.track), known, subtracted)
    on_sensor = {key: value for key, value in subtracted.items() if known[key].frame == "sensor"}
    lag_s = sum(float(values[key][0]) for key in point.exact if key in values)
    problem = problem.averaged_with(
        total_contribution(len(made.context.track), known, on_sensor)[0], model, lag_s
    )
    filtered = run_filter(problem.track, model, mag, gyro, gains_from=point.filtered)
    effects = {key: value for key, value in subtracted.items() if known[key].effect is not None}
    _, misread = total_contribution(len(made.context.track), known, effects)
    kept = point.loud, point.exact, misread, point.directed
    return Point(problem, filtered, values, mag, gyro, *kept)


def refit_noise_level(made: Linearised, keys: Sequence[str], at: ModelFit) -> Point:
    """The same point with the noise levels of a model's residual."""
    residual, point = made.residual(keys, at), made.point
    levels = noise_model.fit_noise_levels(residual, point.filtered.used, point.problem.rate_hz)
    return replace(point, loud=levels)


def directed_noise_of_residual(
    made: Linearised, keys: Sequence[str], at: ModelFit
) -> DirectedNoise:
    """Noise along one direction of the sensor in the residual of a model."""
    point = made.point
    residual = made.residual(keys, at) / point.loud.amplitude[:, None]
    residual = np.where(point.filtered.used[:, None], residual, 0.0)
    if made.whitening is not None:
        count = int(made.edges[-1])
        rows = made.unwhiten_axes(dct(residual, n=count, axis=0, norm="ortho").reshape(-1, 1))
        residual = np.asarray(idct(rows.reshape(-1, 3), axis=0, norm="ortho")[: len(residual)])
    used_share = float(np.mean(point.filtered.used))
    return fit_directed_noise(residual, made.context.field_b, point.problem.rate_hz, used_share)


def remaining_step(made: Linearised, keys: Sequence[str], at: ModelFit) -> tuple[Array, Array]:
    """Step from the point to the most probable calibration and delay, and its deviations."""
    prior = calibration_prior(made.point.problem.track).mean
    before = {
        CALIBRATION: calibration_coefficients(made.point.filtered.model) - prior,
        **{key: made.point.values.get(key, np.zeros(1)) for key in made.point.exact},
    }
    value = coefficients_by_key(made, keys, at)
    deviation = coefficients_by_key(made, keys, replace(at, mean=at.deviation))
    known_keys = [key for key in keys if key in before]
    steps = [value[key] - before[key] for key in known_keys]
    return np.concatenate(steps), np.concatenate([deviation[key] for key in known_keys])


def _cap_noise(fitted: NullModel, before: NullModel) -> NullModel:
    """The noise that was found, but no larger than before: more would be the mismatch's."""
    return replace(
        fitted,
        sigma_mag_gauss=min(fitted.sigma_mag_gauss, before.sigma_mag_gauss),
        sigma_gyro_rad_s=min(fitted.sigma_gyro_rad_s, before.sigma_gyro_rad_s),
    )


def coefficients_by_key(made: Linearised, keys: Sequence[str], at: ModelFit) -> dict[str, Array]:
    """Posterior mean of the coefficients, by component."""
    out, begin = {}, 0
    for key in keys:
        width = made.seen[key].component.width
        out[key] = at.mean[begin : begin + width]
        begin += width
    return out


def total_contribution(
    count: int, components: Mapping[str, Component], values: Mapping[str, Array]
) -> tuple[Array, Array]:
    """(count, 3) gauss and rad/s, what components contribute to the readings."""
    mag, gyro = np.zeros((count, 3)), np.zeros((count, 3))
    for key, value in values.items():
        columns = components[key].columns
        if columns.mag is not None:
            mag += columns.mag @ value
        if columns.gyro is not None:
            gyro += columns.gyro @ value
    return mag, gyro
