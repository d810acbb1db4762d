"""The tables of the configuration file: each key with its limits, and below it what it does.

The text under a key ends in its unit; which way a limit pushes is said where it is not plain. The
defaults of `[estimator]` and `[gates]` are those of the code that uses them.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.writeback.policy import StillPolicy, TrialPolicy, WriteBackPolicy

Baud = Literal["auto", 9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600]


class Section(BaseModel):
    """A table of the file: frozen, nothing converted, nothing unknown."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )

    @field_validator("*", mode="before")
    @classmethod
    def _paths(cls, value: object, info: ValidationInfo) -> object:
        """TOML has no paths: text becomes one where a path is wanted; `~` is the home folder."""
        name = info.field_name or ""
        wants_path = cls.model_fields[name].annotation == Path | None
        return Path(value).expanduser() if wants_path and isinstance(value, str) else value


class Device(Section):
    """The VN-100 and its port."""

    port: Path | None = None
    """Serial port; best by its stable name in /dev/serial/by-id."""
    serial_number: int | None = Field(default=None, ge=0, le=2**32 - 1)
    """Accept only the device with this serial number (register 3)."""
    baud: Baud = "auto"
    """Rate of the port; auto listens at each rate and never changes the device's. [Bd]"""
    configure_stream: bool = False
    """Allow changing the async and binary outputs in RAM for the session, in any mode but passive;
    they are put back at exit."""
    rate_hz: float = Field(default=100.0, ge=1.0, le=800.0)
    """Binary output to ask for with configure_stream. [Hz]"""


class Capture(Section):
    """The record of everything that came and went, raw."""

    enabled: bool = True
    """Record; a session without a capture cannot be replayed."""
    directory: Path | None = None
    """Folder of the captures; default: captures in the state directory."""
    part_megabytes: int = Field(default=64, ge=1, le=10**6)
    """A new file begins at this size. [MB]"""
    keep_megabytes: int = Field(default=2048, ge=16, le=10**8)
    """The oldest captures are removed beyond this sum. [MB]"""


class Rerun(Section):
    """The log for the rerun viewer, written by a process of its own."""

    file: Path | None = None
    """Write an .rrd file here."""
    serve: bool = False
    """Serve a live view to a viewer on this machine."""
    port: int = Field(default=9876, ge=1024, le=65535)
    """TCP port of the live view, on 127.0.0.1 only."""
    memory_megabytes: int = Field(default=256, ge=16, le=10**5)
    """What the live view keeps for viewers that connect late. [MB]"""


_ESTIMATOR = EstimatorParameters()


class Estimator(Section):
    """The estimate of iron and gyro bias."""

    step_rate_hz: float = Field(default=_ESTIMATOR.step_rate_hz, ge=1.0, le=800.0)
    """Faster streams are averaged down to this; higher follows faster motion, costs more. [Hz]"""
    epoch_steps: int = Field(default=_ESTIMATOR.epoch_steps, ge=16, le=65536)
    """Steps per epoch; larger loses less at the borders and answers later. [steps]"""
    window_steps: int = Field(default=_ESTIMATOR.window_steps, ge=64, le=10**6)
    """Steps that are linearised again; larger is nearer to the batch answer. [steps]"""
    bias_walk_rad_s_sqrt_s: float = Field(
        default=_ESTIMATOR.bias_walk_rad_s_sqrt_s, ge=0.0, le=0.01
    )
    """Random walk of the gyro bias; larger follows temperature faster. [rad/s/sqrt(s)]"""
    prior_soft_iron: float = Field(default=_ESTIMATOR.prior_soft_iron, gt=0.0, le=10.0)
    """1 sigma of the soft iron around the device's present value; smaller trusts the device more.
    [1]"""
    prior_hard_iron_gauss: float = Field(default=_ESTIMATOR.prior_hard_iron_gauss, gt=0.0, le=10.0)
    """The same for the hard iron. [gauss]"""
    prior_gyro_bias_rad_s: float = Field(default=_ESTIMATOR.prior_gyro_bias_rad_s, gt=0.0, le=1.0)
    """The same for the gyro bias. [rad/s]"""
    outlier_sigma: float = Field(default=_ESTIMATOR.outlier_sigma, ge=2.0, le=100.0)
    """Field residuals beyond this lose weight; smaller ignores more. [sigma]"""
    mag_noise_floor_gauss: float = Field(default=_ESTIMATOR.mag_noise_floor_gauss, gt=0.0, le=1.0)
    """Never believe less field noise than this. [gauss]"""
    gyro_noise_floor_rad_s: float = Field(default=_ESTIMATOR.gyro_noise_floor_rad_s, gt=0.0, le=1.0)
    """Never believe less rate noise than this. [rad/s]"""

    def parameters(self) -> EstimatorParameters:
        """What the estimator takes."""
        return EstimatorParameters(**self.model_dump())


