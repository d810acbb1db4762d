"""The recording linearised at a model: rows by frequency, products of components band by band.

At the point (calibration c, coefficients w) the innovations are e = y - B w - C (c - c0) to first
order; y = e + B w + C (c - c0), so every hypothesis is judged with zero-mean priors at one point,
whichever components hold at it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

from ahrsd.diagnosis import noise_fit
from ahrsd.diagnosis.context import build_context
from ahrsd.diagnosis.innovation import (
    TRACELESS,
    Filtered,
    nuisance_columns,
    regressing,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.one_model import noise_model
from ahrsd.diagnosis.one_model.component import Component, Fixed
from ahrsd.diagnosis.one_model.evidence import At, Products
from ahrsd.diagnosis.prior import prior_of
from ahrsd.diagnosis.problem import Problem
from ahrsd.diagnosis.side_by_side import batches, joined
from ahrsd.diagnosis.values import Columns, Context, NullModel
from ahrsd.samples import Array

CALIBRATION = "calibration"
_BATCH = 96


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Where everything is linearised.

    values: coefficients by component that are taken out of the readings
    terms_mag, terms_gyro: (N, 3) what they add;  amplitude (N,): of the noise
    """

    problem: Problem
    filtered: Filtered
    values: Mapping[str, Array]
    terms_mag: Array | None
    terms_gyro: Array | None
    amplitude: Array


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A component's rows (3 N, q) as the noise sees them."""

    component: Component
    rows: Array


@dataclass(eq=False)
class Linearised:
    """A point, the context there, and products of components, each made once.

    exact: components that are taken out of the track itself: the delay
    """

    point: Point
    context: Context
    regressing: Filtered
    edges: NDArray[np.intp]
    y: Array
    seen: dict[str, Seen] = field(default_factory=dict)
    pairs: dict[tuple[str, str], Array] = field(default_factory=dict)
    exact: tuple[str, ...] = ()

    def add(self, components: Sequence[Component]) -> None:
        """Pass components through the filter; what is known already is left out."""
        new = [one for one in components if one.key not in self.seen]
        parts = [one.columns for one in new]
        for batch in batches(parts, _BATCH):
            flat = self._rows(sensitivities(self.regressing, joined([parts[k] for k in batch])))
            at = 0
            for k in batch:
                self.seen[new[k].key] = Seen(new[k], flat[:, at : at + new[k].width])
                at += new[k].width

    def _rows(self, cube: Array) -> Array:
        """(3 N, p) of (N, 3, p): by frequency, lowest first."""
        return by_frequency(cube / self.point.amplitude[:, None, None])

    def put_back(self, values: Mapping[str, Array]) -> None:
        """Add what is taken out of the readings to y, for components that are known here."""
        for key, value in values.items():
            self.y = self.y + self.seen[key].rows @ value

    def pair(self, left: str, right: str) -> Array:
        """(B, q, q') products of two components, band by band."""
        if (left, right) not in self.pairs:
            X, Y = self.seen[left].rows, self.seen[right].rows
            found = np.stack([X[a:b].T @ Y[a:b] for a, b in self._bands()])
            self.pairs[left, right] = found
            self.pairs[right, left] = np.swapaxes(found, 1, 2)
        return self.pairs[left, right]

    def cross(self, key: str) -> Array:
        """(B, q) products of a component with y."""
        if (key, "") not in self.pairs:
            X = self.seen[key].rows
            self.pairs[key, ""] = np.stack([X[a:b].T @ self.y[a:b] for a, b in self._bands()])
        return self.pairs[key, ""]

    def _bands(self) -> list[tuple[int, int]]:
        return [(3 * int(a), 3 * int(b)) for a, b in zip(self.edges, self.edges[1:], strict=False)]

    def products(self, keys: Sequence[str], step: float) -> Products:
        """All that the data say of these components; step: prior of the noise's spectrum."""
        G = np.concatenate(
            [np.concatenate([self.pair(a, b) for b in keys], axis=2) for a in keys], axis=1
        )
        s = np.concatenate([self.cross(key) for key in keys], axis=1)
        square = np.array([float(self.y[a:b] @ self.y[a:b]) for a, b in self._bands()])
        used = float(np.mean(self.point.filtered.used))
        rows = np.array([(b - a) * used for a, b in self._bands()])
        return Products(G, s, square, rows, step)

    @property
    def log_whitening(self) -> float:
        """By how much the rows are denser than readings, nats: makes points comparable."""
        done, used = self.point.filtered, self.point.filtered.used
        own = done.log_likelihood + 0.5 * np.sum(done.whitened**2, axis=1) + 1.5 * np.log(2 * np.pi)
        return float(np.sum(own[used]) - 3.0 * np.sum(np.log(self.point.amplitude[used])))

    def gram_of(self, keys: Sequence[str]) -> None:
        """Fill in the pairs of many components at once, which is quicker than one by one."""
        X = np.concatenate([self.seen[key].rows for key in keys], axis=1)
        whole = np.stack([X[a:b].T @ X[a:b] for a, b in self._bands()])
        edges = np.cumsum([0, *(self.seen[key].component.width for key in keys)])
        for i, left in enumerate(keys):
            for j, right in enumerate(keys):
                part = whole[:, edges[i] : edges[i + 1], edges[j] : edges[j + 1]]
                self.pairs[left, right] = part

    def gram_between(self, keys: Sequence[str], others: Sequence[str]) -> None:
        """Fill in the pairs of some components with many others."""
        new = [key for key in others if any((one, key) not in self.pairs for one in keys)]
        if not new:
            return
        X = np.concatenate([self.seen[key].rows for key in keys], axis=1)
        left = np.cumsum([0, *(self.seen[key].component.width for key in keys)])
        for begin in range(0, len(new), _BATCH):
            some = new[begin : begin + _BATCH]
            Y = np.concatenate([self.seen[key].rows for key in some], axis=1)
            right = np.cumsum([0, *(self.seen[key].component.width for key in some)])
            whole = np.stack([X[a:b].T @ Y[a:b] for a, b in self._bands()])
            for i, one in enumerate(keys):
                for j, key in enumerate(some):
                    part = whole[:, left[i] : left[i + 1], right[j] : right[j + 1]]
                    self.pairs[one, key] = part
                    self.pairs[key, one] = np.swapaxes(part, 1, 2)

    def left_by(self, keys: Sequence[str], at: At) -> Array:
        """(N, 3) the residual of a model in time, its colour taken out and its levels left in."""
        rows, begin = self.y.copy(), 0
        for key in keys:
            width = self.seen[key].component.width
            rows -= self.seen[key].rows @ at.mean[begin : begin + width]
            begin += width
        for (a, b), level in zip(self._bands(), at.log_noise, strict=True):
            rows[a:b] *= np.exp(-0.5 * level)
        white = idct(rows.reshape(-1, 3), axis=0, norm="ortho")
        return np.asarray(white * self.point.amplitude[:, None])


