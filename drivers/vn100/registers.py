"""VN-100 register map: one row per register, and the functions that take a register's number.

Source: VN-100 user manual UM001, the chapter named in each row (section), for firmware 2.x and 3.x.
The default values of registers 32, 36, 38, 48 and 85 are one sensor's dump or the manual's
examples, not confirmed factory values; those of register 50 are "no aiding".

Commands and replies, as the device speaks them::

    $VNWRG,23,1.02,0.01,...*6F   format_command(23, values), written behind "VNWRG,"
    $VNRRG,23,1.02,0.01,...      format_reply(23, values), printed behind "VNRRG," or "VNWRG,"
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.vn100.register_codec import (
    OUT_OF_RANGE,
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
from drivers.vn100.register_fields import (
    FILTER_INTERNALS,
    IDENTITY,
    NO_COMPENSATION,
    VPE_TUNING,
    always,
    compensation,
    f32s,
    opaque,
    u8,
    xyz,
)
from drivers.vn100.registers_system import (
    ASYNC_OUTPUT_RATES_HZ,
    BINARY_OUTPUT_OFF,
    BINARY_OUTPUTS,
    MEASUREMENT_ROWS,
    SAMPLE_RATE_HZ,
    SUPPORTED_BAUD,
    SYSTEM_ROWS,
)

__all__ = [
    "ASYNC_OUTPUT_RATES_HZ",
    "BINARY_OUTPUTS",
    "BINARY_OUTPUT_OFF",
    "COMPENSATING",
    "REGISTERS",
    "SAMPLE_RATE_HZ",
    "SUPPORTED_BAUD",
    "Register",
    "RegisterField",
    "RegisterValueError",
    "Values",
    "as_stored",
    "check",
    "format_command",
    "format_reply",
    "parse",
    "same",
]

ORTHONORMAL_WITHIN = 1e-5  # register 26: what the device still accepts

COMPENSATING = (23, 25, 26, 44, 84)  # what the device computes of a reading depends on them


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


def as_stored(register_id: int, values: Values) -> Values:
    """`values` as the device would hold them: f32, numerical dust below 1e-12 set to zero."""
    return as_stored_values(_row(register_id), values)


def _row(register_id: int) -> Register:
    row = REGISTERS.get(register_id)
    if row is None:
        raise RegisterValueError(f"the VN-100 has no register {register_id}", 0x08)
    return row
