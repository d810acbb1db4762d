"""What a row of the library is."""

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
#: what a non-linear choice of an effect is made of: onset, time constant, covariate's name ...
Setting = dict[str, Any]

#: settings that are a size or an angle, sought between the values of their grid
SCALES = ("time_constant_s", "radius_gauss", "length_s", "length_m")
ANGLES = ("turn_deg",)
#: deviations that a coefficient at its physical bound must be for a direction to be observable
BOUND_DEVIATIONS = 3.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One coefficient: its name, unit, how large it physically is (one prior deviation), the size
    beyond which it is not believed, and the value below which it is not, of either sign if left
    out."""

    name: str
    unit: str
    scale: float
    bound: float
    least: float = -np.inf


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Readings of a simulated sensor together with the truth that an effect may need.

    time_s, dt_s (N,), dt_s nan in the first row of each gap-free run; mag_b_gauss, gyro_b_rad_s,
    accel_b_m_s2 (nan where there is none), rate_b_rad_s (true mean rate over the step that ends at
    the sample), field_b (true, gauss) (N, 3); R_nb (N, 3, 3); soft_iron (3, 3); covariates (N,).
    force_b_m_s2 (N, 3): specific force without the accelerometer's noise, None: as it reads.
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

    identifier:  of the contract (`motor_current_field`);  code: of the dossier (`M4`)
    words:       what a field engineer calls it
    equation:    of the left-out term, in text
    parameters:  the coefficients, in the order of `value` and of the columns
    typical:     a value of ordinary size: strength 1 of `simulate --effect`
    needs:       covariate roles without which it cannot be computed (`current`, ...); `a|b`: one
    signature:   what it looks like in the residual
    confusers:   (identifier, what separates the two) pairs
    manoeuvre:   what to drive or do so that the effect shows itself
    size:        what is seen on real vehicles;  source: where that and the equation come from
    kind:        "variance" and "discrete" effects have no columns and no settings
    after_noise: it acts on the finished reading, noise included
    of_whole:    it acts on all that its sensor measures, whatever other effects put there
    frame:       in which it is told, where that is not the family's name
    rides:       its field stays on the sensor whatever that does, in gauss by what was logged
    unseen:      unit directions (p,) of the parameters that no motion shows: what a fit says of
                 them is the noise of its own columns, and what is known is the prior
    quick:       only the recorded rate shows it: averaged over some readings it is gone
    course:      whether any slow course in time of its frame is it, whatever the form
    jumps:       one constant vector along the axes of its frame, from its onset on
    recurs:      a further one is no rare thing where there is one: what was put on is taken off
    delay:       sign of the magnetometer's delay against the gyro that it is; 0 where it is none
    plain:       among delays of a sign, the one that is told where nothing speaks for another
    filters:     its delay is a filter's;  of_step: its delay is told in half steps of the recording
    ordinary:    its size, in usual scales, that one in ten untouched recordings is beyond, beside
                 what such leave; 0 where hardly any has it
                 (`python tests/benchmarks/diagnosis/bench_remainder_priors.py`)
    ordinary_part: of what real recordings ordinarily leave, the part whose form it is
    turns_sensors: its three parameters are the turn of the magnetometer against the gyro, rad
    remembers:   the most of what each axis may have from before the recording (setting `memory`),
                 in that setting's unit; 0 where it remembers nothing
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
        """Of a direction of its coefficients, in prior deviations, for it to count as observable.

        A coefficient at its physical bound must be three of its own deviations there; one of usual
        size may be less: on a noisy recording only a large one shows, but that one does.
        """
        reach = min((one.bound / one.scale for one in self.parameters), default=1.0)
        return float(min(1.0, (BOUND_DEVIATIONS / reach) ** 2))

    @abstractmethod
    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The non-linear choices worth trying here; empty where it cannot be computed.

        `onset_s` is in the time of the recording.  A key `searched` counts the alternatives among
        which the setting was picked by looking at the data: evidence has to pay ln(searched).
        """

    @abstractmethod
    def columns(self, context: Context, setting: Setting) -> Columns:
        """Derivatives of the readings by the parameters at zero effect; p = len(parameters)."""

    @abstractmethod
    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The readings with the effect of the given size, exactly (not linearised)."""

    @abstractmethod
    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Value and setting of the effect `strength` times as large as usual, for a simulation.

        Raises ValueError in one line where the readings lack what it needs.
        """


