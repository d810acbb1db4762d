"""Random histories of clocks, restarts and kills: conclusions compared with what was true.

The observer knows when the device really restarted, what its flash holds, and which times the
program received. From the program it uses only the journal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from writeback_rig import Device, Rig

from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import Command, Word, Write

DAY_S, HOUR_S = 86400.0, 3600.0
TRUE_WALL_S = 1.8e9
HISTORIES, STEPS = 160, 7
BUDGET_HISTORIES, BUDGET_STEPS = 24, 24


class ForgetfulDevice(Device):
    """Acknowledges VNWNV, whether or not it carries it out."""

    keeps = True

    def answer(self, command: Command):
        flash = dict(self.flash)
        reply = super().answer(command)
        if command == Word("VNWNV") and not self.keeps:
            self.flash = flash
        return reply


@dataclass(frozen=True)
class Moment:
    """The true state: time, the computer's boot, and the start of the device."""

    at_s: float
    boots: int
    started_s: float

    @property
    def uptime_s(self) -> float:
        return self.at_s - self.started_s


class Observed(Rig):
    """A rig with faulty clocks that notes the true state at each record."""

    def __init__(self, policy: WriteBackPolicy, draw: np.random.Generator) -> None:
        self.draw = draw
        self.written: list[Moment] = []  # one per record of the journal
        self.fallen: list[Moment] = []  # the program saw the device's time decrease
        self.reported: list[Moment] = []  # the device reported a restart
        self.heard: Moment | None = None  # by this process
        super().__init__(policy, ForgetfulDevice())
        self.tells_time = bool(draw.random() < 0.8)
        self.started_s = -float(draw.choice([3.0, 300.0, 2e5]))
        self.set_wall()

    def moment(self) -> Moment:
        return Moment(self.now_s, self.boots, self.started_s)

    def start(self) -> None:
        self.heard = None
        super().start()

    def _append(self, action):
        count = len(self.journal)
        answer = super()._append(action)
        self.written += [self.moment()] * (len(self.journal) > count)
        return answer

    def hear_time(self) -> None:
        if self.tells_time:
            now = self.moment()
            if self.heard is not None and now.uptime_s < self.heard.uptime_s - 1.0:
                self.fallen.append(now)
            self.heard = now
        super().hear_time()

    def set_wall(self, errors=(0.0, -HOUR_S, HOUR_S, 2 * DAY_S, None)) -> None:
        """The wall clock is set, or wrong from the start; None: it began with the boot, in 1970."""
        error_s = errors[int(self.draw.integers(len(errors)))]
        self.wall_s = -self.boot_began_s if error_s is None else TRUE_WALL_S + error_s
        self.tell_clocks()

    def settle(self) -> None:
        """Seconds of messages; requests of the program are carried out."""
        for _ in range(3):
            asked = self.asked_again
            for _ in range(4):
                self.pass_time(0.6)
            if self.asked_again == asked:
                return
            self.connect()

    def restart_device(self, silent_s: float) -> None:
        self.device.restart()
        self.started_s = self.now_s
        self.now_s += silent_s


def wait_s(draw) -> float:
    return float(draw.choice([0.2, 5.0, 70.0, 3 * HOUR_S, 9 * DAY_S]))


def act(rig: Observed) -> str:
    """One random event in the world."""
    draw = rig.draw
    rig.do(rig.wb.tick(rig.now_s))  # as the core does for every input
    what = str(draw.choice(["set", "device", "program", "computer", "link", "time"]))
    if what == "set":
        rig.set_wall()
    elif what == "time":
        rig.now_s += wait_s(draw)
    elif what == "device":
        rig.now_s += float(draw.choice([0.0, 2.0, HOUR_S]))
        rig.hear_time()
        rig.restart_device(float(draw.choice([0.5, 2.0, 40.0])))
        if not rig.tells_time and draw.random() < 0.5:
            rig.reported.append(rig.moment())
            rig.do(rig.wb.on_reset(rig.now_s))
            rig.connect()
    else:
        rig.now_s += wait_s(draw)
        if draw.random() < 0.5:
            rig.restart_device(wait_s(draw))
        rig.now_s += wait_s(draw)
        if what == "link":
            rig.do(rig.wb.on_link_lost(rig.now_s))
        else:
            if what == "computer":
                rig.boots, rig.boot_began_s = rig.boots + 1, rig.now_s - 20.0
            rig.start()
            rig.set_wall()
        rig.connect()
    rig.settle()
    return what


