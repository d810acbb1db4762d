"""The quantities that a VN-100 measures: one row per number, for ASCII and binary messages alike.

A column's name says quantity, frame where it is not the sensor's, axis and unit, and is the same in
every message that carries the quantity. On the wire angles are degrees and times nanoseconds;
decoded values are SI, ``SI = wire / per_si``, and the field stays in gauss. The text format is the
one that current firmware prints (vn100-protocol 2; UM001 "Async Data Output").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

Compensation = Literal["", "uncompensated", "compensated"]
Frame = Literal["", "b", "n"]

_DEG = 180 / math.pi  # degrees in one radian
_NS = 1e9


@dataclass(frozen=True, slots=True)
class Column:
    """One number of a message.

    unit:         of the decoded value
    frame:        "b" sensor axes (after register 26), "n" north-east-down, "" no vector
    compensation: "uncompensated" is before, "compensated" behind the on-board real-time HSI and
                  filter biases; registers 23, 25 and 84 are in both. "" where it makes no sense
    per_si:       wire units in one unit of the decoded value
    printed:      C format in ASCII messages; empty where no ASCII message has it
    """

    name: str
    unit: str = ""
    frame: Frame = ""
    compensation: Compensation = ""
    per_si: float = 1.0
    printed: str = ""


Columns = tuple[Column, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The columns of one kind of message; there is one object per layout, compared by identity.

    name: "VNYMR", or header bytes and field words of a packet: "FA 06 0001 083F"
    """

    name: str
    columns: Columns
    per_si: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "per_si", tuple(column.per_si for column in self.columns))

    def index(self, name: str) -> int | None:
        """Where the column is; the first where a packet repeats it, None where it lacks it."""
        return next((i for i, column in enumerate(self.columns) if column.name == name), None)


def _vector(
    stem: str, unit: str, frame: Frame, compensation: Compensation = "", printed: str = ""
) -> Columns:
    """Three columns; NED vectors say so in their names."""
    axes = "xyz" if frame == "b" else ("n_n", "n_e", "n_d")
    suffix = f"_{unit.replace('^', '').replace('/', '_')}" if unit else ""
    return tuple(
        Column(f"{stem}_{axis}{suffix}", unit, frame, compensation, printed=printed)
        for axis in axes
    )


def _angles(names: str, printed: str, frame: Frame = "") -> Columns:
    return tuple(Column(name, "rad", frame, "", _DEG, printed) for name in names.split())


_MAG, _ACCEL, _GYRO, _ANGLE = "%+08.4f", "%+07.3f", "%+010.6f", "%+08.3f"
_EXPONENT = "%+.6E"  # of $VNCMV

TIME_STARTUP = (Column("time_startup_s", "s", per_si=_NS),)
TIME_SYNC_IN = (Column("time_sync_in_s", "s", per_si=_NS),)
SYNC_IN_COUNT = (Column("sync_in_count"),)
SYNC_OUT_COUNT = (Column("sync_out_count"),)
SERIAL_COUNT = Column("serial_count")  # appended to ASCII messages by register 30
SERIAL_STATUS = Column("serial_status")

YPR = _angles("yaw_rad pitch_rad roll_rad", _ANGLE)
YPR_SIGMA = _angles("yaw_sigma_rad pitch_sigma_rad roll_sigma_rad", "")
QUATERNION = tuple(Column(f"quat_{axis}", printed="%+09.6f") for axis in "xyzw")
# R_nb row by row, v_n = R_nb v_b (the manual's matrix, NED to body, column by column). A recording
# of a real device says so: there it agrees with the angles to f32 precision.
DCM = tuple(Column(f"dcm_{row}{column}") for row in range(3) for column in range(3))

MAG = _vector("mag", "gauss", "b", "compensated", _MAG)
ACCEL = _vector("accel", "m/s^2", "b", "compensated", _ACCEL)
GYRO = _vector("gyro", "rad/s", "b", "compensated", _GYRO)
UNCOMP_MAG = _vector("uncomp_mag", "gauss", "b", "uncompensated", _MAG)
UNCOMP_ACCEL = _vector("uncomp_accel", "m/s^2", "b", "uncompensated", _ACCEL)
UNCOMP_GYRO = _vector("uncomp_gyro", "rad/s", "b", "uncompensated", _GYRO)
UNCOMP_MAG_E = _vector("uncomp_mag", "gauss", "b", "uncompensated", _EXPONENT)
UNCOMP_ACCEL_E = _vector("uncomp_accel", "m/s^2", "b", "uncompensated", _EXPONENT)
UNCOMP_GYRO_E = _vector("uncomp_gyro", "rad/s", "b", "uncompensated", _EXPONENT)
MAG_NED = _vector("mag", "gauss", "n", "compensated")
ACCEL_NED = _vector("accel", "m/s^2", "n", "compensated")
LINEAR_ACCEL_BODY = _vector("linear_accel_b", "m/s^2", "b", "compensated", _ACCEL)
LINEAR_ACCEL_NED = _vector("linear_accel", "m/s^2", "n", "compensated", _ACCEL)

TEMPERATURE = (Column("temperature_c", "degC", printed="%+05.1f"),)
TEMPERATURE_E = (Column("temperature_c", "degC", printed=_EXPONENT),)
PRESSURE = (Column("pressure_kpa", "kPa", printed="%+08.3f"),)
DELTA_TIME = (Column("delta_time_s", "s", printed="%+09.6f"),)
DELTA_THETA = _angles("delta_theta_x_rad delta_theta_y_rad delta_theta_z_rad", "%+08.3f", "b")
DELTA_VELOCITY = _vector("delta_velocity", "m/s", "b", "", "%+08.3f")
HEAVE = (  # no source prints its format
    Column("heave_m", "m", printed="%+08.3f"),
    Column("heave_rate_m_s", "m/s", printed="%+08.3f"),
    Column("delayed_heave_m", "m", printed="%+08.3f"),
)

IMU_STATUS = (Column("imu_status"),)
SENS_SAT = (Column("sens_sat"),)
VPE_STATUS = (Column("vpe_status"),)
IMU_RAW = tuple(Column(f"imu_raw_{i}") for i in range(10))  # internal to firmware 2
