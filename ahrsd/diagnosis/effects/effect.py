"""Interface of an effect of the library, and the values that it works on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, Literal

import numpy as np

from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

Family = Literal["sensor", "world", "gyro", "link"]
#: what an effect changes: the mean of the readings, their scatter, or the stream itself
Kind = Literal["mean", "variance", "discrete"]
#: one non-linear choice of an effect: onset, time constant, covariate, ...
Setting = dict[str, Any]

#: settings that are a size or an angle: refined between the values of their grid
SCALES = ("time_constant_s", "radius_gauss", "length_s", "length_m")
ANGLES = ("turn_deg",)
#: a direction is observable if a coefficient at its physical bound is so many standard deviations
BOUND_DEVIATIONS = 3.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One coefficient of an effect.

    scale: its usual physical size, one prior deviation;  bound: larger values are not believed
    least: smaller values are not believed; either sign is allowed if left out
    """

    name: str
    unit: str
    scale: float
    bound: float
    least: float = -np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Readings of a simulated sensor, and the truth that an effect may need.

    time_s, dt_s (N,), dt_s nan in the first row of each gap-free run; mag_b_gauss, gyro_b_rad_s,
    accel_b_m_s2 (nan where there is none), rate_b_rad_s (true mean rate over the step that ends at
    the sample), field_b (true, gauss) (N, 3); R_nb (N, 3, 3); soft_iron (3, 3); covariates (N,).
    force_b_m_s2 (N, 3): specific force without the accelerometer's noise; None: accel_b_m_s2.
    """

    time_s: Array
    dt_s: Array
    mag_b_gauss: Array
    gyro_b_rad_s: Array
    accel_b_m_s2: Array
    rate_b_rad_s: Array
    field_b: Array
    R_nb: Array
    soft_iron: Array
    covariates: dict[str, Array]
    force_b_m_s2: Array | None = None


class Effect(ABC):
    """One way in which a real recording departs from the calibration model.

    identifier:  as in the contract (`motor_current_field`);  code: as in the dossier (`M4`)
    words:       the name that a field engineer would use
    equation:    of the left-out term, in text
    parameters:  the coefficients, in the order of `value` and of the columns
    typical:     a value of ordinary size: strength 1 of `simulate --effect`
    needs:       covariate roles without which it cannot be computed (`current`, ...); `a|b`: one
    signature:   what it looks like in the residual
    confusers:   (identifier, what separates the two) pairs
    manoeuvre:   what to drive or do so that the effect shows itself
    size:        what is seen on real vehicles;  source: of the size and of the equation
    kind:        "variance" and "discrete" effects have no columns and no settings
    after_noise: it acts on the finished reading, noise included
    of_whole:    it acts on all that its sensor measures, other effects included
    frame:       the frame in which it is reported, if that is not the family's name
    rides:       its field is constant in sensor axes, in gauss per unit of a logged column
    unseen:      unit directions (p,) of the parameters that no motion makes observable: a fit of
                 them would fit the noise of their columns, so they keep the prior
    quick:       visible only at the recorded rate: averaging over some readings removes it
    course:      any slow time series in its frame is this effect, whatever its form
    jumps:       one constant vector along the axes of its frame, from its onset on
    recurs:      where there is one, a further one is no rare event: what was put on is taken off
    delay:       sign of the delay of the magnetometer against the gyro; 0 if it is no delay
    plain:       the delay that is reported for its sign unless another is more probable
    filters:     its delay is that of a filter;  of_step: reported in half steps of the recording
    ordinary:    the size, in usual scales, that one in ten untouched recordings exceeds, given the
                 ordinary remainder; 0 where hardly any has it
                 (`python tests/benchmarks/diagnosis/bench_remainder_priors.py`)
    ordinary_part: the part of the ordinary remainder that has the form of this effect
    turns_sensors: its three parameters are the rotation of the magnetometer against the gyro, rad
    remembers:   bound of each axis of its initial state (setting `memory`), in that setting's unit;
                 0 without a memory
    """

    identifier: str
    code: str
    family: Family
    words: str
    equation: str
    parameters: tuple[Parameter, ...]
    typical: tuple[float, ...]
    needs: tuple[str, ...] = ()
    signature: str
    confusers: tuple[tuple[str, str], ...] = ()
    manoeuvre: str
    size: str
    source: str
    kind: Kind = "mean"
    after_noise: bool = False
    of_whole: bool = False
    frame: str | None = None
    rides: bool = False
    unseen: tuple[tuple[float, ...], ...] = ()
    quick: bool = False
    course: bool = False
    jumps: bool = False
    recurs: bool = False
    delay: float = 0.0
    plain: bool = False
    filters: bool = False
    of_step: bool = False
    ordinary: float = 0.0
    ordinary_part: str | None = None
    turns_sensors: bool = False
    remembers: float = 0.0

    @property
    def least_information(self) -> float:
        """Least information of an observable direction of its coefficients, in prior deviations.

        A coefficient at its physical bound must be three of its standard deviations.  One of usual
        size may be less: on a noisy recording only a large one shows, but that one does.
        """
        reach = min((one.bound / one.scale for one in self.parameters), default=1.0)
        return float(min(1.0, (BOUND_DEVIATIONS / reach) ** 2))

    @abstractmethod
    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The non-linear choices worth trying here; empty where the effect cannot be computed.

        `onset_s` is in the time of the recording.  A key `searched` counts the alternatives from
        which the setting was selected by looking at the data; ln(searched) is subtracted from the
        evidence.
        """

    @abstractmethod
    def columns(self, context: Context, setting: Setting) -> Columns:
        """Derivatives of the readings by the parameters at zero effect; p = len(parameters)."""

    @abstractmethod
    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The readings with the effect of the given size, exactly (not linearised)."""

    @abstractmethod
    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Value and setting of an effect of `strength` times its typical size, for a simulation.

        Raises ValueError in one line where the readings lack what it needs.
        """