class Observer:
    """What the device shows of a restart since the record that left a save open."""

    def __init__(self, rig: Observed) -> None:
        self.rig = rig
        self.record = rig.written[-1]

    def restarted(self) -> bool:
        """Whether it restarted, observed or not."""
        return self.rig.started_s >= self.record.at_s

    def provable(self, slack: float) -> bool:
        """Whether what the device showed proves it: its time, or a report if it sends no time.

        slack: 1 counts only clear cases, -1 also borderline cases.
        """
        rig, record = self.rig, self.record
        if not self.restarted():
            return False
        if not rig.tells_time:
            return any(m.at_s > record.at_s for m in rig.reported)
        now = rig.moment()
        if rig.heard is None:
            return False
        if now.boots == record.boots:
            return rig.started_s - record.at_s > slack * (1.0 + 0.002 * (now.at_s - record.at_s))
        seen = any(m.at_s > record.at_s and m.started_s == now.started_s for m in rig.fallen)
        return seen or now.uptime_s < record.uptime_s - slack * 5.0


def save(rig: Observed) -> bool:
    """A save that may be acknowledged and carried out or not; returns whether it was sent."""
    draw = rig.draw
    rig.device.keeps = bool(draw.random() < 0.6)
    if draw.random() < 0.5:
        rig.device.mute = lambda command: command == Word("VNWNV")
    rig.whole_way()
    rig.device.mute = lambda _: False
    return "FLASH_SENT" in rig.kinds


@pytest.fixture(scope="module")
def all_histories():
    """All histories, each with the kinds of its journal records and the observer's objections."""
    ends: list[tuple[str, bool, bool]] = []
    wrong: list[str] = []
    for seed in range(HISTORIES):
        draw = np.random.default_rng([77, seed])
        policy = WriteBackPolicy(mode=Mode.COMMIT, trial=TrialPolicy(duration_s=600.0))
        rig = Observed(policy, draw)
        new = None
        if not save(rig):
            wrong.append(f"{seed}: nothing was saved, {rig.wb.obstacles()}")
            continue
        new, observer, deeds = rig.device.held(), Observer(rig), []
        for _ in range(STEPS):
            deeds.append(act(rig))
            kind, where = rig.kinds[-1], f"{seed} {deeds} {rig.kinds[-1]} in {rig.wb.state}"
            holds_new = rig.device.held() == new
            if kind in ("CONFIRMED", "LOST", "NOT_SAVED") and not observer.provable(-1.0):
                wrong.append(f"{where}: no restart was shown")
            if kind == "CONFIRMED" and rig.device.held("flash") != new:
                wrong.append(f"{where}: its flash holds other values")
            if observer.provable(1.0) and holds_new and kind != "CONFIRMED":
                wrong.append(f"{where}: a restart was shown and the new values were read")
            if kind not in ("FLASH_SENT", "FLASH_ACKED"):
                break
        ends.append((rig.kinds[-1], observer.restarted(), rig.tells_time))
    return ends, wrong


def test_save_is_confirmed_exactly_if_a_restart_is_shown_and_new_values_are_read(all_histories):
    assert all_histories[1] == []


def test_histories_cover_all_outcomes(all_histories):
    kinds = [kind for kind, _, _ in all_histories[0]]
    assert len(kinds) == HISTORIES
    assert kinds.count("CONFIRMED") > 30
    assert kinds.count("NOT_SAVED") > 4
    assert kinds.count("REVERTED") > 5
    assert {"FLASH_SENT", "FLASH_ACKED"} & set(kinds)
    assert ("CONFIRMED", True, False) in all_histories[0]
    assert not [end for end in all_histories[0] if end[0] == "CONFIRMED" and not end[1]]


