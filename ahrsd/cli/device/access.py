"""How a command reaches the device: the port's rate, one open device, errors in our own words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from ahrsd.errors import EXIT_BUSY, EXIT_NO, EXIT_USAGE, DeviceError
from drivers.serial_port import (
    BaudNotFound,
    PortAbsent,
    PortBusy,
    PortError,
    PortForbidden,
    PortLost,
    SerialPort,
    find_device,
    spelled,
)
from drivers.vn100.commands import Command, Identity, identify, read_configuration
from drivers.vn100.device import Device, Tap, reads_only
from drivers.vn100.errors import DriverError
from drivers.vn100.registers import Values
from drivers.vn100.session import ECHOES, Event, LineEchoes

_EXIT = dict.fromkeys((PortAbsent, PortBusy, PortForbidden, BaudNotFound, PortLost), EXIT_BUSY)
# Whether it may be opened is for the driver to say: it knows the group that one must join.
PORT = click.Path(path_type=Path, readable=False)


@contextmanager
def driver_errors() -> Iterator[None]:
    """Errors of the driver as DeviceError: 75 busy or absent, 2 no usable port, 1 it said no."""
    try:
        yield
    except PortError as error:
        raise DeviceError(str(error), _EXIT.get(type(error), EXIT_USAGE)) from error
    except DriverError as error:
        raise DeviceError(str(error), EXIT_NO) from error


def open_port(path: Path, baud: int | None, *, may_query: bool) -> SerialPort:
    """The port at the given rate, or at the one that the device is heard at."""
    if baud is None:
        found = find_device(path, None, may_query=may_query)
        click.echo(f"{spelled(path)}: {found.why}", err=True)
        baud = found.baud
    return SerialPort(path, baud)


@contextmanager
def open_device(
    path: Path,
    baud: int | None,
    allow: Callable[[Command], bool] = reads_only,
    tap: Tap | None = None,
) -> Iterator[Device]:
    """A device that may be sent what `allow` lets through; its errors come as DeviceError."""
    with (
        driver_errors(),
        Device(open_port(path, baud, may_query=True), allow, tap, _print_line_remarks) as device,
    ):
        yield device


def _print_line_remarks(event: Event) -> None:
    """What a person should know of the line."""
    if isinstance(event, LineEchoes):
        click.echo(f"ahrsd: {ECHOES}", err=True)


def read_all(device: Device) -> tuple[Identity, dict[int, Values]]:
    """Who it is, and its configuration registers."""
    identity = device.run(identify())
    return identity, device.run(read_configuration(identity.profile))


def describe(identity: Identity) -> dict[str, str]:
    """Identity as text, for files."""
    return {
        "model": identity.model,
        "hardware": str(identity.hardware),
        "serial": str(identity.serial),
        "firmware": identity.firmware,
    }
