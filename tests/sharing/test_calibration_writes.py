"""The owner writes calibration registers: refused by default, a journaled foreign change with
`pass`.

Judged by what the units hold and were sent (`cabled_units`).
"""

from __future__ import annotations

import pytest
from cabled_run import BIAS, FIRST, IRON, SPARE, CabledRun, estimate, two_units
from planted_calibrator import PlantedCalibrator

from ahrsd import inputs
from ahrsd.core.core import Core
from ahrsd.events import SamplesSeen
from ahrsd.sharing.arbiter import SharePolicy
from ahrsd.writeback.states import Mode

OWNER = SharePolicy("owner", owner=True, calibration="pass")
SHARES = (OWNER, SharePolicy("log"))
ONE = "1,0,0,0,1,0,0,0,1,0,0,0"
THEIRS = "1.02,0,0,0,1.01,0,0,0,1,0.11,0.01,0.02"
NEW = ("1,0,0,0,1,0,0,0,1,0.05,-0.03,0.04", "1,0,0,0,1,0,0,0,1,0.01,-0.02,0.005")


def shared(shares=SHARES, **options) -> CabledRun:
    cable = two_units(binary=True)
    for unit in cable.units.values():
        unit.flash[43] = unit.ram[43] = "0,0,0"
    return CabledRun(cable, shares=shares, **options)


def say(run: CabledRun, line: str, client: str = "owner") -> str:
    run.answers(client)
    run.say(client, line)
    assert run.until(lambda: run.heard[client], 2.5), run.notes[-3:]
    (answer,) = run.answers(client)
    return answer


def writes(run: CabledRun) -> list[tuple[int, str]]:
    return run.cable.unit.writes


def test_owner_write_is_journaled_before_it_reaches_the_device():
    run, order = shared(planted=False), []
    run.cable.unit.before = order.append
    run.listeners.append(
        lambda e: order.append(e.kind) if type(e).__name__ == "JournalAppend" else None
    )
    assert say(run, f"VNWRG,23,{THEIRS}") == f"VNWRG,23,{THEIRS}"
    assert run.cable.unit.held() == (THEIRS, ONE)
    asked = [one for one in order if one == "CLIENT_WRITES" or one.startswith("VNWRG")]
    assert asked == ["CLIENT_WRITES", f"VNWRG,23,{THEIRS}"]
    (record,) = run.journal[FIRST]
    facts = record["facts"]
    assert (facts["client"], facts["serial"]) == ("owner", FIRST)
    assert facts["old"] == {"23": [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]}
    assert facts["new"] == {"23": [1.02, 0, 0, 0, 1.01, 0, 0, 0, 1, 0.11, 0.01, 0.02]}


@pytest.mark.parametrize(
    ("number", "values"),
    [(23, THEIRS), (25, THEIRS), (26, "0,1,0,-1,0,0,0,0,1"), (44, "1,3,5"), (43, "1,2,3"),
     (84, THEIRS)],
)  # fmt: skip
def test_each_calibration_register_passes_only_for_the_owner(number, values):
    run = shared(planted=False)
    assert say(run, f"VNWRG,{number},{values}", "log") == "VNERR,09"
    assert writes(run) == []
    assert say(run, f"VNWRG,{number},{values}").startswith(f"VNWRG,{number},")
    assert [n for n, _ in writes(run)] == [number]
    assert run.kinds() == ["CLIENT_WRITES"]


def test_vendor_commands_and_missing_registers_stay_refused():
    run = shared(planted=False)
    for line in ("VNTAR", "VNSGB", "VNRFS", "VNFWU", "VNWRG,74,1,2,3,4,5,6,7"):
        assert say(run, line) == "VNERR,09"
    assert (writes(run), run.kinds()) == ([], [])


def test_calibration_write_is_refused_by_default():
    run = shared((SharePolicy("owner", owner=True),), planted=False)
    assert say(run, f"VNWRG,23,{THEIRS}") == "VNERR,09"
    assert (writes(run), run.kinds()) == ([], [])
    assert not run.told("may write what calibrates")


