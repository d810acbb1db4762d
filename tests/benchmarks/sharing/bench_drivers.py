"""Drivers that start again and again on shared ports of a working daemon.

    python tests/benchmarks/sharing/bench_drivers.py [--seconds S] [--rate HZ] [--json FILE]

An emulated device, `ahrsd run` beside it, and two programs: one on the owner's port, which starts
as each of four real drivers in turn (drivers_at_start.py), and one on a second port
that asks who the device is and what it holds. Each asks again where no answer came within 50 ms.
Exit code 1 where a question was not answered, was answered wrongly, or an answer came to nothing
that was asked.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections import Counter
from pathlib import Path

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from drivers_at_start import (
    ARDUPILOT,
    NTNU_BEHIND_THE_RESET,
    NTNU_UP_TO_THE_RESET,
    ROS2_DAWONN,
    SDK,
)

from drivers.vn100.messages import encode

ANSWER = re.compile(rb"\$(VN(?:RRG|WRG|ERR|ASY|WNV|RST)[^*\r]*)\*..\r\n")
STARTS = {
    "dawonn": ROS2_DAWONN,
    "ntnu": (*NTNU_UP_TO_THE_RESET, *NTNU_BEHIND_THE_RESET),
    "sdk": SDK,
    "ardupilot": ARDUPILOT,
}
QUESTIONS = ("VNRRG,01", "VNRRG,02", "VNRRG,03", "VNRRG,04", "VNRRG,00", "VNRRG,23", "VNRRG,26")
AGAIN_S, PATIENCE_S = 0.05, 20.0


class Program:
    """One that asks, each question behind the answer to the one before.

    A question that was sent twice may be answered twice, as by a device; more answers than that, or
    one to nothing that this program sent, are wrong.
    """

    def __init__(self, port: Path) -> None:
        self.port = port
        self.seen: Counter[str] = Counter()
        self.wrong: list[str] = []
        self._open: Counter[str] = Counter()
        self._known: dict[str, str] = {}

    def starts(self, lines: tuple[str, ...]) -> None:
        """Open the port, ask everything, close it."""
        port = os.open(self.port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(port)
        try:
            for line in lines:
                self._ask(port, line)
        finally:
            os.close(port)
        self.seen["starts"] += 1

    def _ask(self, port: int, line: str) -> None:
        end_s, again_s, heard = time.monotonic() + PATIENCE_S, 0.0, b""
        self.seen["questions"] += 1
        while True:
            now_s = time.monotonic()
            if now_s > end_s:
                self.wrong.append(f"{line}: no answer in {PATIENCE_S:.0f} s")
                return
            if now_s >= again_s:
                os.write(port, encode(line))
                self._open[question(line)] += 1
                self.seen["sent"] += 1
                again_s = now_s + AGAIN_S
            if select.select([port], [], [], 0.005)[0]:
                heard += os.read(port, 65536)
            found = list(ANSWER.finditer(heard))
            answers = [one[1].decode() for one in found]
            for answer in answers:
                self._judge(answer)
            heard = heard[found[-1].end() :] if found else heard
            if any(question(answer) == question(line) for answer in answers):
                return

    def _judge(self, answer: str) -> None:
        self.seen["answers"] += 1
        asked = question(answer)
        if not self._open[asked]:
            self.wrong.append(f"nobody asked for {answer}")
        self._open[asked] -= 1
        if asked.startswith("VNRRG") and answer != self._known.setdefault(asked, answer):
            self.wrong.append(f"{answer}, before {self._known[asked]}")


def question(line: str) -> str:
    """What a line asks and an answer answers: the word, and the register of a read or a write."""
    word = line.split(",")[0]
    return line[:8] if word in ("VNRRG", "VNWRG") else word


def rounds(program: Program, starts: list[tuple[str, ...]], end_s: float) -> None:
    """One start behind the other until then."""
    number = 0
    while time.monotonic() < end_s and not program.wrong:
        program.starts(starts[number % len(starts)])
        number += 1


@contextlib.contextmanager
def running(command: list[str], log: Path):
    with log.open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "ahrsd", *command], stdout=said, stderr=said
        )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_S)


def wait_for(path: Path, log: Path) -> None:
    end_s = time.monotonic() + 60.0
    while not path.exists():
        if time.monotonic() > end_s:
            raise SystemExit(f"{path.name} is not there: {log.read_text()[-500:]}")
        time.sleep(0.1)


def measured(folder: Path, seconds: float, rate_hz: int) -> dict[str, object]:
    device, owner, logger = (folder / name for name in ("vn100", "owner", "logger"))
    config, log = folder / "ahrsd.toml", folder / "run.log"
    config.write_text(
        f'state_directory = "{folder}"\n[device]\nport = "{device}"\n'
        f'[[share]]\npty = "{owner}"\nowner = true\n[[share]]\npty = "{logger}"\n'
    )
    emulate = ["emulate", "--link", str(device), "--rate", str(rate_hz), "--output", "binary"]
    with running([*emulate, "--baud", "921600"], folder / "emulate.log"):
        wait_for(device, folder / "emulate.log")
        with running(["run", "--config", str(config)], log) as daemon:
            wait_for(logger, log)
            programs, begun_s = [Program(owner), Program(logger)], time.monotonic()
            plans = [list(STARTS.values()), [QUESTIONS]]
            threads = [
                threading.Thread(target=rounds, args=(program, plan, begun_s + seconds))
                for program, plan in zip(programs, plans, strict=True)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            alive, took_s = daemon.poll() is None, time.monotonic() - begun_s
    said = log.read_text()
    return {
        "seconds": round(took_s, 1),
        "rate_hz": rate_hz,
        "owner": dict(programs[0].seen),
        "logger": dict(programs[1].seen),
        "wrong": [*programs[0].wrong, *programs[1].wrong] + ([] if alive else [said[-500:]]),
        "errors_in_the_log": [line for line in said.splitlines() if "error" in line.lower()][:5],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=int, default=200, help="Hz")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ahrsd-drivers-") as folder:
        found = measured(Path(folder), options.seconds, options.rate)
    print(json.dumps(found, indent=2))
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=2) + "\n")
    return 1 if found["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
