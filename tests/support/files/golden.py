"""The golden replays: streams of our own emulated device, and what a replay must find in each.

    python tests/support/files/golden.py           streams that are missing, every decision anew
    python tests/support/files/golden.py --streams every stream anew, too

A stream is made once, in virtual time; `STREAMS` says how. `fixtures/replays/golden.toml` has, for
each, counts, the gates that are red at the end, the estimate, and the hash of all decisions, which
are the same on every processor (`ahrsd.core.decision_log`). The bytes of a stream are of one
arithmetic: libraries and processors differ in the last digit of a sine. `arithmetic()` names the
one on which
they were made; on another they are not compared byte by byte (tests/offline/test_golden.py).
"""

from __future__ import annotations

import gzip
import hashlib
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.linalg
from streams import emitted

from ahrsd.config.config import Config
from ahrsd.core.core import Core
from ahrsd.offline.replay import replay
from drivers.vn100.emulator.scenarios import Setup, build

FOLDER = Path(__file__).parents[3] / "fixtures" / "replays"
TABLE = FOLDER / "golden.toml"


@dataclass(frozen=True)
class Golden:
    """How a stream is made. `commands`: when, and the body of a command to the device."""

    setup: Setup
    seconds: float = 25.0
    commands: Sequence[tuple[float, str]] = ()


def _binary(scenario: str, seed: int, *faults: str, motion: str = "") -> Golden:
    setup = Setup(scenario, seed, faults, output="binary", rate_hz=20, motion=motion)
    return Golden(setup, 45.0)


def _ascii(scenario: str, seed: int, *faults: str, output: str = "ascii") -> Golden:
    return Golden(Setup(scenario, seed, faults, output=output))


STREAMS: dict[str, Golden] = {
    # as it should be
    "clean_tumble_binary": _binary("tumble", 21),
    "clean_tumble_vnymr": _ascii("tumble", 22),
    "clean_tumble_vnimu": _ascii("tumble", 23, output="imu"),
    "clean_rov_binary": _binary("rov", 24),
    "clean_rov_vnimu": _ascii("rov", 25, output="imu"),
    "clean_static": _binary("static", 26),
    "clean_planar": _binary("planar", 27),
    "clean_wide": _binary("wam", 28, motion="wam-rov"),
    "clean_narrow": _binary("lam", 29),
    "clean_calibrated": _binary("calibrated", 30),
    "clean_100hz": Golden(Setup("tumble", 31, output="binary", rate_hz=100, baud=230400), 20.0),
    "clean_10hz": Golden(Setup("tumble", 32, output="binary", rate_hz=10), 60.0),
    "firmware_2_hsi": _binary("hsi-active", 33),
    "unknown_firmware": _binary("unknown-firmware", 34),
    # what goes wrong on the way
    "fault_byte_drop": _binary("tumble", 41, "byte_drop=0.0005"),
    "fault_bit_flip": _ascii("tumble", 42, "bit_flip=0.0004"),
    "fault_noise_insert": _binary("tumble", 43, "noise_insert=0.03"),
    "fault_false_header": _binary("tumble", 44, "false_header=0.05"),
    "fault_garbage": _ascii("tumble", 45, "garbage=0.5@8+4", output="imu"),
    "fault_duplicate": _binary("tumble", 46, "duplicate=0.1"),
    "fault_intermittent": _binary("tumble", 47, "intermittent=0.1"),
    "fault_mute": _binary("tumble", 48, "mute@9+3"),
    "fault_wrong_rate": _ascii("tumble", 49, "baud_mismatch@6+3"),
    # what goes wrong with the device and around it
    "fault_reset": _binary("tumble", 51, "reset@12"),
    "fault_power_cut": _ascii("tumble", 52, "power_cut@10+2", output="imu"),
    "fault_clock_step": _binary("tumble", 53, "clock_step=2@13"),
    "fault_clock_wrap": _binary("tumble", 54, "clock_wrap@14"),
    "fault_stuck": _binary("tumble", 55, "stuck@12+5"),
    "fault_magnet": _binary("tumble", 56, "dipole=6@12+5"),
    "fault_iron": _binary("tumble", 57, "iron_step=0.1@13"),
    "fault_third_party": _binary("tumble", 58, "third_party_change=23@12"),
    "fault_layout_switch": Golden(
        Setup("tumble", 59), 25.0, [(5.0, "VNWRG,06,0"), (5.5, "VNWRG,75,1,20,06,0001,083F")]
    ),
}


def path_of(name: str) -> Path:
    """The file of a stream."""
    return FOLDER / f"{name}.vnraw.gz"


def make_stream(name: str) -> None:
    """Write one stream; the same bytes whenever it is made."""
    golden = STREAMS[name]
    data = emitted(build(golden.setup), golden.seconds, golden.commands)
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb", mtime=0, filename="") as file:
        file.write(data)
    path_of(name).write_bytes(out.getvalue())


def arithmetic() -> str:
    """A name for how this machine and these libraries round: the hash of a few hard sums."""
    grid = np.arange(1.0, 145.0).reshape(12, 12)
    matrix = np.sin(grid) + 12.0 * np.eye(12)
    spread = matrix @ matrix.T
    found = (
        spread,
        np.linalg.inv(matrix),
        np.linalg.eigvalsh(spread),
        scipy.linalg.cho_solve(scipy.linalg.cho_factor(spread), grid),
        np.linalg.svd(np.cos(grid[:, :5]))[0],
        np.exp(np.sin(grid) / 3.0).sum(axis=0),
        np.linalg.lstsq(np.vander(np.linspace(0.1, 1.1, 40), 7), np.cos(np.arange(40.0)))[0],
    )
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(one).tobytes() for one in found))
    return digest.hexdigest()[:16]


def found_in(name: str) -> dict[str, object]:
    """What a replay of a stream finds."""
    return facts_of(replay(path_of(name), Config()).core)


def facts_of(core: Core) -> dict[str, object]:
    """Counts, gates and estimate at the end, and the hash of the way there."""
    counters, estimate = core.device_session.session.deframer.counters, core.calibrator.estimate
    numbers: dict[str, object] = {}
    if estimate is not None:
        numbers = {
            "converged": estimate.converged,
            "hard_iron_gauss": [float(f"{v:.7f}") for v in estimate.hard_iron_gauss],
            "gyro_bias_rad_s": [float(f"{v:.8f}") for v in estimate.gyro_bias_rad_s],
        }
    return {
        "valid": counters.valid,
        "rejected": counters.rejected,
        "samples": core.stream.facts.samples,
        "gaps": core.stream.all_gaps.count,
        "restarts": core.stream.restarts,
        "state": core.writeback.state.value,
        "decisions": core.decisions.count,
        "red": [gate.gate for gate in core.calibrator.gates if not gate.ok],
        **numbers,
        "sha256": core.decisions.sha256,
    }


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(_toml(one) for one in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def main(arguments: Sequence[str]) -> None:
    """Write streams and table."""
    lines = [
        "# Written by tests/support/files/golden.py, which says what is in here; not by hand.",
        f'arithmetic = "{arithmetic()}"',
    ]
    for name in STREAMS:
        if "--streams" in arguments or not path_of(name).exists():
            make_stream(name)
        facts = found_in(name)
        lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in facts.items())]
        print(name, facts["samples"], facts["decisions"], facts["sha256"])
    TABLE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
