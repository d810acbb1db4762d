"""The daemon's core, shell and journal against a scripted device, all in virtual time.

What is real: the bytes both ways, the session, identity and registers, the stream, the write-back,
the journal's file, the host's clocks as inputs. What is replaced: the estimator, by one that is
cheap and honest (`fitting_calibrator`), where `fitted` is true; the port and the loop of `daemon`,
by a few lines here. Whoever wants something to happen asks for a time (`at`) or for a moment
(`at_moment`): before and after each command that the device carries out and each record of the
journal, counted from the start.
"""

from __future__ import annotations

import heapq
import itertools
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from fitting_calibrator import FittingCalibrator
from scripted_vn100 import Cable, Unit
from scripted_vn100.wire import sentence
from write_observer import Observer

from ahrsd import events, inputs
from ahrsd.config.config import Config, core_settings
from ahrsd.core import estimation
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import JournalKeeper, Shell, journal_in
from ahrsd.sharing.arbiter import SharePolicy
from ahrsd.writeback.policy import StillPolicy, WriteBackPolicy
from ahrsd.writeback.states import Mode
from ahrsd.writeback.trial import TrialPolicy

CHUNK_S, INTERLOCK_S = 0.2, 0.3
POLICY = WriteBackPolicy(
    mode=Mode.COMMIT, approval="auto", armed_at_start=True, commit_unattended=True,
    max_change_auto_deg=180.0, min_interval_s=0.0, cooldown_s=0.0, ram_writes_per_day=10**6,
    flash_writes_per_day=10**6, flash_writes_lifetime=10**6, rollbacks_to_lock=10**6, recheck_s=3.0,
    trial=TrialPolicy(duration_s=2.0, turns=100.0), still=StillPolicy(duration_s=1.0),
)  # fmt: skip
CLIENT = "owner"  # of a shared port; says nothing unless a script makes it
_CANDIDATE = re.compile(r"candidate ([0-9a-f]{8}),")


class Killed(Exception):
    """The program was killed at this very moment."""


@contextmanager
def fitted() -> Iterator[None]:
    """While it lasts, every core fits spheres instead of running the estimator."""
    true = estimation.Calibrator
    estimation.Calibrator = FittingCalibrator  # type: ignore[misc]
    try:
        yield
    finally:
        estimation.Calibrator = true  # type: ignore[misc]


@dataclass
class HostClocks:
    """The clocks of the daemon's computer, against the world's time.

    boot_s:       when it was switched on; its monotonic clock and CLOCK_BOOTTIME count from there
    wall_ahead_s: wall clock less the world's time
    """

    boot_s: float = -300.0
    boot: int = 1
    wall_ahead_s: float = 1.7e9

    def ns(self, at_s: float) -> int:
        """Monotonic, in ns."""
        return round((at_s - self.boot_s) * 1e9)

    def reboot(self, at_s: float) -> None:
        """Switched off and on."""
        self.boot_s, self.boot = at_s - 5.0, self.boot + 1

    @property
    def boot_id(self) -> str:
        """As in /proc/sys/kernel/random/boot_id."""
        return f"00000000-0000-4000-8000-{self.boot:012d}"


class _Keeper(JournalKeeper):
    """The real journal, with moments around each record, and a disk that may be full."""

    world: World

    def append(self, item: events.JournalAppend) -> inputs.Journalled:
        self.world.moment(f"before {item.kind}")
        if self.world.disk_full:
            return inputs.Journalled(self.now_ns(), item.kind, "no space left on device")
        answer = super().append(item)
        if not answer.error:
            self.world.recorded(item)
        self.world.moment(f"after {item.kind}")
        return answer