@pytest.mark.parametrize("mode", [Mode.PASSIVE, Mode.OBSERVE])
def test_nothing_passes_in_passive_and_observe_and_it_is_logged(mode):
    run = shared(planted=False, mode=mode)
    assert run.told(f"lets nothing pass in mode {mode.name.lower()}")
    for number in (23, 25, 84):
        assert say(run, f"VNWRG,{number},{THEIRS}") == "VNERR,09"
    assert (writes(run), run.kinds()) == ([], [])
    assert not any(line.startswith("VNWRG") for line in run.cable.unit.log)


def test_samples_are_un_mapped_through_the_new_registers():
    run, blocks = shared(planted=False), []
    run.listeners.append(lambda e: blocks.append(e) if isinstance(e, SamplesSeen) else None)
    run.run(5.0)
    say(run, f"VNWRG,23,{THEIRS}")
    say(run, f"VNWRG,84,{THEIRS}")
    run.run(5.0)
    assert run.told("somebody changed registers [23]", "calibrated anew")
    strength = [((e.block.raw_b_gauss - IRON) ** 2).sum(axis=1) ** 0.5 for e in blocks]
    assert (
        max(float(abs(s - 0.4837).max()) for s in strength) < 0.02
    )  # none un-mapped through other registers
    assert run.core.registers[23][9:] == (0.11, 0.01, 0.02)
    assert BIAS.shape == (3,)


@pytest.mark.parametrize("state", ["TRIAL", "PROVEN", "COMMITTED"])
def test_owner_write_is_refused_during_a_calibration_write(state):
    run = shared()
    run.approve()
    assert run.until("TRIAL", 30.0)
    if state != "TRIAL":
        run.safe = False
        assert run.until("PROVEN")
    if state == "COMMITTED":
        run.park(30.0)
        assert run.state == state, run.notes
    before, kinds = list(writes(run)), run.kinds()
    assert say(run, f"VNWRG,23,{THEIRS}") == "VNERR,09"
    assert run.told("register 23 was not written for it", state)
    assert (writes(run), run.kinds(), run.state) == (before, kinds, state)
    assert run.cable.unit.held() == NEW


def test_owner_write_is_refused_while_a_trial_is_set_aside():
    run = shared()
    run.approve()
    assert run.until("TRIAL", 30.0)
    assert say(run, "VNWNV") == "VNWNV"
    assert run.state == "SET_ASIDE"
    assert say(run, f"VNWRG,23,{THEIRS}") == "VNERR,09"
    assert run.until("TRIAL", 10.0), run.notes
    assert run.cable.unit.held() == NEW


def test_approved_values_do_not_overwrite_an_owner_write():
    """Approved while the vehicle does not permit it; then the owner writes, and then it is
    permitted.
    """
    run = shared()
    assert run.until("QUALIFIED")
    run.safe = False
    run.run(1.0)
    run.approve()
    assert say(run, f"VNWRG,23,{THEIRS}") == "VNERR,09"
    run.safe = True
    assert run.until("TRIAL", 30.0), run.notes
    assert run.cable.unit.held() == NEW


def test_rollback_restores_the_values_of_the_owner():
    run = shared()
    assert say(run, f"VNWRG,23,{THEIRS}") == f"VNWRG,23,{THEIRS}"
    assert say(run, "VNWNV") == "VNWNV"
    run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
    run.approve()
    assert run.until("TRIAL", 30.0), run.notes
    run.feed(inputs.Operator(run.now_ns, "rollback", ""))
    run.run(5.0)
    assert run.cable.unit.held() == (THEIRS, ONE)


@pytest.mark.parametrize("ends", ["saved", "restart"])
def test_unsaved_owner_values_are_not_overwritten(ends):
    """A restart during a trial would give values that are neither old nor new."""
    run = shared()
    say(run, f"VNWRG,84,{THEIRS}")
    run.run(2.0)
    run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
    run.approve()
    run.run(20.0)
    assert run.state == "QUALIFIED"
    assert any("register 84 holds what a program" in r for r in run.core.writeback.obstacles())
    assert run.cable.unit.held() == (ONE, THEIRS)
    if ends == "saved":
        assert say(run, "VNWNV") == "VNWNV"
    else:
        run.cable.unit.restart()
        run.run(3.0)
        run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
        run.approve()
    assert run.until("TRIAL", 40.0), run.core.writeback.obstacles()
    assert run.cable.unit.held() != (ONE, THEIRS)


