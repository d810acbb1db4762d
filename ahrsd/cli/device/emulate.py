"""`ahrsd emulate`: an emulated VN-100 on a pseudo-terminal, for trying things without hardware."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.errors import AhrsdError

if TYPE_CHECKING:
    from drivers.vn100.emulator.emulator import Emulator
    from drivers.vn100.emulator.scenarios import Setup


def _list(_context: click.Context, _option: click.Parameter, wanted: bool) -> None:
    """Print scenarios and faults with their meaning, and end."""
    if not wanted:
        return
    from drivers.vn100.emulator.faults import FAULTS
    from drivers.vn100.emulator.scenarios import SCENARIOS

    click.echo("Scenarios")
    for name, scenario in SCENARIOS.items():
        click.echo(f"  {name:20} {scenario.description}")
    click.echo("Faults (name[=parameter][@start_s[+duration_s]])")
    for name, kind in FAULTS.items():
        default = f" [{kind.parameter:g} {kind.unit}]" if kind.unit else ""
        click.echo(f"  {name:20} {kind.description}{default}")
    raise SystemExit(0)


def _device(setup: Setup, effects: Sequence[str]) -> Emulator:
    from drivers.vn100.emulator.scenarios import build

    try:
        if not effects:
            return build(setup)
        from ahrsd.diagnosis.repaired_model.injection import EmulatedEffects

        return build(setup, EmulatedEffects(setup, effects))
    except ValueError as error:
        raise AhrsdError(str(error)) from None


@click.command()
@click.option("--link", type=click.Path(path_type=Path), help="Symbolic link to the pty.")
@click.option(
    "--scenario", default="rov", show_default=True, help="Which device, and how it moves."
)
@click.option("--motion", default="", help="Motion, instead of the scenario's.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Chooses truth, motion and noise.",
)
@click.option("--fault", "faults", multiple=True, help="name[=parameter][@start[+duration]].")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    help="ID[=STRENGTH] or ID=name=value,...; see docs/reference/effects.md.",
)
@click.option("--firmware", default="", help="2, 3 or a version such as 3.0.0.0.")
@click.option("--speed", default=1.0, show_default=True, help="Device seconds per second.")
@click.option("--rate", "rate_hz", default=40, show_default=True, help="Output rate, Hz.")
@click.option(
    "--output",
    type=click.Choice(["ascii", "imu", "binary"]),
    default="ascii",
    show_default=True,
    help="VNYMR, VNIMU or the binary calibration set.",
)
@click.option("--baud", default=115200, show_default=True, help="Register 5.")
@click.option("--port", default="1", type=click.Choice(["1", "2"]), help="The device's UART.")
@click.option("--lossless", is_flag=True, help="Device time waits for a slow reader.")
@click.option("--any-baud", is_flag=True, help="Do not garble bytes when the host's rate differs.")
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_list,
    help="List scenarios and faults.",
)
def emulate(
    link: Path | None,
    scenario: str,
    motion: str,
    seed: int,
    faults: tuple[str, ...],
    effects: tuple[str, ...],
    firmware: str,
    speed: float,
    rate_hz: int,
    output: str,
    baud: int,
    port: str,
    lossless: bool,
    any_baud: bool,
) -> None:
    """Serve an emulated VN-100 on a pseudo-terminal until interrupted.

    Prints the path to open on the first line, and what happens on stderr.
    """
    from drivers.vn100.emulator.pty import PtyEmulator
    from drivers.vn100.emulator.scenarios import Setup

    setup = Setup(scenario, seed, faults, firmware, output, rate_hz, baud, int(port), motion)
    try:
        server = PtyEmulator(
            _device(setup, effects),
            link=link,
            speed=speed,
            lossless=lossless,
            check_baud=not any_baud,
            report=lambda line: click.echo(line, err=True),
        )
    except FileExistsError as error:
        raise AhrsdError(str(error)) from None
    except OSError as error:
        what = "a pseudo-terminal" if link is None else f"--link {link}"
        raise AhrsdError(f"{what}: cannot be made: {error.strerror or error}") from None
    except ValueError as error:
        raise AhrsdError(str(error)) from None
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.request_stop())
    click.echo(server.path)
    try:
        server.serve()
    finally:
        server.stop()


command = emulate
