"""VN-100 register map: one row per register, and the functions that take a register's number.

Source: VN-100 user manual UM001, the chapter named in each row (section), for firmware 2.x and 3.x.
The default values of registers 32, 36, 38, 48 and 85 are one sensor's dump or the manual's
examples, not confirmed factory values; those of register 50 are "no aiding".

Commands and replies, as the device speaks them::

    $VNWRG,23,1.02,0.01,...*6F   format_command(23, values), written behind "VNWRG,"
    $VNRRG,23,1.02,0.01,...      format_reply(23, values), printed behind "VNRRG," or "VNWRG,"

**Firmware generations** (`Profile`, chosen by register 4):

| | 2.x (2.0, 2.1) | 3.x (3.0.0.0, 3.1.0.0) |
|---|---|---|
| on-board hard/soft iron, register 44 | ``1,3,5``: running and applied | ``0,1,5``: off |
| gyro bias at start-up, what VNSGB fills | register 74 | register 43 |
| VNTAR | yes | no (error 04) |
| register numbers in replies | 8 or 08 | 08 |

Any other firmware is unknown, and so is any other model: `Profile.writable` is false,
`observed_for` says why, and nothing may be changed on the device. The same holds for a device that
lacks a register which a VN-100 of its firmware has.

**The gyro bias goes to register 84, on both generations, and to no other.** Register 84 is
``out = C (in - B)`` at the sensor, acts at once, on every output, and can be read back and taken
back. Registers 43 and 74 only hold where the attitude filter starts its own bias estimate after a
power-up; writing the same bias there too would have it corrected twice until the filter notices.
VNSGB copies the filter's estimate, not ours.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.vn100.messages import SYNC, encode, packet_size
from drivers.vn100.register_codec import (
    OUT_OF_RANGE,
    TOO_FEW,
    TOO_MANY,
    Register,
    RegisterField,
    RegisterValueError,
    Values,
    as_stored_values,
    check_values,
    command_text,
    parse_values,
    reply_text,
    same_values,
)

__all__ = [
    "ASYNC_OUTPUT_RATES_HZ",
    "BINARY_OUTPUTS",
    "BINARY_OUTPUT_OFF",
    "COMPENSATING",
    "REGISTERS",
    "ROTATION",
    "SAMPLE_RATE_HZ",
    "SESSION_SETTINGS",
    "SUPPORTED_BAUD",
    "Profile",
    "Register",
    "RegisterField",
    "RegisterValueError",
    "Unit",
    "Values",
    "as_stored",
    "check",
    "format_command",
    "format_reply",
    "parse",
    "profile_of",
    "register_lines",
    "same",
]

# -- Words that the rows are written in ------------------------------------------------------------


ANGLE, QUATERNION = "%+08.3f", "%+09.6f"
MAG, ACCEL, GYRO = "%+08.4f", "%+07.3f", "%+010.6f"
TEMPERATURE, PRESSURE = "%+05.1f", "%+08.3f"


def u8(name: str, maximum: int | None = None, *, minimum: int = 0) -> RegisterField:
    """A byte within inclusive limits."""
    return RegisterField(name, "u8", minimum=minimum, maximum=maximum)


def choice(name: str, *allowed: int) -> RegisterField:
    """A byte that takes only these values."""
    return RegisterField(name, "u8", allowed=allowed)


def f32s(
    names: str, unit: str, printed: str = "", low: float | None = None, high: float | None = None
) -> tuple[RegisterField, ...]:
    """One f32 per word of `names`."""
    return tuple(
        RegisterField(name, "f32", unit, low, high, printed=printed) for name in names.split()
    )


def xyz(quantity: str, unit: str, printed: str = "") -> tuple[RegisterField, ...]:
    """A vector in the sensor frame."""
    return f32s(f"{quantity}_x {quantity}_y {quantity}_z", unit, printed)


def compensation(unit: str) -> tuple[RegisterField, ...]:
    """Registers 23, 25, 84, 47: out = C (in - B), C row by row, then B."""
    return f32s("c00 c01 c02 c10 c11 c12 c20 c21 c22", "") + f32s("b0 b1 b2", unit)


YPR = f32s("yaw pitch roll", "deg", ANGLE)
QTN = f32s("quat_x quat_y quat_z quat_w", "", QUATERNION)
MAG3 = xyz("mag", "gauss", MAG)
ACC3 = xyz("accel", "m/s^2", ACCEL)
GYR3 = xyz("gyro", "rad/s", GYRO)
PORT = RegisterField("port", "u8", minimum=1, maximum=2, optional=True)
VPE_TUNING = f32s(
    "base_x base_y base_z adaptive_x adaptive_y adaptive_z filtering_x filtering_y filtering_z",
    "",
    low=0.0,
    high=10.0,
)
IDENTITY: Values = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
NO_COMPENSATION: Values = (*IDENTITY, 0.0, 0.0, 0.0)
FILTER_INTERNALS = "filter internals of old firmware"


def always(*values: float | int | str) -> dict[int, Values]:
    """Factory values that both firmware generations share."""
    return {2: values, 3: values}


def opaque(
    number: int, name: str, generations: tuple[int, ...], why: str, values: Values = ()
) -> Register:
    """A register of which the manual prints no fields: read as text, never written.

    values: what the emulator answers where the number of values is known
    """
    return Register(
        number,
        name,
        "RW",
        (),
        "not printed",
        dict.fromkeys(generations, values) if values else {},
        generations=generations,
        opaque=True,
        keep_off=why,
        unconfirmed="fields and values",
    )


# -- Rows of the system module and of the measurements ---------------------------------------------


SAMPLE_RATE_HZ = 800  # what the rate divisor of registers 75 to 77 divides
SUPPORTED_BAUD = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)
ASYNC_OUTPUT_TYPES = (0, 1, 2, 8, 10, 11, 12, 13, 14, 16, 17, 19, 30, 34)  # 34: firmware 3 only
ASYNC_OUTPUT_RATES_HZ = (0, 1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
BINARY_OUTPUTS = (75, 76, 77)
SESSION_SETTINGS = (*BINARY_OUTPUTS, 7, 6)  # in the order in which `restore` puts them back
BINARY_OUTPUT_OFF: Values = (0, 1, 0)


def check_binary_output(values: Values) -> None:
    """Registers 75 to 77: one field word per set group bit, and only fields of known length.

    A VN-100 takes fields of other models too and sends zeros for them: drivers ask it for these.
    """
    groups, words = int(values[2]), [int(w) for w in values[3:]]
    needed, extended = groups.bit_count(), sum(word >> 15 for word in words)
    if len(words) - extended != needed:
        raise RegisterValueError(
            f"binary output: groups {groups:02X} need {needed} field words, not "
            f"{len(words) - extended}",
            TOO_FEW if len(words) - extended < needed else TOO_MANY,
        )
    if not words:
        return
    header = struct.pack(f"<BB{len(words)}H", SYNC, groups & 0xFF, *words)
    if groups > 0x7F or not packet_size(header):
        raise RegisterValueError(
            f"binary output: groups {groups:02X}, fields {' '.join(f'{w:04X}' for w in words)}: "
            "a field of unknown length, or a group without fields",
            OUT_OF_RANGE,
        )


def _binary_output(number: int) -> Register:
    return Register(
        BINARY_OUTPUTS[number - 1],
        f"Binary Output Register {number}",
        "RW",
        (
            RegisterField("async_mode", "u16", minimum=0, maximum=3),
            RegisterField("rate_divisor", "u16"),
            RegisterField("groups", "hex8"),
            RegisterField("field_word", "hex16"),
        ),
        "System Module",
        always(*BINARY_OUTPUT_OFF),
        repeated=True,
        check=check_binary_output,
    )


SYSTEM_ROWS = (
    Register(
        0,
        "User Tag",
        "RW",
        (RegisterField("tag", "string", maximum=20),),
        "System Module",
        always(""),
    ),
    Register(
        1,
        "Model Number",
        "R",
        (RegisterField("model", "string", maximum=24),),
        "System Module",
        always("VN-100S-CR"),
    ),
    Register(
        2,
        "Hardware Revision",
        "R",
        (RegisterField("revision", "u32"), RegisterField("minor", "u32", optional=True)),
        "System Module",
        unconfirmed="the minor revision of firmware 3",
    ),
    Register(
        3, "Serial Number", "R", (RegisterField("serial", "u32", printed="%010d"),), "System Module"
    ),
    Register(
        4,
        "Firmware Version",
        "R",
        (RegisterField("version", "string", maximum=24),),
        "System Module",
        {2: ("2.1.0.0",), 3: ("3.1.0.0",)},
    ),
    Register(
        5,
        "Serial Baud Rate",
        "RW",
        (RegisterField("baud", "u32", "Bd", allowed=SUPPORTED_BAUD), PORT),
        "System Module",
        always(115200),
    ),
    Register(
        6,
        "Async Data Output Type",
        "RW",
        (RegisterField("ador", "u32", allowed=ASYNC_OUTPUT_TYPES), PORT),
        "System Module",
        always(14),
    ),
    Register(
        7,
        "Async Data Output Frequency",
        "RW",
        (RegisterField("adof", "u32", "Hz", allowed=ASYNC_OUTPUT_RATES_HZ), PORT),
        "System Module",
        always(40),
    ),
    Register(
        30,
        "Communication Protocol Control",
        "RW",
        (
            u8("serial_count", 3),
            u8("serial_status", 1),
            u8("spi_count", 3),
            u8("spi_status", 1),
            choice("serial_checksum", 1, 3),
            choice("spi_checksum", 0, 1, 3),
            u8("error_mode", 2),
        ),
        "System Module",
        always(0, 0, 0, 0, 1, 0, 1),
    ),
    Register(
        32,
        "Synchronization Control",
        "RW",
        (
            choice("sync_in_mode", 0, 3, 4, 5, 6),
            u8("sync_in_edge", 1),
            RegisterField("sync_in_skip", "u16"),
            RegisterField("reserved_0", "u32"),
            u8("sync_out_mode", 3),
            u8("sync_out_polarity", 1),
            RegisterField("sync_out_skip", "u16"),
            RegisterField("sync_out_pulse_width", "u32", "ns"),
            RegisterField("reserved_1", "u32"),
        ),
        "System Module",
        always(3, 0, 0, 0, 3, 0, 0, 500000, 0),
        unconfirmed="factory values: one sensor's",
    ),
    Register(
        33,
        "Synchronization Status",
        "R",
        (
            RegisterField("sync_in_count", "u32"),
            RegisterField("sync_in_time", "u32", "us"),
            RegisterField("sync_out_count", "u32"),
        ),
        "System Module",
        always(0, 0, 0),
        unconfirmed="the unit of sync_in_time",
    ),
    _binary_output(1),
    _binary_output(2),
    _binary_output(3),
    opaque(
        206,
        "Legacy Compatibility Settings",
        (3,),
        "not documented for the VN-100",
        ("0", "0", "0", "0"),
    ),
    Register(
        227,
        "IMU Rate Configuration",
        "RW",
        (
            RegisterField("imu_rate", "u16", "Hz"),
            RegisterField("nav_divisor", "u16"),
            *f32s("filter_target_rate filter_min_rate", "Hz"),
        ),
        "IMU Subsystem",
        always(800, 2, 200.0, 100.0),
        keep_off="it changes the sampling of the filter that steers",
        unconfirmed="fields and values: one sensor's",
    ),
)

MEASUREMENT_ROWS = (
    Register(8, "Yaw Pitch Roll", "R", YPR, "Attitude Subsystem"),
    Register(9, "Attitude Quaternion", "R", QTN, "Attitude Subsystem"),
    Register(
        15,
        "Quaternion, Magnetic, Acceleration and Angular Rates",
        "R",
        QTN + MAG3 + ACC3 + GYR3,
        "Attitude Subsystem",
    ),
    Register(17, "Magnetic Measurements", "R", MAG3, "IMU Subsystem"),
    Register(18, "Acceleration Measurements", "R", ACC3, "IMU Subsystem"),
    Register(19, "Angular Rate Measurements", "R", GYR3, "IMU Subsystem"),
    Register(
        20, "Magnetic, Acceleration and Angular Rates", "R", MAG3 + ACC3 + GYR3, "IMU Subsystem"
    ),
    Register(
        27,
        "Yaw, Pitch, Roll, Magnetic, Acceleration, and Angular Rates",
        "R",
        YPR + MAG3 + ACC3 + GYR3,
        "Attitude Subsystem",
    ),
    Register(
        54,
        "IMU Measurements",
        "R",
        xyz("uncomp_mag", "gauss", MAG)
        + xyz("uncomp_accel", "m/s^2", ACCEL)
        + xyz("uncomp_gyro", "rad/s", GYRO)
        + f32s("temperature", "degC", TEMPERATURE)
        + f32s("pressure", "kPa", PRESSURE),
        "IMU Subsystem",
    ),
    Register(
        80,
        "Delta Theta and Delta Velocity",
        "R",
        f32s("delta_time", "s", QUATERNION)
        + xyz("delta_theta", "deg", ANGLE)
        + xyz("delta_velocity", "m/s", ANGLE),
        "IMU Subsystem",
    ),
    Register(
        115,
        "Heave",
        "R",
        f32s("heave rate delayed", ""),
        "not printed",
        generations=(3,),
        unconfirmed="on a VN-100",
    ),
    Register(
        239,
        "Yaw, Pitch, Roll, True Body Acceleration, and Angular Rates",
        "R",
        YPR + xyz("linear_accel_b", "m/s^2", ACCEL) + GYR3,
        "Attitude Subsystem",
    ),
    Register(
        240,
        "Yaw, Pitch, Roll, True Inertial Acceleration, and Angular Rates",
        "R",
        YPR + xyz("linear_accel_n", "m/s^2", ACCEL) + GYR3,
        "Attitude Subsystem",
    ),
)


# -- The other rows, and the map -------------------------------------------------------------------


ORTHONORMAL_WITHIN = 1e-5  # register 26: what the device still accepts

ROTATION = 26  # acts only once it was saved and the device has restarted
COMPENSATING = (23, 25, ROTATION, 44, 84)  # what the device computes of a reading depends on them


def check_rotation(values: Values) -> None:
    """Register 26 must be a right-handed rotation; the device answers 07 to anything else."""
    m = [float(v) for v in values]
    rows = [m[0:3], m[3:6], m[6:9]]
    for i in range(3):
        for j in range(i, 3):
            product = sum(a * b for a, b in zip(rows[i], rows[j], strict=True))
            if abs(product - (i == j)) > ORTHONORMAL_WITHIN:
                raise RegisterValueError(
                    f"register 26: rows {i} and {j} have the product {product:.6f}, an "
                    f"orthonormal matrix has {int(i == j)} within {ORTHONORMAL_WITHIN}",
                    OUT_OF_RANGE,
                )
    if (
        m[0] * (m[4] * m[8] - m[5] * m[7])
        - m[1] * (m[3] * m[8] - m[5] * m[6])
        + m[2] * (m[3] * m[7] - m[4] * m[6])
        < 0
    ):
        raise RegisterValueError(
            "register 26: the matrix is left-handed (it mirrors)", OUT_OF_RANGE
        )


CONFIGURATION_ROWS = (
    Register(
        21,
        "Magnetic and Gravity Reference Vectors",
        "RW",
        f32s("mag_ref_n mag_ref_e mag_ref_d", "gauss")
        + f32s("gravity_ref_n gravity_ref_e gravity_ref_d", "m/s^2"),
        "Attitude Subsystem",
        {2: (1.0, 0.0, 1.8, 0.0, 0.0, -9.79375), 3: (0.234, 0.0, 0.4212, 0.0, 0.0, -9.79375)},
        unconfirmed="factory values: one sensor of each generation",
    ),
    *(
        opaque(number, "Filter internals", (2,), FILTER_INTERNALS)
        for number in (22, 24, 34, 37, 39, 40)
    ),
    Register(
        23,
        "Magnetometer Calibration",
        "RW",
        compensation("gauss"),
        "IMU Subsystem",
        always(*NO_COMPENSATION),
    ),
    Register(
        25,
        "Acceleration Calibration",
        "RW",
        compensation("m/s^2"),
        "IMU Subsystem",
        always(*NO_COMPENSATION),
    ),
    Register(
        26,
        "Reference Frame Rotation",
        "RW",
        f32s("r00 r01 r02 r10 r11 r12 r20 r21 r22", "", low=-1.0, high=1.0),
        "IMU Subsystem",
        always(*IDENTITY),
        check=check_rotation,
    ),
    Register(
        35,
        "VPE Basic Control",
        "RW",
        (u8("enable", 1), u8("heading_mode", 2), u8("filtering_mode", 1), u8("tuning_mode", 1)),
        "Attitude Subsystem",
        always(1, 1, 1, 1),
        unconfirmed="factory values: the manual's examples",
    ),
    Register(
        36,
        "VPE Magnetometer Basic Tuning",
        "RW",
        VPE_TUNING,
        "Attitude Subsystem",
        always(4.0, 4.0, 4.0, 5.0, 5.0, 5.0, 5.5, 5.5, 5.5),
        unconfirmed="factory values: the manual's examples",
    ),
    Register(
        38,
        "VPE Accelerometer Basic Tuning",
        "RW",
        VPE_TUNING,
        "Attitude Subsystem",
        always(6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 5.0, 5.0, 5.0),
        unconfirmed="factory values: one sensor's",
    ),
    Register(
        43,
        "Filter Startup Gyro Bias",
        "RW",
        xyz("gyro_bias", "rad/s"),
        "Attitude Subsystem",
        {3: (0.0, 0.0, 0.0)},
        generations=(3,),
    ),
    Register(
        44,
        "Real-Time Hard/Soft Iron Estimator Control",
        "RW",
        (u8("mode", 2), u8("output", 3, minimum=1), u8("converge_rate", 5, minimum=1)),
        "Hard/Soft Iron Estimator Subsystem",
        {2: (1, 3, 5), 3: (0, 1, 5)},
    ),
    Register(46, "HSI Status", "R", (), "not printed", generations=(2,), opaque=True),
    Register(
        47,
        "Real-Time HSI Calibration",
        "R",
        compensation("gauss"),
        "Hard/Soft Iron Estimator Subsystem",
        always(*NO_COMPENSATION),
    ),
    Register(
        48,
        "Indoor Heading Mode Control",
        "RW",
        (*f32s("max_rate_error", ""), u8("reserved")),
        "Attitude Subsystem",
        always(0.5, 0),
        unconfirmed="factory values",
    ),
    Register(
        50,
        "Velocity Aiding Measurement",
        "RW",
        xyz("velocity_b", "m/s"),
        "Velocity Aiding",
        always(0.0, 0.0, 0.0),
    ),
    Register(
        51,
        "Velocity Aiding Control",
        "RW",
        (u8("mode", 1), *f32s("velocity_tuning rate_tuning", "")),
        "Velocity Aiding",
        always(1, 0.1, 0.01),
    ),
    Register(
        74,
        "Startup Filter Bias Estimate",
        "RW",
        xyz("gyro_bias", "rad/s") + xyz("accel_bias", "m/s^2") + f32s("pressure_bias", "kPa"),
        "Attitude Subsystem",
        {2: (0.0,) * 7},
        generations=(2,),
    ),
    Register(
        82,
        "Delta Theta and Delta Velocity Configuration",
        "RW",
        (
            u8("integration_frame", 1),
            u8("gyro_compensation", 1),
            u8("accel_compensation", 3),
            u8("earth_rate_correction", 1),
            RegisterField("reserved", "u16"),
        ),
        "IMU Subsystem",
        always(0, 0, 0, 0, 0),
    ),
    Register(
        83,
        "Reference Vector Configuration",
        "RW",
        (
            u8("use_mag_model", 1),
            u8("use_gravity_model", 1),
            u8("reserved_0"),
            u8("reserved_1"),
            RegisterField("recalc_threshold", "u32", "m"),
            RegisterField("year", "f32", "a", printed="%.3f"),
            RegisterField("latitude", "f64", "deg", -90.0, 90.0, printed="%+012.8f"),
            RegisterField("longitude", "f64", "deg", -180.0, 180.0, printed="%+013.8f"),
            RegisterField("altitude", "f64", "m", printed="%+010.3f"),
        ),
        "World Magnetic & Gravity Module",
        always(0, 0, 0, 0, 1000, 0.0, 0.0, 0.0, 0.0),
    ),
    Register(
        84,
        "Gyro Calibration",
        "RW",
        compensation("rad/s"),
        "IMU Subsystem",
        always(*NO_COMPENSATION),
    ),
    Register(
        85,
        "IMU Filtering Configuration",
        "RW",
        (
            *(
                RegisterField(f"{name}_window", "u16", "samples")
                for name in ("mag", "accel", "gyro", "temperature", "pressure")
            ),
            *(
                u8(f"{name}_mode", 3)
                for name in ("mag", "accel", "gyro", "temperature", "pressure")
            ),
        ),
        "IMU Subsystem",
        always(0, 4, 4, 4, 0, 0, 3, 3, 3, 0),
        unconfirmed="factory values: one sensor's",
    ),
    opaque(116, "Heave Control", (3,), "not documented for the VN-100", ("0",) * 7),
)

REGISTERS: dict[int, Register] = {
    row.id: row
    for row in sorted(SYSTEM_ROWS + MEASUREMENT_ROWS + CONFIGURATION_ROWS, key=lambda row: row.id)
}


def parse(register_id: int, tokens: Sequence[str]) -> Values:
    """The values of a reply's or a command's tokens behind the register number.

    Raises RegisterValueError (a ValueError with the VNERR code in `code`), naming field and token.
    """
    return parse_values(_row(register_id), tokens)


def check(register_id: int, values: Values) -> None:
    """Raises RegisterValueError where the device would refuse `values`; ranges included."""
    check_values(_row(register_id), values)


def format_command(register_id: int, values: Values, *, held: bool = False) -> str:
    """``NN,value,...`` to write behind ``VNWRG,``: fixed point, no exponent, f32 round-trip.

    held: the device itself held the values; then what the manual allows is not asked.
    Raises RegisterValueError for values, registers or lengths that the device would refuse.
    """
    return command_text(_row(register_id), values, held=held)


def format_reply(register_id: int, values: Values) -> str:
    """``NN,value,...`` as the device prints it behind ``VNRRG,`` or ``VNWRG,``."""
    return reply_text(_row(register_id), values)


def same(register_id: int, sent: Values, read_back: Values) -> bool:
    """True where a device that holds `sent` prints `read_back`; NaN is never the same."""
    return same_values(_row(register_id), sent, read_back)


def register_lines(values: Mapping[int, Values]) -> tuple[str, ...]:
    """`$VNWRG,23,...*XX`: what is sent, and what a person may type into a terminal."""
    return tuple(
        encode(f"VNWRG,{format_command(number, as_stored(number, values[number]), held=True)}")
        .decode()
        .strip()
        for number in sorted(values)
    )


def as_stored(register_id: int, values: Values) -> Values:
    """`values` as the device would hold them: f32, numerical dust below 1e-12 set to zero."""
    return as_stored_values(_row(register_id), values)


def _row(register_id: int) -> Register:
    row = REGISTERS.get(register_id)
    if row is None:
        raise RegisterValueError(f"the VN-100 has no register {register_id}", 0x08)
    return row


# -- Firmware generations, and one device among all ------------------------------------------------


_VN100 = re.compile(r"VN-?100(?![0-9])", re.IGNORECASE)
_VERSION = re.compile(r"([0-9]{1,3})(?:\.([0-9]{1,5}))?(?:\.([0-9]{1,5}))?(?:\.([0-9]{1,5}))?")


@dataclass(frozen=True, slots=True)
class Profile:
    """One firmware generation.

    generation:     2 or 3; 0 where the firmware is unknown
    version:        as register 4 says it
    writable:       false for unknown firmware and other models: observe only
    startup_bias:   register that VNSGB fills, None where unknown
    tare:           whether VNTAR exists
    observed_for:   why nothing may be changed, for a person; empty where it may
    """

    generation: int
    version: str
    writable: bool
    startup_bias: int | None
    tare: bool
    observed_for: str = ""

    def observed(self, why: str) -> Profile:
        """The same where nothing may be changed, for one reason more."""
        reasons = f"{self.observed_for}; {why}" if self.observed_for else why
        return replace(self, writable=False, observed_for=reasons)

    def has(self, register_id: int) -> bool:
        """Whether this firmware has the register; for unknown firmware, whether any has it."""
        row = REGISTERS.get(register_id)
        if row is None:
            return False
        return self.generation == 0 or self.generation in row.generations

    @property
    def registers(self) -> tuple[int, ...]:
        """Numbers of all registers of this firmware, ascending."""
        return tuple(number for number in REGISTERS if self.has(number))

    def default(self, register_id: int) -> Values | None:
        """The factory value, None where each unit has its own or it is not documented."""
        return REGISTERS[register_id].defaults.get(self.generation)


def profile_of(version: str, model: str = "VN-100") -> Profile:
    """The profile of a device from what registers 4 and 1 say: ``3.1.0.0``, ``VN-100S-CR``."""
    match = _VERSION.fullmatch(version.strip())
    generation = int(match[1]) if match else 0
    if generation == 2:
        profile = Profile(2, version, True, 74, True)
    elif generation == 3:
        profile = Profile(3, version, True, 43, False)
    else:
        why = f"firmware {version} is unknown (known are 2.x and 3.x)"
        profile = Profile(0, version, False, None, False, why)
    if _VN100.match(model.strip()):
        return profile
    return profile.observed(f"the model is {model or 'not said'}, and only a VN-100 is written")


@dataclass(frozen=True, slots=True)
class Unit:
    """One device and no other, from registers 1, 3 and 4."""

    model: str
    serial: int
    firmware: str

    def __str__(self) -> str:
        return f"{self.model} serial {self.serial} firmware {self.firmware}"