@pytest.mark.parametrize("number", [23, 84])
@pytest.mark.parametrize(
    "at", [pytest.param(at, marks=() if at % 3 == 1 else pytest.mark.slow) for at in range(1, 16)]
)
def test_unit_exchanged_at_any_command_of_an_owner_write_is_not_written(number, at):
    run, heard = shared(planted=False), []
    first, spare = run.cable.units[FIRST], run.cable.units[SPARE]

    def hear(line: str) -> None:
        heard.append(line)
        if len(heard) == at:
            run.cable.swap(SPARE, silent_s=0.1)

    for unit in (first, spare):
        unit.before = hear
    run.say("owner", f"VNWRG,{number},{THEIRS}")
    run.run(12.0)
    assert len(heard) >= at
    known = {number: THEIRS} if spare.writes else {}
    assert spare.writes == list(known.items())
    if spare.writes:  # after it was identified and read: with its own journal
        assert "CLIENT_WRITES" in run.kinds(SPARE)


@pytest.mark.parametrize("saves", [True, False])
def test_unsaved_owner_values_are_not_saved_by_the_daemon(saves):
    run = shared()
    say(run, f"VNWRG,25,{THEIRS}")
    run.run(2.0)
    if saves:
        assert say(run, "VNWNV") == "VNWNV"
    run.core.calibrator = PlantedCalibrator(run.core.calibrator, estimate())
    run.proven()
    run.park(30.0)
    flash = run.cable.unit.flash
    if saves:
        assert (run.state, flash[25], run.cable.unit.held("flash")) == ("COMMITTED", THEIRS, NEW)
    else:
        assert (run.state, flash[25], flash[23]) == ("PROVEN", ONE, ONE)
        assert any("somebody else changed register 25" in r for r in run.core.writeback.obstacles())


def test_nothing_passes_without_a_writable_journal():
    run = shared(planted=False)
    handle = run.core.handle

    def full(item):
        if isinstance(item, inputs.Journalled):
            item = inputs.Journalled(item.host_ns, item.kind, "no space left on device")
        return handle(item)

    run.core.handle = full
    assert say(run, f"VNWRG,23,{THEIRS}") == "VNERR,09"
    assert say(run, f"VNWRG,23,{THEIRS}") == "VNERR,09"
    assert writes(run) == []


def test_write_of_a_client_that_left_is_dropped():
    run = shared(planted=False)
    run.core.clients.on_bytes(
        inputs.ClientSent(run.now_ns, "owner", "$VNWRG,84,1,0,0,0,1,0,0,0,1,0,0,1*XX\r\n"),
        run.now_s,
    )
    run.feed(inputs.ClientLeft(run.now_ns, "owner"))
    run.run(3.0)
    assert writes(run) == []
    assert run.state == "OBSERVING"
    assert say(run, f"VNWRG,23,{THEIRS}") == f"VNWRG,23,{THEIRS}"


def announced_and_not_sent(run: CabledRun, how: str) -> None:
    """A journaled owner write that is not sent, because the client left or it waited too long."""
    handle, held = run.core.handle, []

    def hold(item):
        if isinstance(item, inputs.Journalled) and item.kind == "CLIENT_WRITES":
            held.append(item)
            return []
        return handle(item)

    run.core.handle = hold
    run.say("owner", f"VNWRG,84,{THEIRS}")
    assert run.until(lambda: held, 1.0)
    if how == "leaves":
        run.feed(inputs.ClientLeft(run.now_ns, "owner"))
    else:
        run.run(3.0)
    run.core.handle = handle
    (answer,) = held
    run.feed(answer)
    run.run(1.0)
    assert (writes(run), run.kinds()) == ([], ["CLIENT_WRITES"])