_ORDERED = (
    ("tilt_2d_deg", "tilt_3d_deg"),
    ("field_min_gauss", "field_max_gauss"),
    ("field_spread_flash_percent", "field_spread_ram_percent"),
    ("max_condition_auto", "max_condition_operator"),
    ("max_offset_auto_gauss", "max_offset_operator_gauss"),
    ("max_step_auto_deg", "max_step_operator_deg"),
)


class Gates(Section):
    """What must hold before anything is written; every limit may be made stricter or looser."""

    max_error_rate: float = Field(default=1e-3, ge=0.0, le=1.0)
    """Messages whose checksum or CRC was wrong, over all. [1]"""
    max_drop_rate: float = Field(default=5e-3, ge=0.0, le=1.0)
    """Samples that are missing, over all. [1]"""
    min_rate_hz: float = Field(default=10.0, ge=1.0, le=800.0)
    """Sample rate. [Hz]"""
    min_heading_excursion_deg: float = Field(default=280.0, ge=0.0, le=360.0)
    """Headings that were driven. [deg]"""
    tilt_3d_deg: float = Field(default=30.0, ge=0.0, le=90.0)
    """Roll and pitch both beyond this make the motion three-dimensional. [deg]"""
    tilt_2d_deg: float = Field(default=5.0, ge=0.0, le=90.0)
    """Tilt that a planar motion may have at most. [deg]"""
    max_heading_sigma_deg: float = Field(default=1.0, gt=0.0, le=20.0)
    """1 sigma of the heading at the worst attitude that was driven. [deg]"""
    field_min_gauss: float = Field(default=0.22, ge=0.0, le=2.5)
    """Weakest field on Earth. [gauss]"""
    field_max_gauss: float = Field(default=0.67, ge=0.0, le=2.5)
    """Strongest field on Earth. [gauss]"""
    field_model_percent: float = Field(default=10.0, gt=0.0, le=100.0)
    """Mean field against the world magnetic model, where a location is given. [%]"""
    field_spread_ram_percent: float = Field(default=2.0, gt=0.0, le=100.0)
    """Standard deviation of the corrected field over its mean, to write RAM. [%]"""
    field_spread_flash_percent: float = Field(default=1.0, gt=0.0, le=100.0)
    """The same to write flash. [%]"""
    max_inclination_error_deg: float = Field(default=3.0, gt=0.0, le=90.0)
    """Inclination against the world magnetic model. [deg]"""
    holdout_segments: int = Field(default=2, ge=0, le=100)
    """Full turns that the estimate has not seen and on which it is judged. [turns]"""
    holdout_separation_s: float = Field(default=600.0, ge=0.0, le=86400.0)
    """Time between the data of the estimate and the data that judge it. [s]"""
    holdout_rms_deg: float = Field(default=1.5, gt=0.0, le=180.0)
    """Heading by the field against heading by the gyro there, RMS. [deg]"""
    holdout_max_deg: float = Field(default=3.0, gt=0.0, le=180.0)
    """The same, largest. [deg]"""
    closure_deg: float = Field(default=2.0, gt=0.0, le=180.0)
    """Heading error that is left after a full turn. [deg]"""
    min_improvement_percent: float = Field(default=20.0, ge=0.0, le=100.0)
    """RMS on the held-out data must be lower than with the present registers by this. [%]"""
    min_improvement_deg: float = Field(default=0.3, ge=0.0, le=180.0)
    """And by this. [deg]"""
    repeat_hard_iron_gauss: float = Field(default=0.01, gt=0.0, le=2.5)
    """Hard iron of two disjoint windows. [gauss]"""
    repeat_heading_deg: float = Field(default=1.0, gt=0.0, le=180.0)
    """Heading that two disjoint windows predict, over all headings. [deg]"""
    second_opinion_deg: float = Field(default=2.0, gt=0.0, le=180.0)
    """Heading against that of an independent ellipsoid fit. [deg]"""
    max_condition_auto: float = Field(default=2.0, ge=1.0, le=100.0)
    """Condition number of the correction matrix without a person. [1]"""
    max_condition_operator: float = Field(default=8.0, ge=1.0, le=100.0)
    """The same with a person's approval. [1]"""
    max_offset_auto_gauss: float = Field(default=0.6, gt=0.0, le=2.5)
    """Hard iron without a person. [gauss]"""
    max_offset_operator_gauss: float = Field(default=1.3, gt=0.0, le=2.5)
    """The same with a person's approval. [gauss]"""
    max_step_auto_deg: float = Field(default=5.0, gt=0.0, le=180.0)
    """Change of heading that a write may cause without a person. [deg]"""
    max_step_operator_deg: float = Field(default=20.0, gt=0.0, le=180.0)
    """The same with a person's approval; beyond it nothing is written. [deg]"""
    max_field_change_gauss: float = Field(default=0.05, gt=0.0, le=2.5)
    """Drift of the corrected field over the window. [gauss]"""
    max_temperature_drift_c: float = Field(default=5.0, gt=0.0, le=100.0)
    """Drift of the temperature over the window. [degC]"""
    max_gyro_bias_deg_s: float = Field(default=3.0, gt=0.0, le=100.0)
    """Gyro bias. [deg/s]"""

    @model_validator(mode="after")
    def _in_order(self) -> Gates:
        for low, high in _ORDERED:
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} must not be larger than {high}")
        return self


