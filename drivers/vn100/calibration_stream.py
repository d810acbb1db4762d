"""Setting up the stream that a calibration wants, on the port in use and on no other.

The packet is ``FA 06 0001 083F``: TimeStartup; ImuStatus, UncompMag, UncompAccel, UncompGyro, Temp,
Pres, SensSat, 64 bytes. Firmware that refuses SensSat gets ``003F``, 62 bytes.

A device has two serial ports, and something that steers may listen on the other one. Registers 75
to 77 name the port, so first the own port is found: register 6 without a port parameter acts on the
port in use; after writing 0 to it, the port whose register 6 reads 0 is ours (where both do, 1 is
written for a moment). Where firmware does not tell the ports apart, the usual way remains: try
port 1, and if 300 ms are silent, port 2. Outputs that also or only go to the other port keep going
there, unchanged. Where the packet does not come from the register that is free, it gets that of an
output that goes to both ports, which goes on to the other port from the free one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.vn100.commands import (
    NoReply,
    Pause,
    Procedure,
    SessionError,
    differences,
    quiet,
    read,
    read_registers,
    restore,
    write_verified,
)
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.registers import (
    BINARY_OUTPUT_OFF,
    BINARY_OUTPUTS,
    SAMPLE_RATE_HZ,
    SESSION_SETTINGS,
    Values,
    same,
)

GROUPS, TIME_WORD = 0x06, 0x0001
IMU_WORD, IMU_WORD_WITHOUT_SATURATION = 0x083F, 0x003F
PACKET_BYTES = 64
INVALID_PARAMETER = 0x07
LISTEN_S = 0.3
_OTHER_PORT = {1: 2, 2: 1}  # the values are bits of AsyncMode


class DoesNotFit(ValueError):
    """The stream that was asked for is impossible; the text says what would be possible."""


class NotPutBack(SessionError):
    """The set-up failed, and so did putting back what it had changed: the device has neither."""


class NoStream(SessionError):
    """Nothing arrived although the output was set up, or there is no output to set up."""


@dataclass(frozen=True, slots=True)
class CalibrationStream:
    """What was set up: register 75, 76 or 77, its values, and the rate."""

    output: int
    values: Values
    rate_hz: float

    def __str__(self) -> str:
        return f"register {self.output}, {self.layout} at {self.rate_hz:g} Hz"

    @property
    def layout(self) -> str:
        """Name of the layout of its packets."""
        return f"FA {GROUPS:02X} {TIME_WORD:04X} {self.values[4]:04X}"


def rate_divisor(rate_hz: float, baud: int) -> int:
    """Divisor of 800 Hz for `rate_hz`, after the device's own check that the output fits.

    The check (deduced from observations): bytes per second at most baud / 10. Raises DoesNotFit.
    """
    divisor = round(SAMPLE_RATE_HZ / rate_hz) if rate_hz > 0 else 0
    if not divisor or abs(SAMPLE_RATE_HZ / divisor - rate_hz) > 1e-6 * rate_hz:
        raise DoesNotFit(
            f"{rate_hz} Hz is not {SAMPLE_RATE_HZ} Hz over a whole number; possible are "
            "800, 400, 200, 160, 100, 80, 50, 40, 20, 10 ..."
        )
    needed, available = PACKET_BYTES * SAMPLE_RATE_HZ / divisor, baud / 10
    if needed > available:
        raise DoesNotFit(
            f"{rate_hz:g} Hz needs {needed:.0f} bytes/s, {baud} baud carry {available:.0f}: ask "
            f"for at most {available / PACKET_BYTES:.0f} Hz or use a faster port"
        )
    return divisor


def configure_stream(
    rate_hz: float, baud: int, users: Mapping[int, Values] | None = None
) -> Procedure[CalibrationStream]:
    """Stream the calibration packet at `rate_hz` on the port in use, in RAM; ASCII output off.

    Changes registers 6 and 75 to 77, all of `registers.SESSION_SETTINGS`; puts them back itself
    where it fails. Raises DoesNotFit before anything is sent, NoStream, DeviceRefused, NoReply, and
    NotPutBack.

    users: the outputs as the user has them, where an earlier session may have left others in the
           device; these are put back first. Without, what the device holds is the user's.
    """
    divisor = rate_divisor(rate_hz, baud)
    present = yield from quiet(read_registers((6, *BINARY_OUTPUTS)))
    saved = {**present, **(users or {})}
    try:
        if differences({n: saved[n] for n in present}, present):
            yield from quiet(restore(saved, SESSION_SETTINGS))
        port = yield from quiet(_silence_and_find_port())
        ports = (port,) if port else (1, 2)
        tries = [(candidate, False) for candidate in ports]
        tries += [(candidate, True) for candidate in ports if _shared(saved)]
        for candidate, move in tries:
            stream = yield from quiet(_set_up(saved, candidate, divisor, move))
            heard = yield Pause(max(LISTEN_S, 3 * divisor / SAMPLE_RATE_HZ))
            if stream.layout in heard.tokens:
                return stream
            yield from quiet(restore(saved, BINARY_OUTPUTS))
    except (DeviceRefused, SessionError) as error:
        yield from _put_back(saved, error)
        raise
    nothing = NoStream("the calibration packets were set up on the port, but none arrived")
    yield from _put_back(saved, nothing)
    raise nothing


def left_by_session(register: int, outputs: Mapping[int, Values], present: Values) -> bool:
    """Whether `present` is what `configure_stream` leaves in a register of a user with `outputs`.

    At its end, or where it was broken off half way. The user's own value is none of its.
    """
    users = outputs[register]
    if same(register, users, present):
        return False
    if register == 6:
        return int(present[0]) == 0 or (int(present[0]) == 1 and int(users[0]) == 0)
    if register not in BINARY_OUTPUTS:
        return False
    if same(register, BINARY_OUTPUT_OFF, present):
        return True
    mode, other = int(present[0]), int(users[0]) & ~int(present[0])
    if mode in _OTHER_PORT and other and same(register, (mode, *users[1:]), present):
        return True  # taken off one port, kept on the other
    for number in _shared(outputs):
        if mode in _OTHER_PORT and same(register, (mode, *outputs[number][1:]), present):
            return True  # moved here, kept on the other port
    words = tuple(int(value) for value in present[2:])
    packets = [(GROUPS, TIME_WORD, word) for word in (IMU_WORD, IMU_WORD_WITHOUT_SATURATION)]
    return mode in _OTHER_PORT and words in packets


def _put_back(saved: Mapping[int, Values], cause: Exception) -> Procedure[None]:
    """The settings as they were; NotPutBack where that is refused or gets no answer either."""
    try:
        yield from quiet(restore(saved, SESSION_SETTINGS))
    except (DeviceRefused, SessionError) as error:
        raise NotPutBack(f"{cause}; {error}") from cause


def _silence_and_find_port() -> Procedure[int | None]:
    """ASCII output of the port in use off; which port that is, None where it cannot be told.

    Called with the output paused, so the type that is set for the second look is never sent.
    """
    yield from write_verified(6, (0,))
    port = yield from _only_port_with_type(0)
    if port is None:
        yield from write_verified(6, (1,))
        port = yield from _only_port_with_type(1)
        yield from write_verified(6, (0,))
    return port


def _only_port_with_type(output_type: int) -> Procedure[int | None]:
    """The port of which register 6 reads `output_type`, where it is one of the two."""
    found = []
    for port in (1, 2):
        try:
            values = yield from read(6, port)
        except (DeviceRefused, NoReply):
            return None
        if values[0] == output_type:
            found.append(port)
    return found[0] if len(found) == 1 else None


def _shared(outputs: Mapping[int, Values]) -> list[int]:
    """Registers of binary outputs that go to both ports."""
    return [n for n in BINARY_OUTPUTS if n in outputs and int(outputs[n][0]) == 3]


def _set_up(
    saved: dict[int, Values], port: int, divisor: int, move: bool
) -> Procedure[CalibrationStream]:
    """The packet on `port` in the first output register that the other port does not use.

    move: in the first one that both ports use, whose output moves to that register
    """
    other = _OTHER_PORT[port]
    free = [number for number in BINARY_OUTPUTS if not int(saved[number][0]) & other]
    if not free:
        raise NoStream("the device's other port uses all three binary outputs (75, 76, 77)")
    for number in BINARY_OUTPUTS:
        mode = int(saved[number][0])
        if mode & port:
            rest = BINARY_OUTPUT_OFF if mode == port else (other, *saved[number][1:])
            yield from write_verified(number, rest, held=True)
    own = free[0]
    if move:
        own = _shared(saved)[0]
        yield from write_verified(free[0], (other, *saved[own][1:]), held=True)
    for word in (IMU_WORD, IMU_WORD_WITHOUT_SATURATION):
        values = (port, divisor, GROUPS, TIME_WORD, word)
        try:
            yield from write_verified(own, values)
        except DeviceRefused as error:
            if error.code != INVALID_PARAMETER or word == IMU_WORD_WITHOUT_SATURATION:
                raise
        else:
            break
    return CalibrationStream(own, values, SAMPLE_RATE_HZ / divisor)