@pytest.mark.parametrize("how", ["leaves", "late"])
def test_unsent_owner_write_is_journaled_again_when_sent(how):
    run, order = shared(planted=False), []
    announced_and_not_sent(run, how)
    run.cable.unit.before = order.append
    run.listeners.append(
        lambda e: order.append(e.kind) if type(e).__name__ == "JournalAppend" else None
    )
    assert say(run, f"VNWRG,84,{THEIRS}") == f"VNWRG,84,{THEIRS}"
    asked = [one for one in order if one == "CLIENT_WRITES" or one.startswith("VNWRG")]
    assert asked == ["CLIENT_WRITES", f"VNWRG,84,{THEIRS}"]
    assert run.cable.unit.held() == (ONE, THEIRS)


@pytest.mark.parametrize("how", ["leaves", "late"])
def test_unsent_owner_write_does_not_block_a_calibration(how):
    run = shared()
    announced_and_not_sent(run, how)
    run.approve()
    assert run.until("TRIAL", 30.0), run.core.writeback.obstacles()
    assert run.cable.unit.held() == NEW


def test_foreign_change_is_journaled_before_it_is_overwritten():
    """The register changes between the journal's answer and the write."""
    run, meanwhile = shared(planted=False), "1,0,0,0,1,0,0,0,1,0.3,0.2,0.1"
    changed: list[str] = []

    def change(event):
        if type(event).__name__ == "JournalAppend" and not changed:
            changed.append(event.kind)
            run.cable.unit.ram[84] = meanwhile

    run.listeners.append(change)
    run.say("owner", f"VNWRG,84,{THEIRS}")
    run.run(12.0)
    assert changed == ["CLIENT_WRITES"]
    if writes(run):
        assert run.journal[FIRST][-1]["facts"]["old"] == {
            "84": [float(v) for v in meanwhile.split(",")]
        }
    assert run.core.registers[84] == tuple(float(v) for v in run.cable.unit.ram[84].split(","))


@pytest.mark.parametrize("answered", ["refused", "lost", "link"])
def test_device_is_read_again_after_any_answer(answered):
    run = shared(planted=False)
    unit, answer = run.cable.unit, run.cable.unit.answer

    def other(line: bytes) -> bytes:
        if not line.startswith(b"$VNWRG,23"):
            return answer(line)
        if answered == "refused":
            return b"$VNERR,05*74\r\n"
        answer(line)
        return b""

    unit.answer = other
    run.say("owner", f"VNWRG,23,{THEIRS}")
    if answered == "link":
        assert run.until(lambda: unit.writes, 2.0)
        run.feed(inputs.LinkLost(run.now_ns, "unplugged"))
        run.feed(inputs.LinkOpened(run.now_ns, "cable", 115200))
    run.run(8.0)
    held = ONE if answered == "refused" else THEIRS
    assert unit.held() == (held, ONE)
    assert run.core.registers[23] == tuple(float(v) for v in held.split(","))
    assert run.state == "OBSERVING"
    assert say(run, "VNRRG,01") == "VNRRG,01,VN-100T-CR"


@pytest.mark.parametrize("held", ["before", "after"])
def test_both_values_are_known_after_a_kill(held):
    run = shared(planted=False)
    say(run, f"VNWRG,23,{THEIRS}")
    if held == "before":
        run.cable.unit.restart()
    again = CabledRun(run.cable, shares=SHARES, planted=False, journal=run.journal)
    again.run(2.0)
    assert not again.told("changed since the journal's last record")
    assert not again.told("neither the factory's nor in the journal")


def test_replay_decides_the_same():
    run = shared(planted=False)
    say(run, f"VNWRG,23,{THEIRS}")
    run.run(5.0)
    again, heard = Core(run.core.settings), b""
    for item in run.taken:
        for event in again.handle(item):
            if type(event).__name__ == "SendToClient":
                heard += event.data
    assert again.decisions.sha256 == run.core.decisions.sha256
    assert again.registers == run.core.registers
    assert heard.startswith(f"$VNWRG,23,{THEIRS}*".encode())