class Interlock(Section):
    """The vehicle's word that a write is safe now."""

    file: Path | None = None
    """File that the vehicle rewrites while it is safe, its content the word safe; without one, or
    with anything else in it, nothing is ever written."""
    max_age_s: float = Field(default=WriteBackPolicy().interlock_max_age_s, gt=0.0, le=60.0)
    """Older than this counts as no. [s]"""


class Location(Section):
    """Where the vehicle is, for the field that the world magnetic model expects there."""

    latitude_deg: float | None = Field(default=None, ge=-90.0, le=90.0)
    """Latitude, north positive; without a location the flash is never written. [deg]"""
    longitude_deg: float | None = Field(default=None, ge=-180.0, le=180.0)
    """Longitude, east positive. [deg]"""
    height_m: float = Field(default=0.0, ge=-1000.0, le=100_000.0)
    """Height above the ellipsoid. [m]"""
    date: datetime.date | None = None
    """Date of the model; default: today, for a recording the day it was made."""

    @model_validator(mode="after")
    def _both(self) -> Location:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("latitude_deg and longitude_deg must be given together")
        return self


_POLICY = WriteBackPolicy()
_TRIAL = _POLICY.trial
_STILL = _POLICY.still


class WriteBack(Section):
    """Who says yes to a write, and what is worth one."""

    approval: Literal["operator", "auto"] = _POLICY.approval
    """operator: a person approves each candidate by its id; auto: small changes need nobody."""
    commit_unattended: bool = _POLICY.commit_unattended
    """Save to flash without an operator's yes (mode commit, approval auto)."""
    keep_on_stop: bool = _POLICY.keep_on_stop
    """Leave values that were not saved in RAM when the daemon stops; otherwise they are undone."""
    min_change_deg: float = Field(default=_POLICY.min_change_deg, ge=0.0, le=180.0)
    """A change of heading below this is not worth a write. [deg]"""
    min_gyro_change_rad_s: float = Field(default=_POLICY.min_gyro_change_rad_s, ge=0.0, le=1.0)
    """And a change of the gyro bias below this neither. [rad/s]"""
    max_change_auto_deg: float = Field(default=_POLICY.max_change_auto_deg, gt=0.0, le=180.0)
    """A larger change of heading needs an operator whatever `approval` says. [deg]"""
    margin_after_rollback: float = Field(default=_POLICY.margin_after_rollback, ge=1.0, le=100.0)
    """After a rollback only changes so many times as large are worth a write. [1]"""


