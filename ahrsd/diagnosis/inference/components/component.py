"""What a component of the model is: columns on the readings, and the law of their coefficients.

    readings = calibration + sum_j B_j w_j + noise,    w_j ~ N(0, diag(Phi_j(psi_j)))

The columns are made of the context (the recording as the present model sees it); the law gives the
variances and their slopes in its hyperparameters psi, all of which are logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.diagnosis.where_and_when.locate import Frame, unit_columns
from ahrsd.samples import Array


class Law(Protocol):
    """Variances (q,) of independent coefficients as a function of psi (k,), logarithms.

    start, low, high (k,): where a search begins and between which it stays
    """

    @property
    def start(self) -> Array:
        """Where a search begins."""

    @property
    def low(self) -> Array:
        """Lowest psi."""

    @property
    def high(self) -> Array:
        """Highest psi."""

    @property
    def stiffness(self) -> Array:
        """(k,) curvature of minus the log density of psi."""

    def log_variance(self, psi: Array) -> Array:
        """(q,)."""

    def slope(self, psi: Array) -> Array:
        """(q, k) of the log variances in psi."""

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density of psi and its gradient (k,)."""


#: of a setting, s: from when and until when something is there
MOMENTS = ("onset_s", "end_s")


@dataclass(frozen=True, slots=True, eq=False)
class LazyColumns:
    """Columns that are made whenever they are asked for.

    Those of a thousand candidates would be as much as their rows, and few of them are asked for.
    """

    make: Callable[[], Columns]
    width: int
    on_mag: bool
    on_gyro: bool

    @property
    def mag(self) -> Array | None:
        """(N, 3, p) on the magnetometer."""
        return self.make().mag if self.on_mag else None

    @property
    def gyro(self) -> Array | None:
        """(N, 3, p) on the gyro."""
        return self.make().gyro if self.on_gyro else None


def columns_in_frame(
    context: Context, frame: Frame, time_functions: Callable[[], Array], count: int
) -> LazyColumns:
    """Courses in time, (N, count), each along each axis of a frame: three columns a course."""

    def make() -> Columns:
        axes = unit_columns(context, frame)
        flat = (time_functions()[:, None, :, None] * axes[:, :, None, :]).reshape(len(axes), 3, -1)
        return Columns(gyro=flat) if frame == "gyro" else Columns(mag=flat)

    return LazyColumns(make, 3 * count, on_mag=frame != "gyro", on_gyro=frame == "gyro")


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """One part of the model.

    key:     its name in a hypothesis, unique
    frame:   sensor, world, gyro or link
    columns: per unit of the coefficients
    law:     of the coefficients
    prior:   log odds of being there
    row, setting: of the library, where it is one
    beside: key of another that it holds and that is taken out of its columns: it is asked beside
            that alone
    """

    key: str
    frame: str
    columns: Columns | LazyColumns
    law: Law
    prior: float = 0.0
    row: Effect | None = None
    setting: dict[str, Any] = field(default_factory=dict)
    beside: str = ""

    @property
    def effect(self) -> str | None:
        """Its identifier in the library, where it is there."""
        return None if self.row is None else self.row.identifier

    @property
    def jumps(self) -> bool:
        """Whether it is one vector from a moment on."""
        return self.row is not None and self.row.jumps

    @property
    def moments_s(self) -> tuple[float, ...]:
        """When it begins, and ends where its setting says so, s."""
        times_s = (self.setting.get(name) for name in MOMENTS)
        return tuple(float(one) for one in times_s if one is not None)

    @property
    def width(self) -> int:
        """Number of coefficients."""
        return self.columns.width

    def shifted_columns(self, share: float) -> Columns:
        """Its columns by a share of the recording later, their end at the beginning."""
        mag, gyro = (
            None if part is None else np.roll(part, round(share * len(part)), axis=0)
            for part in (self.columns.mag, self.columns.gyro)
        )
        return Columns(mag, gyro)

    def moved(self, share: float) -> Component:
        """A copy at another time: of the same law, with nothing to do with the readings."""
        key = f"{self.key}, moved by {share}"
        return replace(self, key=key, columns=self.shifted_columns(share))

    def with_lazy_columns(self, context: Context) -> Component:
        """The same, which makes its columns of the context whenever they are asked for."""
        if self.row is None or self.beside:
            raise ValueError(f"{self.key} is no effect of the library in a setting")
        columns = self.columns
        make = partial(self.row.columns, context, self.setting)
        lazy = LazyColumns(make, columns.width, columns.on_mag, columns.on_gyro)
        return replace(self, columns=lazy)


@dataclass(frozen=True, slots=True, eq=False)
class FixedLaw:
    """Variances that are known.  variance (q,)."""

    variance: Array
    start: Array = field(default_factory=lambda: np.zeros(0))
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    stiffness: Array = field(default_factory=lambda: np.zeros(0))

    def log_variance(self, psi: Array) -> Array:
        """(q,) logarithms."""
        return np.asarray(np.log(self.variance))

    def slope(self, psi: Array) -> Array:
        """(q, k) of the log variances."""
        return np.zeros((len(self.variance), 0))

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density and gradient (k,)."""
        return 0.0, np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class ScaledLaw:
    """One size for all: variance = scale^2 e^(2 psi).

    scale (q,);  low, high: of psi;  mean, spread: of its normal law; spread 0: even between them
    """

    scale: Array
    low: Array
    high: Array
    mean: float = 0.0
    spread: float = 0.0

    @property
    def start(self) -> Array:
        """Where a search begins."""
        return np.asarray(np.clip(np.array([self.mean]), self.low, self.high))

    @property
    def stiffness(self) -> Array:
        """(k,) curvature of minus the log density of psi."""
        return np.array([normal_curvature(self.spread)])

    def log_variance(self, psi: Array) -> Array:
        """(q,) logarithms."""
        return np.asarray(2.0 * np.log(self.scale) + 2.0 * psi[0])

    def slope(self, psi: Array) -> Array:
        """(q, k) of the log variances."""
        return np.full((len(self.scale), 1), 2.0)

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density and gradient (k,)."""
        return log_density(psi[0], self.mean, self.spread, self.low[0], self.high[0])


def normal_curvature(spread: float) -> float:
    """Curvature of minus the log density of one logarithm; spread 0: even."""
    return spread**-2 if spread > 0.0 else 0.0


def log_density(
    value: float, mean: float, spread: float, low: float, high: float
) -> tuple[float, Array]:
    """Of one logarithm: normal, or even between its ends (spread 0); and its slope (1,)."""
    if spread > 0.0:
        scaled = (value - mean) / spread
        return -0.5 * scaled**2 - float(np.log(spread * np.sqrt(2 * np.pi))), np.array(
            [-scaled / spread]
        )
    return -float(np.log(high - low)), np.zeros(1)
