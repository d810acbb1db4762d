"""A core and an emulated device in one process and in virtual time: seconds cost milliseconds.

The world of `daemon` in a few lines: bytes both ways every `step_s`, a port that comes and goes
with the emulator's plug, a journal that always (or while `disk_full`, never) reaches the disk, and
a vehicle whose word is `safe`. Nothing sleeps: what hangs shows as virtual time without progress.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from ahrsd import events, inputs
from ahrsd.core.core import Core
from ahrsd.core.settings import CoreSettings
from drivers.vn100.emulator.emulator import Emulator

WALL_S = 1.8e9


class VirtualRun:
    """See the module. `listen` sees every event; `sent` counts commands by word and register."""

    def __init__(
        self,
        emulator: Emulator,
        settings: CoreSettings,
        step_s: float = 0.05,
        listen: Callable[[events.Event], None] = lambda _: None,
    ) -> None:
        self.emulator, self.step_s, self.listen = emulator, step_s, listen
        self.core = Core(settings)
        self.safe, self.disk_full, self.interlock_s = True, False, 0.25
        self.journal: dict[int, list[dict[str, object]]] = {}
        self.sent: Counter[str] = Counter()
        self.sent_bytes = 0
        self.notes: list[tuple[str, str]] = []
        self.states: list[str] = []
        self.samples = 0
        self.finished = False
        self.now_s, self.wall_s = 1.0, WALL_S
        self.boot_id, self.boot_began_s = "virtual boot", 0.0
        self._plugged = False
        self._serial = 0
        self._interlock_s = 0.0
        emulator.advance(self.now_s)
        self.tell_clocks()

    def tell_clocks(self) -> None:
        """The computer's other clocks, as they are now."""
        boot_s = self.now_s - self.boot_began_s
        self.feed(inputs.WallClock(self.now_ns, self.wall_s + self.now_s, self.boot_id, boot_s))

    @property
    def now_ns(self) -> int:
        return round(self.now_s * 1e9)

    def feed(self, item: inputs.Input) -> None:
        """One input, and whatever follows from it at once."""
        waiting = [item]
        while waiting:
            for event in self.core.handle(waiting.pop(0)):
                self.listen(event)
                self._carry_out(event, waiting)

    def _carry_out(self, event: events.Event, waiting: list[Any]) -> None:
        match event:
            case events.Send(data):
                self._send(data)
            case events.OpenJournal(serial):
                self._serial = serial
                records = list(self.journal.setdefault(serial, []))
                waiting.append(inputs.JournalOpened(self.now_ns, serial, records))
            case events.JournalAppend(kind, facts):
                error = "no space left" if self.disk_full else ""
                if self._serial not in self.journal:
                    error = "no journal is open"
                if not error:
                    self.journal[self._serial].append({"kind": kind, "facts": dict(facts)})
                waiting.append(inputs.Journalled(self.now_ns, kind, error))
            case events.SamplesSeen(block=block):
                self.samples += len(block)
            case events.Noted(level=level, text=text):
                self.notes.append((level, text))
            case events.StateChanged(new=new):
                self.states.append(new)
            case events.Finished():
                self.finished = True

    def _send(self, data: bytes) -> None:
        self.sent_bytes += len(data)
        for line in data.decode("ascii").splitlines():
            word, *rest = line.removeprefix("$").split("*")[0].split(",")
            self.sent[f"{word} {rest[0]}" if rest and word != "VNASY" else word] += 1
        if self._plugged:
            self.emulator.receive(data, self.now_s)

    def step(self) -> None:
        """`step_s` pass."""
        self.now_s += self.step_s
        data = self.emulator.advance(self.now_s)
        if self.emulator.plugged is not self._plugged:
            self._plugged = self.emulator.plugged
            if self._plugged:
                self.feed(inputs.LinkOpened(self.now_ns, "virtual", 115200))
            else:
                self.feed(inputs.LinkLost(self.now_ns, "unplugged"))
        if self.now_s - self._interlock_s >= self.interlock_s:
            self._interlock_s = self.now_s
            self.feed(inputs.Interlock(self.now_ns, self.safe))
        if data and self._plugged:
            self.feed(inputs.Received(self.now_ns, data))
        due = self.core.deadline_ns
        if due is not None and due <= self.now_ns:
            self.feed(inputs.Tick(self.now_ns))

    def run(self, seconds: float) -> None:
        """So many seconds."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.step()

    def until(self, condition: Callable[[], object], seconds: float) -> bool:
        """Whether it came to be within `seconds`."""
        end_s = self.now_s + seconds
        while not condition():
            if self.now_s >= end_s:
                return False
            self.step()
        return True

    def restart(self) -> None:
        """The program was killed and is started again: only the journal is remembered."""
        self.core = Core(self.core.settings)
        self._plugged = False
        self.tell_clocks()

    def operate(self, verb: str, argument: str = "") -> None:
        """A person's word."""
        self.feed(inputs.Operator(self.now_ns, verb, argument))

    def describe(self) -> str:
        """Where it stands, in a line."""
        core = self.core
        phase = core.device_session.phase.value
        return f"{self.now_s:.1f} s, {core.writeback.state.value}, {phase}: {self.notes[-2:]}"

    def stop(self) -> None:
        """A signal to end."""
        self.feed(inputs.Stop(self.now_ns, "told to stop"))

    @property
    def writes(self) -> int:
        """VNWRG of registers 23 and 84 that were sent."""
        return self.sent["VNWRG 23"] + self.sent["VNWRG 84"]

    @property
    def saves(self) -> int:
        """VNWNV that were sent."""
        return self.sent["VNWNV"]