class Trial(Section):
    """The time in which written registers must prove themselves on live data."""

    duration_s: float = Field(default=_TRIAL.duration_s, gt=0.0, le=86400.0)
    """How long, unless the turns below come first; longer proves more. [s]"""
    turns: float = Field(default=_TRIAL.turns, gt=0.0, le=100.0)
    """Full turns that end the trial. [turns]"""
    worse_percent: float = Field(default=_TRIAL.worse_percent, gt=0.0, le=100.0)
    """Roll back where the live figure is worse than with the old registers by this ... [%]"""
    worse_for_s: float = Field(default=_TRIAL.worse_for_s, ge=0.0, le=86400.0)
    """... for this long. [s]"""
    max_spread_percent: float = Field(default=_TRIAL.max_spread_percent, gt=0.0, le=100.0)
    """Roll back where the corrected field scatters by more than this. [%]"""
    max_jump_deg: float = Field(default=_TRIAL.max_jump_deg, gt=0.0, le=180.0)
    """Roll back where the heading jumps by so much more than predicted. [deg]"""
    interlock: bool = _TRIAL.interlock
    """Roll back where the vehicle withdraws its word; false where the word is only about the moment
    of writing."""

    def policy(self) -> TrialPolicy:
        """What the write-back takes."""
        return TrialPolicy(**self.model_dump())


class Still(Section):
    """Our own proof that the vehicle rests before the flash is written."""

    gyro_rad_s: float = Field(default=_STILL.gyro_rad_s, gt=0.0, le=1.0)
    """Rate less bias below which it rests. [rad/s]"""
    accel_m_s2: float = Field(default=_STILL.accel_m_s2, gt=0.0, le=10.0)
    """Standard deviation of the specific force below which it rests. [m/s^2]"""
    duration_s: float = Field(default=_STILL.duration_s, gt=0.0, le=3600.0)
    """For how long. [s]"""
    max_age_s: float = Field(default=_STILL.max_age_s, gt=0.0, le=60.0)
    """How old the newest sample may be then. [s]"""

    def policy(self) -> StillPolicy:
        """What the write-back takes."""
        return StillPolicy(**self.model_dump())


class Budget(Section):
    """How often the device may be written."""

    min_interval_s: float = Field(default=_POLICY.min_interval_s, ge=0.0, le=10**6)
    """Between two writes of RAM. [s]"""
    ram_writes_per_day: int = Field(default=_POLICY.ram_writes_per_day, ge=0, le=1000)
    """Writes of RAM. [1/day]"""
    flash_writes_per_day: int = Field(default=_POLICY.flash_writes_per_day, ge=0, le=100)
    """Writes of flash. [1/day]"""
    flash_writes_lifetime: int = Field(default=_POLICY.flash_writes_lifetime, ge=0, le=10_000)
    """Writes of flash over the device's life, counted in the journal."""
    cooldown_s: float = Field(default=_POLICY.cooldown_s, ge=0.0, le=10**7)
    """No write for this long after a rollback. [s]"""
    rollbacks_to_lock: int = Field(default=_POLICY.rollbacks_to_lock, ge=1, le=100)
    """So many rollbacks in a row lock the write-back until a person unlocks it."""
