"""The emulated VN-100's registers: RAM that acts, flash that survives, factory values behind both.

Everything comes from the register map (`registers`): which registers a firmware has, their factory
values, their ranges. Registers 5, 6 and 7 exist once per serial port. Register 26 acts only from
the next start: what was in flash when the device started is latched (vn100-protocol 4.5).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.vn100.emulator.chain import ChainSettings, OnBoardHsi, affine
from drivers.vn100.emulator.physics import Array
from drivers.vn100.register_codec import Register, RegisterValueError, Values, float32
from drivers.vn100.registers import REGISTERS, check, parse

PER_PORT = (5, 6, 7)
PORTS = (1, 2)
MEASUREMENTS = (8, 9, 15, 17, 18, 19, 20, 27, 33, 47, 54, 80, 115, 239, 240)
INVALID_PARAMETER, INVALID_REGISTER, UNAUTHORIZED = 0x07, 0x08, 0x09

Key = tuple[int, int]  # register, port (0 where there is one for both)


def _refuse(message: str, code: int) -> RegisterValueError:
    return RegisterValueError(message, code)


class Memory:
    """The register file of one unit.

    firmware: version as register 4 prints it; "2..." is generation 2, all else generation 3
    """

    def __init__(self, firmware: str, serial: int) -> None:
        self.generation = 2 if firmware.startswith("2") else 3
        self._identity: dict[int, Values] = {2: (8,), 3: (serial,), 4: (firmware,)}
        self.flash = self._factory()
        self.ram: dict[Key, Values] = {}
        self.start()

    def _factory(self) -> dict[Key, Values]:
        values: dict[Key, Values] = {}
        for number, row in REGISTERS.items():
            if self.generation not in row.generations or number in MEASUREMENTS:
                continue
            default = row.defaults.get(self.generation, ("0",))  # opaque ones print something
            for port in PORTS if number in PER_PORT else (0,):
                values[number, port] = self._identity.get(number, default)
        return values

    def start(self) -> None:
        """Power-up or reset: RAM from flash."""
        self.ram = dict(self.flash)
        self.rotation = np.array(self.ram[26, 0], dtype=np.float64).reshape(3, 3)

    def save(self) -> None:
        """What VNWNV does, all of RAM."""
        self.flash = dict(self.ram)

    def save_torn(self) -> None:
        """A save that ended half way: the lower half of the registers is new, the rest factory."""
        keys = sorted(self.ram)
        factory = self._factory()
        whole = keys[: len(keys) // 2]
        self.flash = {key: self.ram[key] if key in whole else factory[key] for key in keys}

    def restore_factory(self) -> None:
        """What VNRFS does, both sets."""
        self.flash = self._factory()
        self.start()

    def preset(self, register: int, values: Sequence[float | int | str]) -> None:
        """Put values into RAM and flash, as somebody did long ago."""
        stored = self.stored(register, tuple(values))
        for port in PORTS if register in PER_PORT else (0,):
            self.ram[register, port] = self.flash[register, port] = stored
        self.start()

    def row(self, register: int) -> Register:
        """The register's row. Raises RegisterValueError with code 08 where there is none."""
        row = REGISTERS.get(register)
        if row is None or self.generation not in row.generations:
            raise _refuse(f"no register {register}", INVALID_REGISTER)
        return row

    def get(self, register: int, port: int = 0) -> Values:
        """Values of a register in RAM; `port` matters for 5, 6, 7 only."""
        return self.ram[register, port if register in PER_PORT else 0]

    def number(self, register: int, port: int = 0) -> int:
        """The first value, of a register that begins with an integer."""
        return int(self.get(register, port)[0])

    def parsed(self, register: int, tokens: Sequence[str]) -> Values:
        """The values that a VNWRG wants to store, as the device rounds them.

        Raises RegisterValueError with the VNERR code. Exponents are refused: whether the real
        device takes them is not known, and a host should not try.
        """
        row = self.row(register)
        if row.access == "R":
            raise _refuse(f"register {register} is read only", UNAUTHORIZED)
        for field, token in zip(row.fields, tokens, strict=False):
            if field.kind in ("f32", "f64") and "e" in token.lower():
                raise _refuse(f"register {register}: exponent in {token}", INVALID_PARAMETER)
        values = parse(register, tokens)
        if not row.opaque:
            check(register, values)
        only_3 = (register, values[:1]) in ((6, (34,)), (7, (0,)))
        if only_3 and self.generation == 2:
            raise _refuse(f"register {register}: {values[0]} is new in 3.x", INVALID_PARAMETER)
        return self.stored(register, values)

    def stored(self, register: int, values: Values) -> Values:
        """`values` as f32 where the register holds f32."""
        row = self.row(register)
        if row.opaque:
            return values
        kinds = [field.kind for field in row.fields]
        kinds += kinds[-1:] * (len(values) - len(kinds))
        return tuple(
            float32(float(value)) if kind == "f32" else value
            for value, kind in zip(values, kinds, strict=False)
        )

    def settings(self, hsi: OnBoardHsi, heading_frozen: bool) -> ChainSettings:
        """What of it the compensation chain needs."""
        filtering = [int(value) for value in self.get(85)]
        window, mode = filtering[0], filtering[5]
        return ChainSettings(
            mag=self._affine(23),
            accel=self._affine(25),
            gyro=self._affine(84),
            rotation=self.rotation,
            hsi=(hsi.matrix, hsi.offset) if self.get(44)[1] == 3 else None,
            mag_reference=np.array(self.get(21)[:3], dtype=np.float64),
            windows=(window if mode in (1, 3) else 0, window if mode in (2, 3) else 0),
            heading_frozen=heading_frozen,
        )

    def startup_bias(self) -> Array:
        """The filter's gyro bias at the start, rad/s: register 43 (3.x) or 74 (2.x)."""
        return np.array(self.get(self.bias_register)[:3], dtype=np.float64)

    @property
    def bias_register(self) -> int:
        """Where VNSGB puts the filter's gyro bias."""
        return 74 if self.generation == 2 else 43

    def _affine(self, register: int) -> tuple[Array, Array]:
        return affine(tuple(float(value) for value in self.get(register)))
