"""What a row of the library is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

from ahrsd.mismatch.values import Columns, Context
from ahrsd.samples import Array

Family = Literal["sensor", "world", "gyro", "link"]
#: what a non-linear choice of an effect is made of: onset, time constant, covariate's name ...
Setting = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One coefficient: its name, unit, and how large it physically is (one prior deviation)."""

    name: str
    unit: str
    scale: float
    bound: float


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Readings of a simulated sensor together with the truth that an effect may need.

    time_s, dt_s (N,); mag_b_gauss, gyro_b_rad_s, accel_b_m_s2, rate_b_rad_s (true), field_b (true)
    (N, 3); R_nb (N, 3, 3); covariates (N,).
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


class Effect(ABC):
    """One way in which a real recording departs from the calibration model.

    identifier:  of the contract (`motor_current_field`);  code: of the dossier (`M4`)
    words:       what a field engineer calls it
    equation:    of the left-out term, in text
    needs:       covariate roles without which it cannot be computed (`current`, `temperature`, ...)
    confusers:   (identifier, what separates the two) pairs
    manoeuvre:   what to drive or do so that the effect shows itself
    size:        what is seen on real vehicles;  source: where that and the equation come from
    """

    identifier: str
    code: str
    family: Family
    words: str
    equation: str
    parameters: tuple[Parameter, ...]
    needs: tuple[str, ...] = ()
    confusers: tuple[tuple[str, str], ...] = ()
    manoeuvre: str
    size: str
    source: str

    @abstractmethod
    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The non-linear choices worth trying here; empty where it cannot be computed."""

    @abstractmethod
    def columns(self, context: Context, setting: Setting) -> Columns:
        """Derivatives of the readings by the parameters at zero effect; p = len(parameters)."""

    @abstractmethod
    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The readings with the effect of the given size, exactly (not linearised)."""