@dataclass
class World:
    """See the module. `folder` is the state directory; `run` goes on to a time."""

    cable: Cable
    folder: Path
    policy: WriteBackPolicy = POLICY
    clocks: HostClocks = field(default_factory=HostClocks)
    config: Config = field(default_factory=Config)

    def __post_init__(self) -> None:
        self.now_s = 0.0
        self.observer = Observer(self.cable)
        self.safe: bool | None = True
        self.disk_full = False
        self.operator: float | None = None  # seconds until a person approves what is announced
        self.moments: list[tuple[float, str]] = []
        self.states: list[tuple[float, str, str]] = []
        self.notes: list[tuple[float, str]] = []
        self.finished = False
        self.kills = 0
        shares = (SharePolicy(CLIENT, owner=True, calibration="pass"),)
        settings = core_settings(self.config, policy=self.policy)
        self.settings = replace(settings, keep=16, shares=shares)
        self.answered: list[tuple[float, str]] = []
        self.core: Core | None = None
        self._shell: Shell | None = None
        self._serial = 0
        self._order = itertools.count()
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._at_moment: dict[int, list[Callable[[], None]]] = {}
        self._at_label: dict[tuple[str, int], list[Callable[[], None]]] = {}
        self._labels: dict[str, int] = {}
        self._interlock_s = self._chunk_s = 0.0
        self._told_wall_s = float("nan")
        self._deadline_ns: int | None = None
        self.cable.moment = self.moment

    # -- the script --------------------------------------------------------------------------------

    def at(self, at_s: float, act: Callable[[], None]) -> None:
        """Do it at this time."""
        heapq.heappush(self._events, (at_s, next(self._order), act))

    def at_moment(self, number: int, act: Callable[[], None]) -> None:
        """Do it at the so-manieth moment."""
        self._at_moment.setdefault(number, []).append(act)

    def at_label(self, label: str, act: Callable[[], None], occurrence: int = 1) -> None:
        """Do it when this label comes for the so-manieth time."""
        self._at_label.setdefault((label, occurrence), []).append(act)

    def moment(self, label: str) -> None:
        """Something may happen here."""
        number = len(self.moments)
        self.moments.append((self.now_s, label))
        count = self._labels[label] = self._labels.get(label, 0) + 1
        for act in self._at_moment.pop(number, []) + self._at_label.pop((label, count), []):
            act()
        self.observer.look(self.now_s)

    @property
    def unit(self) -> Unit:
        """Whoever is at the cable now."""
        return self.cable.unit

    # -- what a script may do ----------------------------------------------------------------------

    def start(self) -> None:
        """The program begins."""
        self.observer.begun(self.now_s)
        self.core = Core(self.settings)
        keeper = _Keeper(journal_in(self.folder), lambda: self.clocks.ns(self.now_s))
        keeper.world = self  # type: ignore[misc]
        self._shell = Shell(self.core, None, keeper, None, [self._hear])
        self._shell.folded.write = lambda level, text: None
        self._told_wall_s = float("nan")
        self._tell_wall()
        self.feed(inputs.LinkOpened(self._ns(), "scripted", 115200))
        self._deadline_ns = self.core.deadline_ns

    def kill(self) -> None:
        """kill -9, now."""
        self.core = self._shell = None
        self.kills += 1
        raise Killed

    def stop(self) -> None:
        """SIGTERM, and the end is waited for."""
        if self.core is None:
            return
        self.finished = False
        self.feed(inputs.Stop(self._ns(), "SIGTERM"))
        self.run(self.now_s + 2.5, until=lambda: self.finished or self.core is None)
        self.core = self._shell = None

    def operate(self, verb: str, argument: str = "") -> None:
        """A person's word, if somebody is there to hear it."""
        if self.core is not None:
            self.feed(inputs.Operator(self._ns(), verb, argument))

    def say(self, body: str) -> None:
        """The program on the owner's port writes this line, if it has a port."""
        if self.core is not None:
            self.observer.asked_by_client(body)
            self.feed(inputs.ClientSent(self._ns(), CLIENT, sentence(body).decode()))

    def later(self, seconds: float, act: Callable[[], None]) -> None:
        """Do it after a while."""
        self.at(self.now_s + seconds, act)

    # -- time passes -------------------------------------------------------------------------------

    def run(self, end_s: float, until: Callable[[], object] = lambda: False) -> bool:
        """Go on to a time, or until a condition holds; whether it held."""
        while self.now_s < end_s:
            try:
                self._step(end_s)
            except Killed:
                continue
            if until():
                return True
        return False

    def _step(self, end_s: float) -> None:
        due = [end_s, self._chunk_s, self.cable.next_s()]
        if self._events:
            due.append(self._events[0][0])
        if self.core is not None:
            due.append(self._interlock_s)
            if self._deadline_ns is not None:
                due.append(self._deadline_ns * 1e-9 + self.clocks.boot_s)
        self.now_s = max(min(due), self.now_s + 1e-4)
        while self._events and self._events[0][0] <= self.now_s:
            heapq.heappop(self._events)[2]()
        data = self.cable.advance(self.now_s)
        self.observer.look(self.now_s)
        if self.now_s >= self._chunk_s:
            self._chunk_s = self.now_s + CHUNK_S
        if self.core is not None:
            self._around(data)

    def _around(self, data: bytes) -> None:
        """As the daemon's loop: vehicle and clocks first, then bytes, then time."""
        if self.now_s >= self._interlock_s:
            self._interlock_s = self.now_s + INTERLOCK_S
            if self.safe is not None:
                self.feed(inputs.Interlock(self._ns(), self.safe))
            self._tell_wall()
        if data:
            self.feed(inputs.Received(self._ns(), data))
        if self.core is not None:
            deadline_ns = self.core.deadline_ns
            if deadline_ns is not None and deadline_ns <= self._ns():
                self.feed(inputs.Tick(self._ns()))
        self._deadline_ns = None if self.core is None else self.core.deadline_ns

    def _tell_wall(self) -> None:
        ahead_s = self.clocks.wall_ahead_s
        if abs(ahead_s - self._told_wall_s) < 1.0:
            return
        self._told_wall_s = ahead_s
        self.feed(wall_clock(self.clocks, self.now_s))

    def feed(self, item: inputs.Input) -> None:
        """One input, and what it makes the daemon send."""
        shell = self._shell
        if shell is not None:
            output = shell.feed(item)
            if output:
                self.cable.receive(output, self.now_s)

    def _ns(self) -> int:
        return self.clocks.ns(self.now_s)

    # -- what is heard -----------------------------------------------------------------------------

    def _hear(self, event: events.Event) -> None:
        match event:
            case events.Noted(text=text):
                self.notes.append((self.now_s, text))
                self.observer.announced(text, self.now_s)
                self._maybe_approve(text)
            case events.StateChanged(old=old, new=new, reason=reason):
                self.states.append((self.now_s, new, f"{old}: {reason}"))
            case events.OpenJournal(serial=serial):
                self._serial = serial
            case events.SendToClient(data=data):
                self.answered.append((self.now_s, data.decode("latin-1").strip()))
            case events.Finished():
                self.finished = True

    def _maybe_approve(self, text: str) -> None:
        if self.operator is None or not (match := _CANDIDATE.search(text)):
            return
        self.later(self.operator, lambda: self.operate("approve", match[1]))

    def recorded(self, item: events.JournalAppend) -> None:
        """A record is on the disk."""
        made_s = float(str(item.facts.get("boot_s", "inf"))) + self.clocks.boot_s
        late = item.facts.get("boot_id") != self.clocks.boot_id or self.now_s - made_s > 0.5
        self.observer.record(self._serial, item.kind, dict(item.facts), self.now_s, late=late)

    @property
    def kinds(self) -> list[str]:
        """Labels of the records so far."""
        return [label.split()[1] for _, label in self.moments if label.startswith("after ")]


def wall_clock(clocks: HostClocks, at_s: float) -> Any:
    """What the daemon tells its core of the host's clocks; older cores know the wall clock only."""
    known = {row.name for row in fields(inputs.WallClock)}
    boot = {"boot_id": clocks.boot_id, "boot_s": at_s - clocks.boot_s}
    return inputs.WallClock(
        clocks.ns(at_s), at_s + clocks.wall_ahead_s, **{k: v for k, v in boot.items() if k in known}
    )
