"""`ahrsd emulate`: an emulated VN-100 on a pseudo-terminal, for trying things without hardware.

`EmulatedEffects` are effects of the diagnosis's library in the device's sensors, along its own
motion, for as long as it runs.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from ahrsd import so3
from ahrsd.errors import AhrsdError
from ahrsd.samples import Array
from drivers.vn100.emulator.physics import GRAVITY_M_S2, matrices, quaternions
from drivers.vn100.emulator.scenarios import Setup, hidden

if TYPE_CHECKING:
    from ahrsd.diagnosis.effects.base import Readings
    from drivers.vn100.emulator.emulator import Emulator

# -- Effects of the diagnosis's library ------------------------------------------------------------


RATE_HZ = 100.0
PIECE_S = 300.0
WARM_UP_S = 120.0  # what an effect with a memory has seen before a piece begins
HORIZON_S = 3600.0  # made-up columns repeat after it; onsets and spans refer to it
_COLUMNS_HZ = 20.0


class EmulatedEffects:
    """What the effects add to the device's sensors, as a function of its time.

    Worked out at 100 Hz in pieces of five minutes, straight in between; before time 0 it is as at
    time 0.  The device sends no further columns, so an effect of a current is one that nobody
    logged; the temperature is the device's own.
    Raises ValueError in one line for an effect that is not additive or a request that cannot be.
    """

    def __init__(self, setup: Setup, wanted: Sequence[str]) -> None:
        from ahrsd.diagnosis.effects import profiles, request
        from ahrsd.diagnosis.effects.library import EFFECTS

        _, self._truth, self._motion = hidden(setup)
        requests = [request.parse(text) for text in wanted]
        for one in requests:
            if one.effect.kind != "mean" or one.effect.after_noise:
                known = ", ".join(
                    e.identifier for e in EFFECTS.values() if e.kind == "mean" and not e.after_noise
                )
                raise ValueError(
                    f"{one.effect.identifier} cannot be emulated; there are {known}, and faults"
                )
        grid = np.arange(0.0, HORIZON_S, 1.0 / _COLUMNS_HZ)
        self._columns = profiles.columns_for([one.effect for one in requests], grid, setup.seed)
        whole = self._readings(np.arange(0.0, HORIZON_S, 1.0))
        self._terms = tuple(one.term(whole) for one in requests)
        self._pieces: dict[int, tuple[Array, Array, Array]] = {}

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Field (gauss) and rate (rad/s), (N, 3) each, that add at the instants (N,)."""
        asked = np.maximum(time_s, 0.0)
        mag, gyro = np.zeros((len(asked), 3)), np.zeros((len(asked), 3))
        number = (asked // PIECE_S).astype(int)
        for piece in np.unique(number).tolist():
            rows = number == piece
            known_s, of_mag, of_gyro = self._piece(piece)
            for axis in range(3):
                mag[rows, axis] = np.interp(asked[rows], known_s, of_mag[:, axis])
                gyro[rows, axis] = np.interp(asked[rows], known_s, of_gyro[:, axis])
        return mag, gyro

    def _piece(self, number: int) -> tuple[Array, Array, Array]:
        from ahrsd.diagnosis.forward import simulated

        if number not in self._pieces:
            start = max(number * PIECE_S - WARM_UP_S, 0.0)
            rows = round(((number + 1) * PIECE_S - start) * RATE_HZ) + 1
            clean = self._readings(start + np.arange(rows) / RATE_HZ)
            made = simulated(clean, self._terms)
            self._pieces = {
                **{k: v for k, v in self._pieces.items() if k >= number - 1},
                number: (
                    clean.time_s,
                    made.mag_b_gauss - clean.mag_b_gauss,
                    made.gyro_b_rad_s - clean.gyro_b_rad_s,
                ),
            }
        return self._pieces[number]

    def _readings(self, time_s: Array) -> Readings:
        """The device's noise-free readings at instants (N,) of one step."""
        from ahrsd.diagnosis.effects.base import Readings

        truth, step_s = self._truth, float(time_s[1] - time_s[0])
        R_nb = matrices(quaternions(self._motion.angles(time_s)))
        before = matrices(quaternions(self._motion.angles(time_s - step_s)))
        rate = so3.log(np.swapaxes(before, 1, 2) @ R_nb) / step_s
        field_b = np.einsum("nji,j->ni", R_nb, truth.field_n_gauss)
        return Readings(
            time_s=time_s,
            dt_s=np.concatenate([[np.nan], np.diff(time_s)]),
            mag_b_gauss=field_b @ truth.soft_iron.T + truth.hard_iron_gauss,
            gyro_b_rad_s=rate + truth.gyro_bias_rad_s,
            accel_b_m_s2=-GRAVITY_M_S2 * R_nb[:, 2, :],
            rate_b_rad_s=rate,
            field_b=field_b,
            R_nb=R_nb,
            soft_iron=truth.soft_iron,
            covariates=self._covariates(time_s),
        )

    def _covariates(self, time_s: Array) -> dict[str, Array]:
        grid = np.arange(0.0, HORIZON_S, 1.0 / _COLUMNS_HZ)
        lap_s = np.mod(time_s, HORIZON_S)
        out = {name: np.interp(lap_s, grid, values) for name, values in self._columns.items()}
        if "temperature_c" in out:
            warmth = 1 - np.exp(-time_s / 600.0)
            out["temperature_c"] = self._truth.temperature_c + self._truth.warming_c * warmth
        return out


# -- The command -----------------------------------------------------------------------------------


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
        return build(setup, EmulatedEffects(setup, effects))
    except ValueError as error:
        raise AhrsdError(str(error)) from None


@click.command()
@click.option("--link", type=click.Path(path_type=Path), help="Symbolic link to the pty.")
@click.option("--scenario", default="rov", show_default=True, help="What it is and how it moves.")
@click.option("--motion", default="", help="Another motion than the scenario's.")
@click.option("--seed", default=0, show_default=True, help="Chooses truth, motion and noise.")
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
    "--list", is_flag=True, is_eager=True, expose_value=False, callback=_list, help="What there is."
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
    except (ValueError, OSError) as error:
        raise AhrsdError(str(error)) from None
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.request_stop())
    click.echo(server.path)
    try:
        server.serve()
    finally:
        server.stop()


command = emulate