class Linear(Effect):
    """An effect that is linear in its parameters: columns times parameters is the effect."""

    @abstractmethod
    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The settings that these readings allow, without using the magnetometer."""

    @abstractmethod
    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The columns, from the truth and the covariates."""

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The choices."""
        return self.choices(readings_of(context))

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms along the recording under the present model."""
        return self.terms(readings_of(context), setting)

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Adds the terms times the value."""
        return add_terms(readings, self.terms(readings, setting), value)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """The middle one of the choices."""
        choices = self.choices(readings)
        if not choices:
            raise ValueError(f"{self.identifier} needs {needs_text(self)}")
        return strength * np.array(self.typical), choices[len(choices) // 2]


class Scatter(Effect):
    """An effect on the magnetometer's noise and not on the mean of its readings."""

    kind: Kind = "variance"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """None: there is nothing to regress the readings on."""
        return ()

    def columns(self, context: Context, setting: Setting) -> Columns:
        """None."""
        return Columns()


class Discrete(Effect):
    """A fault of the stream that is counted and not fitted, before any physics."""

    kind: Kind = "discrete"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """None: there is nothing to regress the readings on."""
        return ()

    def columns(self, context: Context, setting: Setting) -> Columns:
        """None."""
        return Columns()


class Clipped(Discrete):
    """The range limit of a sensor, none if 0.  `quantity`: the readings (N, 3) that it clips."""

    quantity: ClassVar[str]
    after_noise = True

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Clipped readings."""
        limit = float(value[0]) or np.inf
        clipped = np.clip(getattr(readings, self.quantity), -limit, limit)
        return replace(readings, **{self.quantity: clipped})

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """A higher strength is a lower limit."""
        return np.array([self.typical[0] / strength if strength else 0.0]), {}


def needs_text(effect: Effect) -> str:
    """What an effect needs, in words."""
    needs = [f"a column of {' or '.join(need.split('|'))}" for need in effect.needs]
    return " and ".join(needs) if needs else "a longer recording"


@lru_cache(maxsize=2)  # every effect asks in every setting
def readings_of(context: Context) -> Readings:
    """Noise-free readings of a context's sensors, and the truth; cached for all effects."""
    track, model = context.track, context.model
    accel = track.accel_b_m_s2
    return Readings(
        time_s=track.time_s,
        dt_s=track.dt_s,
        mag_b_gauss=context.field_b @ model.soft_iron.T + model.hard_iron_gauss,
        gyro_b_rad_s=context.rate_b_rad_s + model.gyro_bias_rad_s,
        accel_b_m_s2=np.full_like(context.field_b, np.nan) if accel is None else accel,
        rate_b_rad_s=context.rate_b_rad_s,
        field_b=context.field_b,
        R_nb=context.R_nb,
        soft_iron=model.soft_iron,
        covariates=track.covariates,
        force_b_m_s2=context.force_b_m_s2,
    )


def rowwise_readings_of(context: Context) -> Readings:
    """The same with rates that share no noise with the innovation of their row."""
    return replace(readings_of(context), rate_b_rad_s=context.rowwise_rate_b_rad_s)


def smooth_readings_of(context: Context) -> Readings:
    """The same with the smoothed field: differences of the predicted field are gyro noise."""
    model, smooth = context.model, context.smooth_b
    mag = smooth @ model.soft_iron.T + model.hard_iron_gauss
    return replace(readings_of(context), field_b=smooth, mag_b_gauss=mag)


def residual_gauss(context: Context) -> Array:
    """(N, 3) gauss, readings less the smoothed field under the calibration; 0 without a reading."""
    model = context.model
    expected = context.smooth_b @ model.soft_iron.T + model.hard_iron_gauss
    return np.nan_to_num(context.track.mag_b_gauss - expected)


def add_terms(readings: Readings, terms: Columns, value: Array) -> Readings:
    """The readings plus `terms` (N, 3, p) times `value` (p,)."""
    mag, gyro = readings.mag_b_gauss, readings.gyro_b_rad_s
    return replace(
        readings,
        mag_b_gauss=mag if terms.mag is None else mag + terms.mag @ value,
        gyro_b_rad_s=gyro if terms.gyro is None else gyro + terms.gyro @ value,
    )
