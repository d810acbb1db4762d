"""`ahrsd run` as a program on a scripted device on a pty, with the observer beside it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import TracebackType

import numpy as np
from patience import PATIENCE_S
from scripted_vn100 import Cable, Iron, Motion, Served, Unit, Vehicle
from write_observer import Observer

SUPPORT = Path(__file__).parent
PROJECT = SUPPORT.parents[2]
SERIAL = 100130608
OUTPUT = {
    "binary": {6: "0", 7: "40", 75: "1,20,06,0001,083F"},
    "imu": {6: "19", 7: "40"},
}
IRON = Iron(
    hard_gauss=np.array([0.05, -0.03, 0.04]), gyro_bias_rad_s=np.array([0.01, -0.02, 0.005])
)
OTHER = Iron(
    hard_gauss=np.array([-0.04, 0.06, 0.01]), gyro_bias_rad_s=np.array([-0.01, 0.01, 0.015])
)
CONFIG = """
state_directory = "{state}"
mode = "commit"
[device]
port = "{port}"
baud = 115200
[interlock]
file = "{interlock}"
[write_back]
approval = "{approval}"
armed_at_start = true
commit_unattended = true
[gates]
max_step_auto_deg = 180.0
max_step_operator_deg = 180.0
[trial]
duration_s = {trial_s}
interlock = {trial_interlock}
turns = 100.0
[still]
duration_s = 1.0
[budget]
min_interval_s = 0.0
cooldown_s = 0.0
ram_writes_per_day = 1000
flash_writes_per_day = 100
rollbacks_to_lock = 100
{more}
"""


class Program:
    """`with Program(folder) as program:` serves the device; `start` starts the daemon.

    word:   what the vehicle says ("safe"); None: it says nothing any more
    approval, trial_s, trial_interlock, more: for the configuration
    """

    def __init__(
        self, folder: Path, *, stream: str = "binary", approval: str = "auto",
        trial_s: float = 2.0, trial_interlock: bool = True, more: str = "",
    ) -> None:  # fmt: skip
        self.folder, self.state = folder, folder / "state"
        self.state.mkdir(exist_ok=True)
        self.interlock, self.offset = folder / "interlock", folder / "wall-offset"
        self.vehicle = Vehicle(Motion(2.5, 3.5))
        self.stream = stream
        self.unit = Unit(SERIAL, IRON, self.vehicle, boot_s=-20.0, presets=OUTPUT[stream])
        self.cable = Cable(self.unit)
        self.served = Served(self.cable, folder / "vn100")
        self.observer = Observer(self.cable)
        self.word: str | None = "safe"
        self.log = folder / "log"
        self.log.touch()
        self.set_wall(0.0)
        self.process: subprocess.Popen[bytes] | None = None
        self.records: list[tuple[int, str, dict[str, object]]] = []
        self._read: dict[Path, int] = {}
        self._config = {"approval": approval, "trial_s": trial_s, "more": more}
        self._config["trial_interlock"] = str(trial_interlock).lower()
        self._ending = threading.Event()
        self._saying = threading.Thread(target=self._say, name="vehicle")

    def __enter__(self) -> Program:
        self.served.__enter__()
        self._saying.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.kill()
        self._ending.set()
        self._saying.join()
        self.served.__exit__(kind, error, trace)

    def _say(self) -> None:
        """The vehicle: its word, ten times a second, where a word can be put."""
        while not self._ending.wait(0.1):
            if self.word is not None:
                draft = self.folder / "interlock.new"
                draft.write_text(self.word)
                at_s = time.time() + float(
                    self.offset.read_text() or 0.0
                )  # one computer, one clock
                os.utime(draft, (at_s, at_s))
                draft.rename(self.interlock)

    def set_wall(self, ahead_s: float) -> None:
        """Let the computer's wall clock be ahead by so much, at once."""
        draft = self.folder / "wall-offset.new"
        draft.write_text(str(ahead_s))
        draft.rename(self.offset)

    # -- the program -------------------------------------------------------------------------------

    @property
    def config(self) -> Path:
        """The configuration, written anew."""
        path = self.folder / "ahrsd.toml"
        path.write_text(
            CONFIG.format(
                state=self.state, port=self.folder / "vn100", interlock=self.interlock,
                **self._config,
            )
        )  # fmt: skip
        return path

    def command(self, *arguments: object) -> list[str]:
        """The program with these arguments."""
        return [
            sys.executable,
            str(SUPPORT / "run_fitted.py"),
            str(self.offset),
            *map(str, arguments),
        ]

    def start(self, *options: str, umask: int = -1, user: int | None = None) -> None:
        """Begin a run; its log goes on in the same file."""
        paths = [str(SUPPORT), str(PROJECT), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                self.command("-v", "run", "--wait", "--config", self.config, *options),
                stdout=log, stderr=log, umask=umask, user=user, env=environment, cwd=self.folder,
            )  # fmt: skip

    def kill(self) -> None:
        """kill -9."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
        self.process = None

    def stop(self, limit_s: float = PATIENCE_S) -> int:
        """SIGTERM; the exit code."""
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(limit_s)

    def ask(self, *arguments: object, umask: int = -1) -> subprocess.CompletedProcess[str]:
        """Another command of the program."""
        return subprocess.run(
            [sys.executable, "-m", "ahrsd", *map(str, arguments)],
            capture_output=True, text=True, timeout=PATIENCE_S, check=False, umask=umask,
            env={**os.environ, "PYTHONPATH": str(PROJECT)},
        )  # fmt: skip

    def operate(self, verb: str, text: str = "", *, umask: int = -1) -> int:
        """`ahrsd operator`."""
        done = self.ask("operator", verb, text, "--state-directory", self.state, umask=umask)
        return done.returncode

    # -- what is seen ------------------------------------------------------------------------------

    @property
    def said(self) -> str:
        """The log."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    @property
    def kinds(self) -> list[str]:
        """Records of all journals, as they were found."""
        return [kind for _, kind, _ in self.records]

    def candidate(self) -> str:
        """The id of the newest candidate."""
        return self.said.rsplit("candidate ", 1)[1][:8]

    def look(self) -> None:
        """Tell the observer what is new; the device stands still meanwhile."""
        self.served.act(lambda cable, now_s: self._look(now_s))

    def _look(self, now_s: float) -> None:
        for line in self._news(self.log):
            self.observer.announced(line, now_s)
        begun_s = time.time() - now_s
        found = []
        for path in sorted(self.state.glob("journal-*.jsonl")):
            serial = int(path.stem.split("-")[1])
            found += [(serial, json.loads(line)) for line in self._news(path)]
        for serial, facts in sorted(found, key=lambda one: one[1]["time"]):
            at_s = datetime.fromisoformat(facts["time"]).timestamp() - begun_s
            self.records.append((serial, facts["kind"], facts))
            self.observer.record(serial, facts["kind"], facts, at_s)
        self.observer.look(now_s)

    def _news(self, path: Path) -> list[str]:
        """Whole lines since the last time."""
        if not path.is_file():
            return []
        with path.open("rb") as file:
            file.seek(self._read.get(path, 0))
            data = file.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._read[path] = self._read.get(path, 0) + len(whole)
        return whole.decode("utf-8", "replace").splitlines()

    def until(
        self, condition: Callable[[], object], *, limit_s: float = PATIENCE_S, alive: bool = True
    ) -> None:
        """Wait for it."""
        end = time.monotonic() + limit_s
        while True:
            self.look()
            if condition():
                return
            assert self.process is None or not alive or self.process.poll() is None, self.said[
                -3000:
            ]
            assert time.monotonic() < end, self.said[-3000:]
            time.sleep(0.03)

    def for_s(self, seconds: float) -> None:
        """Let so much time pass."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.look()
            time.sleep(0.03)

    def until_record(self, kind: str, limit_s: float = PATIENCE_S) -> None:
        """Wait for a record in a journal."""
        self.until(lambda: kind in self.kinds, limit_s=limit_s)

    def swap(self, *, silent_s: float = 2.0) -> Unit:
        """Unit 555 takes over the cable; its time runs on ahead."""
        other = Unit(555, OTHER, self.vehicle, boot_s=-40.0, presets=OUTPUT[self.stream])
        self.served.act(lambda cable, now_s: cable.exchange(other, now_s, silent_s=silent_s))
        return other

    def writes(self, serial: int) -> list[str]:
        """What the daemon wrote to registers 23 and 84 of a unit."""
        log = self.cable.units[serial].log
        return [
            f"{c.register}: {c.after}" for c in list(log)
            if c.what == "write" and c.who == "host" and c.register in (23, 84)
        ]  # fmt: skip