def by_frequency(cube: Array) -> Array:
    """(3 N, p) orthonormal cosines over all rows of (N, 3, p), frequency by frequency."""
    return np.asarray(dct(cube, axis=0, norm="ortho")).reshape(3 * len(cube), -1)


def linearised(point: Point) -> Linearised:
    """The recording at a point, the calibration known and put back."""
    context = build_context(point.problem.track, point)
    smooth = regressing(point.filtered, context.rate_b_rad_s)
    count = len(point.filtered.whitened)
    white = by_frequency(point.filtered.whitened[:, :, None] / point.amplitude[:, None, None])[:, 0]
    made = Linearised(point, context, smooth, noise_model.octaves(count), white)
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


def first_point(problem: Problem, filtered: Filtered) -> Point:
    """The null's calibration in the sensors' own noise, nothing taken out, all rows alike.

    Own noise is that of differences from reading to reading: the null's is the mismatch's as well.
    """
    own = noise_fit.first_guess(problem.track, problem.spec)
    quiet = _no_louder(replace(filtered.model, sigma_mag_gauss=own.sigma_mag_gauss), filtered.model)
    again = run_filter(problem.track, quiet)
    return Point(problem, again, {}, None, None, np.ones(len(again.whitened)))


def moved(made: Linearised, keys: Sequence[str], at: At, share: float = 1.0) -> Point:
    """The point at a model's likeliest coefficients, in noise estimated anew.

    A delay is taken out of the track exactly, all else out of the readings.
    share: of the way there
    """
    problem, before = made.point.problem, made.point.values
    values = {
        key: value + (1.0 - share) * (before.get(key, np.zeros(len(value))) - value)
        for key, value in by_key(made, keys, at).items()
    }
    here = coefficients(made.point.filtered.model) - prior_of(problem.track).mean
    found = by_key(made, [keys[0]], at)[CALIBRATION]
    values[CALIBRATION] = here + share * (found - here)
    model = model_of(values[CALIBRATION] + prior_of(problem.track).mean, made.point.filtered.model)
    out = {key: value for key, value in values.items() if key not in (CALIBRATION, *made.exact)}
    mag, gyro = added(made, out)
    lag_s = sum(float(values[key][0]) for key in made.exact if key in values)
    if lag_s != problem.lag_s:
        problem = problem.lagging(lag_s)
    filtered = run_filter(problem.track, model, mag, gyro)
    again = _no_louder(noise_fit.estimated(filtered, problem.spec, mag, gyro, walk=False), model)
    filtered = run_filter(problem.track, again, mag, gyro)
    left = noise_model.amplitude(made.left_by(keys, at), made.point.filtered.used, problem.rate_hz)
    del values[CALIBRATION]
    return Point(problem, filtered, values, mag, gyro, left)


def step_of(made: Linearised, keys: Sequence[str], at: At) -> tuple[Array, Array]:
    """How far the likeliest calibration and delay are from the point, and how well known."""
    prior = prior_of(made.point.problem.track).mean
    before = {
        CALIBRATION: coefficients(made.point.filtered.model) - prior,
        **{key: made.point.values.get(key, np.zeros(1)) for key in made.exact},
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


def added(made: Linearised, values: Mapping[str, Array]) -> tuple[Array, Array]:
    """(N, 3) gauss and rad/s, what components add to the readings."""
    count = len(made.context.track)
    mag, gyro = np.zeros((count, 3)), np.zeros((count, 3))
    for key, value in values.items():
        columns: Columns = made.seen[key].component.columns
        if columns.mag is not None:
            mag += columns.mag @ value
        if columns.gyro is not None:
            gyro += columns.gyro @ value
    return mag, gyro
