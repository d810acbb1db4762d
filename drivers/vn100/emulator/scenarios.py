"""Emulated devices by name: what is hidden in them, how they move, what goes wrong.

device = build(Setup("rov", seed=3))
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.physics import (
    TICK_HZ,
    EmulatedTruth,
    Further,
    Motion,
    draw_truth,
    make_motion,
)
from drivers.vn100.emulator.streams import fits
from drivers.vn100.registers import ASYNC_OUTPUT_RATES_HZ

Values = tuple[float | int | str, ...]

FIRMWARES = {"2": "2.1.0.0", "3": "3.1.0.0"}
_VERSION = re.compile(r"\d{1,3}(\.\d{1,3}){3}")  # as register 4 prints it
CALIBRATION_SET = (0x06, 0x0001, 0x083F)  # TimeStartup; ImuStatus, Uncomp* , Temp, Pres, SensSat


@dataclass(frozen=True, slots=True)
class Scenario:
    """A row of the table.

    motion: a name of `MOTIONS`;  firmware: as register 4 prints it;  faults: schedules
    calibrated: registers 23 and 84 already hold the truth
    """

    description: str
    motion: str
    firmware: str = FIRMWARES["3"]
    faults: tuple[str, ...] = ()
    calibrated: bool = False


SCENARIOS: dict[str, Scenario] = {
    "rov": Scenario("an ROV surveys, then works; hidden iron and gyro bias", "survey"),
    "static": Scenario("a vehicle at rest: nothing can be learnt", "static"),
    "planar": Scenario("a car: headings only, no roll or pitch", "planar"),
    "tumble": Scenario("the sensor turned over and over by hand", "tumble"),
    "wam": Scenario("wide angular motion of the simulated experiment", "wam"),
    "mam": Scenario("medium angular motion of the simulated experiment", "mam"),
    "lam": Scenario("low angular motion of the simulated experiment", "lam"),
    "magnet-passing": Scenario(
        "as rov, and magnets are carried past every minute and a half",
        "survey",
        faults=tuple(f"dipole=5@{start}+5" for start in range(60, 3600, 90)),
    ),
    "hsi-active": Scenario(
        "as rov on firmware 2.1, whose on-board compensation runs and is applied",
        "survey",
        FIRMWARES["2"],
    ),
    "calibrated": Scenario("as rov, with the right registers in flash", "survey", calibrated=True),
    "unknown-firmware": Scenario("as rov, with a firmware nobody knows", "survey", "7.0.0.0"),
}


@dataclass(frozen=True, slots=True)
class Setup:
    """What to emulate.

    seed:     chooses truth, motion, noise and the dice of the faults
    faults:   schedules beyond the scenario's own
    motion:   a name of `MOTIONS`, or names with seconds; "" for the scenario's
    firmware: "2", "3" or a version; "" for the scenario's
    output:   "ascii" (VNYMR), "imu" (VNIMU) or "binary" (calibration set of vn100-protocol 9)
    rate_hz:  of that output; for binary a divisor of 800
    baud:     register 5 of both ports
    """

    scenario: str = "rov"
    seed: int = 0
    faults: tuple[str, ...] = ()
    firmware: str = ""
    output: str = "ascii"
    rate_hz: int = 40
    baud: int = 115200
    port: int = 1
    motion: str | tuple[tuple[str, float], ...] = ""


def hidden(setup: Setup) -> tuple[Scenario, EmulatedTruth, Motion]:
    """The scenario, its hidden truth and its motion.  ValueError for a name that there is not."""
    scenario = SCENARIOS.get(setup.scenario)
    if scenario is None:
        raise ValueError(f"no scenario {setup.scenario!r}; there are {', '.join(SCENARIOS)}")
    motion = make_motion(setup.motion or scenario.motion, setup.seed)
    return scenario, draw_truth(setup.seed), motion


def build(setup: Setup, further: Further | None = None) -> Emulator:
    """The emulated device, with further physics where the caller has some.

    Raises ValueError naming what is wrong and what there is.
    """
    scenario, truth, motion = hidden(setup)
    presets = dict(_outputs(setup))
    if scenario.calibrated:
        presets.update(calibration_registers(truth))
    firmware = FIRMWARES.get(setup.firmware, setup.firmware) or scenario.firmware
    if not _VERSION.fullmatch(firmware):
        known = " or ".join(FIRMWARES)
        raise ValueError(f"no firmware {firmware!r}: {known}, or a version such as 3.0.0.0")
    device = Emulator(
        truth,
        motion,
        firmware,
        setup.seed,
        faults=(*scenario.faults, *setup.faults),
        port=setup.port,
        presets=presets,
        further=further,
    )
    if not fits(device.memory, 5, setup.port, (setup.baud,)):
        raise ValueError(
            f"{setup.output} output at {setup.rate_hz} Hz does not fit {setup.baud} Bd; "
            "lower --rate or raise --baud"
        )
    return device


def calibration_registers(truth: EmulatedTruth) -> dict[int, Values]:
    """Registers 23 and 84 as a perfect calibration would write them."""
    matrix = np.linalg.inv(truth.soft_iron)
    return {
        23: (*matrix.ravel().tolist(), *truth.hard_iron_gauss.tolist()),
        84: (*np.eye(3).ravel().tolist(), *truth.gyro_bias_rad_s.tolist()),
    }


def _outputs(setup: Setup) -> Mapping[int, Values]:
    """Registers 5, 6, 7 and 75 for the wanted output."""
    rate = setup.rate_hz
    if setup.output == "binary":
        if rate < 1 or TICK_HZ % rate:
            raise ValueError(f"binary output at {rate} Hz: the rate must divide {TICK_HZ}")
        return {
            5: (setup.baud,),
            6: (0,),
            75: (setup.port, TICK_HZ // rate, *CALIBRATION_SET),
        }
    messages = {"ascii": 14, "imu": 19}
    if setup.output not in messages:
        raise ValueError(f"no output {setup.output!r}; there are ascii, imu and binary")
    if rate not in ASYNC_OUTPUT_RATES_HZ[1:]:
        there = ", ".join(map(str, ASYNC_OUTPUT_RATES_HZ[1:]))
        raise ValueError(f"{setup.output} output at {rate} Hz: register 7 has {there} Hz")
    return {5: (setup.baud,), 6: (messages[setup.output],), 7: (rate,)}
