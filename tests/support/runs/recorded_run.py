"""A `VirtualRun` whose inputs and bytes go into a capture, and what a later run is told of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from virtual_run import VirtualRun

from ahrsd import inputs
from ahrsd.config.config import check_config, core_settings, print_config
from ahrsd.recording.capture import CaptureWriter
from ahrsd.recording.earlier_run import earlier_inputs
from ahrsd.writeback.journal_history import Stamp
from drivers.vn100.emulator.emulator import Emulator

LIMIT_S = 1800.0


class RecordedRun(VirtualRun):
    """See the module. `begin` opens a capture, as each start of the program does."""

    def __init__(self, emulator: Emulator, folder: Path, **tables: Any) -> None:
        self.folder, self.writer = folder, None
        self.config = check_config(tables, "test")
        self.folder.mkdir(exist_ok=True)
        self.captures = 0
        self.begin()
        super().__init__(emulator, core_settings(self.config), listen=self._heard)

    def begin(self) -> None:
        self.captures += 1
        self.path = self.folder / f"ahrsd-2026110{self.captures}T120000Z.mcap"
        header = {"program": "ahrsd run", "config": print_config(self.config)}
        self.writer = CaptureWriter(self.path, header)
        self.qualified_s: float | None = None

    def _heard(self, event: object) -> None:
        if getattr(event, "new", "") == "QUALIFIED" and self.qualified_s is None:
            self.qualified_s = self.now_s

    def feed(self, item: inputs.Input) -> None:
        waiting = [item]
        while waiting:
            one = waiting.pop(0)
            self.writer.write(one)
            for event in self.core.handle(one):
                self.listen(event)
                self._carry_out(event, waiting)

    def _send(self, data: bytes) -> None:
        self.writer.write_sent(self.now_ns, data)
        super()._send(data)

    @property
    def stamp(self) -> Stamp:
        return Stamp(self.wall_s + self.now_s, self.boot_id, self.now_s - self.boot_began_s)

    def earlier(self, limit_s: float = LIMIT_S) -> list[Any]:
        rate_hz = self.config.estimator.step_rate_hz
        return earlier_inputs(self.folder, self.path, self.stamp, limit_s, rate_hz)

    def again(self, away_s: float = 2.0, *, tell: bool = True) -> None:
        """The program is started again, `away_s` later."""
        self.writer.close()
        self.emulator.advance(self.now_s + away_s)
        self.now_s += away_s
        self.begin()
        self.began_s = self.now_s
        self.restart()
        for item in self.earlier() if tell else ():
            self.feed(item)
