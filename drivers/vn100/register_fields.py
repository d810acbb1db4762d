"""Words that the rows of the register map are written in: field shapes, units, printed formats."""

from __future__ import annotations

from drivers.vn100.register_codec import Register, RegisterField, Values

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
