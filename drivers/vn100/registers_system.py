"""Rows of the register map: the system module (0 to 7, 30 to 33, 75 to 77) and the measurements.

Source: VN-100 user manual UM001, "System Module" and the measurement pages of each subsystem.
"""

from __future__ import annotations

import struct

from drivers.vn100.binary import SYNC, packet_size
from drivers.vn100.register_codec import (
    OUT_OF_RANGE,
    TOO_FEW,
    TOO_MANY,
    Register,
    RegisterField,
    RegisterValueError,
    Values,
)
from drivers.vn100.register_fields import (
    ACC3,
    ACCEL,
    ANGLE,
    GYR3,
    GYRO,
    MAG,
    MAG3,
    PORT,
    PRESSURE,
    QTN,
    QUATERNION,
    TEMPERATURE,
    YPR,
    always,
    choice,
    f32s,
    opaque,
    u8,
    xyz,
)

SAMPLE_RATE_HZ = 800  # what the rate divisor of registers 75 to 77 divides
SUPPORTED_BAUD = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)
ASYNC_OUTPUT_TYPES = (0, 1, 2, 8, 10, 11, 12, 13, 14, 16, 17, 19, 30, 34)  # 34: firmware 3 only
ASYNC_OUTPUT_RATES_HZ = (0, 1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
BINARY_OUTPUTS = (75, 76, 77)
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
