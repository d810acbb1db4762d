"""A component of the model: columns on the sensor readings and the prior law of their coefficients.

    readings = calibration + sum_j B_j w_j + noise,    w_j ~ N(0, diag(Phi_j(psi_j)))

The columns B_j are computed from the context (the recording as the present model sees it).  The law
gives the variances Phi_j and their slopes in the hyperparameters psi_j, all of which are
logarithms.
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
    """Prior variances (q,) of independent coefficients as a function of psi (k,), all logarithms.

    start, low, high (k,): start and bounds of a search for psi
    """

    @property
    def start(self) -> Array:
        """Start of a search."""

    @property
    def low(self) -> Array:
        """Lower bound of psi."""

    @property
    def high(self) -> Array:
        """Upper bound of psi."""

    @property
    def stiffness(self) -> Array:
        """(k,) curvature of minus the log density of psi."""

    def log_variance(self, psi: Array) -> Array:
        """(q,) log variances of the coefficients."""

    def slope(self, psi: Array) -> Array:
        """(q, k) derivatives of the log variances with respect to psi."""

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density of psi and its gradient (k,)."""


#: keys of a setting, s: the times at which an effect begins and ends
MOMENTS = ("onset_s", "end_s")


@dataclass(frozen=True, slots=True, eq=False)
class LazyColumns:
    """Columns that are computed anew at each access.

    The columns of a thousand candidates would take as much memory as their filtered rows, and few
    of them are needed again.
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
    """Columns of functions of time (N, count), each along each axis of a frame: (N, 3, 3 count)."""

    def make() -> Columns:
        axes = unit_columns(context, frame)
        flat = (time_functions()[:, None, :, None] * axes[:, :, None, :]).reshape(len(axes), 3, -1)
        return Columns(gyro=flat) if frame == "gyro" else Columns(mag=flat)

    return LazyColumns(make, 3 * count, on_mag=frame != "gyro", on_gyro=frame == "gyro")


@dataclass(frozen=True, slots=True, eq=False)
class Component:
    """One part of the model.

    key:     unique identifier in a hypothesis
    frame:   sensor, world, gyro or link
    columns: readings per unit of the coefficients
    law:     prior law of the coefficients
    prior:   prior log odds that the component is present
    row, setting: the library's effect and its setting, where the component is one
    beside: key of a component whose columns lie in the span of this one's and were projected out of
            them; this component is tested only in a model that contains that one
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
        """Identifier of its effect in the library, None where it is none."""
        return None if self.row is None else self.row.identifier

    @property
    def jumps(self) -> bool:
        """True for an effect that is one constant vector from its onset on."""
        return self.row is not None and self.row.jumps

    @property
    def moments_s(self) -> tuple[float, ...]:
        """Times at which it begins and, where its setting has an end, at which it ends, s."""
        times_s = (self.setting.get(name) for name in MOMENTS)
        return tuple(float(one) for one in times_s if one is not None)

    @property
    def width(self) -> int:
        """Number of coefficients."""
        return self.columns.width

    def shifted_columns(self, share: float) -> Columns:
        """Its columns later by a share of the recording; what is cut off at the end comes first."""
        mag, gyro = (
            None if part is None else np.roll(part, round(share * len(part)), axis=0)
            for part in (self.columns.mag, self.columns.gyro)
        )
        return Columns(mag, gyro)

    def moved(self, share: float) -> Component:
        """A copy shifted in time: of the same law, but unrelated to the readings."""
        key = f"{self.key}, moved by {share}"
        return replace(self, key=key, columns=self.shifted_columns(share))

    def with_lazy_columns(self, context: Context) -> Component:
        """The same component, whose columns are computed from the context at each access."""
        if self.row is None or self.beside:
            raise ValueError(f"{self.key} is no effect of the library in a setting")
        columns = self.columns
        make = partial(self.row.columns, context, self.setting)
        lazy = LazyColumns(make, columns.width, columns.on_mag, columns.on_gyro)
        return replace(self, columns=lazy)


@dataclass(frozen=True, slots=True, eq=False)
class FixedLaw:
    """Known variances (q,) without hyperparameters."""

    variance: Array
    start: Array = field(default_factory=lambda: np.zeros(0))
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    stiffness: Array = field(default_factory=lambda: np.zeros(0))

    def log_variance(self, psi: Array) -> Array:
        """(q,) log variances."""
        return np.asarray(np.log(self.variance))

    def slope(self, psi: Array) -> Array:
        """(q, 0): no hyperparameters."""
        return np.zeros((len(self.variance), 0))

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density 0 and an empty gradient."""
        return 0.0, np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class ScaledLaw:
    """One size for all coefficients: variance = scale^2 e^(2 psi).

    scale (q,): unit of each coefficient;  low, high: bounds of psi
    mean, spread: of the normal prior of psi; spread 0: uniform between the bounds
    """

    scale: Array
    low: Array
    high: Array
    mean: float = 0.0
    spread: float = 0.0

    @property
    def start(self) -> Array:
        """Start of a search: the prior mean within the bounds."""
        return np.asarray(np.clip(np.array([self.mean]), self.low, self.high))

    @property
    def stiffness(self) -> Array:
        """(k,) curvature of minus the log density of psi."""
        return np.array([normal_curvature(self.spread)])

    def log_variance(self, psi: Array) -> Array:
        """(q,) log variances."""
        return np.asarray(2.0 * np.log(self.scale) + 2.0 * psi[0])

    def slope(self, psi: Array) -> Array:
        """(q, k) derivatives of the log variances with respect to psi."""
        return np.full((len(self.scale), 1), 2.0)

    def log_prior(self, psi: Array) -> tuple[float, Array]:
        """Log density and gradient (k,)."""
        return log_density(psi[0], self.mean, self.spread, self.low[0], self.high[0])


def normal_curvature(spread: float) -> float:
    """Curvature of minus the log density of a hyperparameter; 0 if it is uniform (spread 0)."""
    return spread**-2 if spread > 0.0 else 0.0


def log_density(
    value: float, mean: float, spread: float, low: float, high: float
) -> tuple[float, Array]:
    """Log density of one hyperparameter and its slope (1,).

    It is normal, or uniform between its bounds where spread is 0.
    """
    if spread > 0.0:
        scaled = (value - mean) / spread
        return -0.5 * scaled**2 - float(np.log(spread * np.sqrt(2 * np.pi))), np.array(
            [-scaled / spread]
        )
    return -float(np.log(high - low)), np.zeros(1)