def test_observer_detects_a_program_that_trusts_the_wall_clock(monkeypatch):
    """With a program that trusts the wall clock, as it once did, the same histories are wrong."""
    from ahrsd.writeback import device_watch

    def by_the_wall(record, now, uptime_s):
        return uptime_s is not None and 0.0 <= uptime_s < now.wall_s - record.wall_s

    monkeypatch.setattr(device_watch, "restarted_since", by_the_wall)
    false = 0
    for seed in range(40):
        rig = Observed(WriteBackPolicy(mode=Mode.COMMIT), np.random.default_rng([78, seed]))
        rig.tells_time, rig.wall_s = True, -rig.boot_began_s
        rig.tell_clocks()
        rig.whole_way()
        observer = Observer(rig)
        rig.wall_s = TRUE_WALL_S
        rig.start()
        rig.connect()
        rig.settle()
        false += rig.kinds[-1] == "CONFIRMED" and not observer.provable(-1.0)
    assert false == 40


# -- budgets ---------------------------------------------------------------------------------------


class Meter:
    """Records in the device when a transaction wrote registers, and when it saved."""

    def __init__(self, rig: Observed) -> None:
        self.rig = rig
        self.writes: list[float] = []
        self.saves: list[float] = []
        self._transaction = 0

    def __call__(self, command: Command) -> None:
        kinds = self.rig.kinds
        if isinstance(command, Write) and kinds[-1] == "PREPARED":
            if kinds.count("PREPARED") > self._transaction:
                self.writes.append(self.rig.now_s)
            self._transaction = kinds.count("PREPARED")
        if command == Word("VNWNV"):
            self.saves.append(self.rig.now_s)


def write_and_save(rig: Observed) -> None:
    """Writes and saves as far as the budgets allow."""
    draw = rig.draw
    rig.settle()
    rig.verdict(hard_iron_gauss=np.array([0.03 + 0.02 * draw.integers(9), 0.04, -0.02]))
    if rig.wb.state is State.QUALIFIED:
        rig.approve()
    if rig.wb.state is State.TRIAL:
        rig.live(field_spread=float(draw.choice([0.005, 0.005, 0.005, 0.5])))
    if rig.wb.state is State.PROVEN:
        rig.stand_still()
    if rig.wb.state is State.PROVEN:  # the budget of the day, not a permanent one
        rig.do(rig.wb.on_operator("rollback", "", rig.now_s))
    if rig.wb.state is State.LOCKED:
        rig.do(rig.wb.on_operator("unlock", "seen", rig.now_s))


def test_wrong_or_set_clock_allows_no_early_write_and_no_second_save_in_a_day():
    saves = writes = 0
    for seed in range(BUDGET_HISTORIES):
        draw = np.random.default_rng([79, seed])
        rig = Observed(WriteBackPolicy(mode=Mode.COMMIT), draw)
        meter = Meter(rig)
        rig.device.refuse = meter
        errors = (0.0, -HOUR_S, HOUR_S, None)
        rig.set_wall(errors)
        rig.connect()
        for _ in range(BUDGET_STEPS):
            what = draw.integers(5)
            if what == 0:
                rig.boots, rig.boot_began_s = rig.boots + 1, rig.now_s - 20.0
                rig.start()
                rig.set_wall(errors)
                rig.connect()
            elif what == 1:
                rig.set_wall(errors)
            elif what == 2:  # set far ahead, and back before the next boot
                rig.set_wall((40 * DAY_S,))
                write_and_save(rig)
                rig.set_wall(errors)
            rig.now_s += float(draw.choice([60.0, 900.0, 5 * HOUR_S, 22 * HOUR_S, 2 * DAY_S]))
            write_and_save(rig)
        cooling = [
            m.at_s
            for m, record in zip(rig.written, rig.journal, strict=True)
            if record.kind == "ROLLBACK" and record.facts["counts"]
        ]
        policy, begun = rig.policy, np.array(meter.writes)
        assert np.diff(meter.saves).min(initial=np.inf) >= DAY_S - 1.0, seed
        assert np.diff(begun).min(initial=np.inf) >= policy.min_interval_s - 1.0, seed
        for at_s in begun:
            assert np.sum((begun <= at_s) & (begun > at_s - DAY_S + 1.0)) <= 6, seed
            assert not [s for s in cooling if 0.0 < at_s - s < policy.cooldown_s - 1.0], seed
        saves, writes = saves + len(meter.saves), writes + len(begun)
    assert saves > BUDGET_HISTORIES
    assert writes > 2 * BUDGET_HISTORIES