class Linear(Effect):
    """An effect that is linear in its parameters: its columns are the effect."""

    @abstractmethod
    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The settings that these readings allow, without looking at the magnetometer."""

    @abstractmethod
    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The columns, from the truth and the covariates."""

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """As the class says, and nothing else."""
        return self.choices(readings_of(context))

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms along the recording as the present model sees it."""
        return self.terms(readings_of(context), setting)

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Adds the terms times the value."""
        return added(readings, self.terms(readings, setting), value)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """The middle one of the choices."""
        choices = self.choices(readings)
        if not choices:
            raise ValueError(f"{self.identifier} needs {lacking(self)}")
        return strength * np.array(self.typical), choices[len(choices) // 2]


class Scatter(Effect):
    """An effect that changes how much the magnetometer scatters and nothing of the mean."""

    kind: Kind = "variance"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """None: there is nothing to regress the readings on."""
        return ()

    def columns(self, context: Context, setting: Setting) -> Columns:
        """None."""
        return Columns()


class Discrete(Effect):
    """A fault that is there or not; looked for before any physics."""

    kind: Kind = "discrete"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """None: there is nothing to regress the readings on."""
        return ()

    def columns(self, context: Context, setting: Setting) -> Columns:
        """None."""
        return Columns()


class Clipped(Discrete):
    """A sensor's range, none if 0. `quantity` names the readings (N, 3) that end there."""

    quantity: ClassVar[str]
    after_noise = True

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Clipped readings."""
        limit = float(value[0]) or np.inf
        clipped = np.clip(getattr(readings, self.quantity), -limit, limit)
        return replace(readings, **{self.quantity: clipped})

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """The stronger, the lower the limit."""
        return np.array([self.typical[0] / strength if strength else 0.0]), {}


def lacking(effect: Effect) -> str:
    """What an effect needs, in words."""
    needs = [f"a column of {' or '.join(need.split('|'))}" for need in effect.needs]
    return " and ".join(needs) if needs else "a longer recording"


@lru_cache(maxsize=2)  # every effect asks in every setting
def readings_of(context: Context) -> Readings:
    """What the sensors of a context would read without noise, and the truth behind it."""
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
    """The same with rates that share no noise with their row's innovation."""
    return replace(readings_of(context), rate_b_rad_s=context.rowwise_rate_b_rad_s)


def smooth_readings_of(context: Context) -> Readings:
    """The same with the smooth field: the differences of the foretold one are the gyro's noise."""
    model, smooth = context.model, context.smooth_b
    mag = smooth @ model.soft_iron.T + model.hard_iron_gauss
    return replace(readings_of(context), field_b=smooth, mag_b_gauss=mag)


def residual_gauss(context: Context) -> Array:
    """(N, 3) gauss, readings less what field and calibration make of them; 0 without a reading."""
    model = context.model
    expected = context.smooth_b @ model.soft_iron.T + model.hard_iron_gauss
    return np.nan_to_num(context.track.mag_b_gauss - expected)


def added(readings: Readings, terms: Columns, value: Array) -> Readings:
    """The readings with `terms` (N, 3, p) times `value` (p,) on top."""
    mag, gyro = readings.mag_b_gauss, readings.gyro_b_rad_s
    return replace(
        readings,
        mag_b_gauss=mag if terms.mag is None else mag + terms.mag @ value,
        gyro_b_rad_s=gyro if terms.gyro is None else gyro + terms.gyro @ value,
    )
