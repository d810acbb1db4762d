"""The observer of writes detects each kind of wrong write, and none in a correct history."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import write_histories
from scripted_vn100 import Cable, Iron, Motion, Unit, Vehicle
from scripted_vn100.memory import printed
from scripted_vn100.wire import sentence
from scripted_world import fitted
from write_observer import KINDS, Observer

HARD, BIAS = (0.05, -0.03, 0.04), (0.01, -0.02, 0.005)
GOOD = {
    23: "1,0,0,0,1,0,0,0,1," + ",".join(map(printed, HARD)),
    84: "1,0,0,0,1,0,0,0,1," + ",".join(map(printed, BIAS)),
}
FACTORY = "1,0,0,0,1,0,0,0,1,0,0,0"
FOREIGN = "1,0,0,0,1,0,0,0,1,0.3,0.1,0"
BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "writeback" / "histories.py"


class Story:
    """A unit, its observer, and a hand-written sequence of the daemon's actions."""

    def __init__(self) -> None:
        iron = Iron(hard_gauss=np.array(HARD), gyro_bias_rad_s=np.array(BIAS))
        self.unit = Unit(1, iron, Vehicle(), presets={6: "0"})
        self.cable = Cable(self.unit)
        self.observer = Observer(self.cable)
        self.now_s = 10.0

    def say(self, body: str, wait_s: float = 1.0) -> None:
        self.cable.receive(sentence(body), self.now_s)
        self.cable.advance(self.now_s)
        self.now_s += wait_s
        self.cable.advance(self.now_s)
        self.observer.look(self.now_s)

    def announce(self, values: dict[int, str] = GOOD) -> None:
        lines = " ".join(f"$VNWRG,{n},{text}*00" for n, text in values.items())
        self.observer.announced(f"candidate 12345678, to write: {lines}", self.now_s)

    def prepare(self, serial: int = 1, values: dict[int, str] = GOOD, shown: str = FACTORY) -> None:
        new = {str(n): [float(v) for v in text.split(",")] for n, text in values.items()}
        old = {str(n): [float(v) for v in shown.split(",")] for n in values}
        facts = {"serial": serial, "old": old, "new": new}
        self.observer.record(serial, "PREPARED", facts, self.now_s)

    def record(self, kind: str) -> None:
        self.observer.record(1, kind, {}, self.now_s)

    def write(self, values: dict[int, str] = GOOD) -> None:
        for number, text in values.items():
            self.say(f"VNWRG,{number},{text}")

    def to_flash(self) -> None:
        self.announce()
        self.prepare()
        self.write()
        self.record("PROVEN")
        self.save()
        self.record("FLASH_ACKED")

    def save(self) -> None:
        self.record("FLASH_SENT")
        self.say("VNWNV")

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.observer.violations]


def test_correct_sequence_has_no_violation():
    story = Story()
    story.to_flash()
    story.unit.restart(story.now_s)
    story.now_s += 1.0
    story.observer.look(story.now_s)
    story.record("CONFIRMED")
    assert story.kinds == []
    assert story.observer.counts["saves"] == 1


def test_values_announced_for_another_unit_are_a_violation():
    story = Story()
    story.announce()
    story.cable.exchange(Unit(2, Iron(), story.unit.vehicle, presets={6: "0"}), 10.0)
    story.prepare(serial=1)
    story.write()
    assert story.kinds == ["not_judged_here", "other_journal"] * 2


def test_unannounced_or_wrong_values_are_a_violation():
    story = Story()
    story.prepare()
    story.write({23: GOOD[23]})
    assert story.kinds == ["not_judged_here"]
    story = Story()
    story.announce({23: FOREIGN})
    story.prepare(values={23: FOREIGN})
    story.write({23: FOREIGN})
    assert story.kinds == ["not_judged_here"]


def test_old_values_of_another_unit_are_a_violation():
    story = Story()
    users = {23: FOREIGN, 6: "0"}
    story.cable.exchange(Unit(2, Iron(), story.unit.vehicle, presets=users), 10.0)
    story.prepare(serial=2)
    story.write({23: FACTORY})
    assert story.kinds == ["not_judged_here"]


def test_save_after_an_earlier_change_of_the_iron_is_a_violation():
    story = Story()
    story.announce()
    story.prepare()
    story.write()
    story.unit.vehicle.move_iron(np.array([0.05, 0.0, 0.0]), story.now_s)
    story.now_s += 10.0
    story.save()
    assert story.kinds == ["void_save"]


def test_save_immediately_after_a_change_of_the_iron_is_no_violation():
    story = Story()
    story.announce()
    story.prepare()
    story.write()
    story.unit.vehicle.move_iron(np.array([0.05, 0.0, 0.0]), story.now_s - 0.1)
    story.save()
    assert story.kinds == []


def test_change_of_iron_that_keeps_the_field_magnitude_is_invisible_at_rest():
    story = Story()
    story.unit.vehicle.motion = Motion(rest_s=100.0)
    story.announce()
    story.prepare()
    story.write()
    field = story.unit.vehicle.field_b(0.0, 0.2)
    across = np.cross(field, [0.0, 0.0, 1.0])
    across *= np.linalg.norm(field) / np.linalg.norm(across)
    turned = np.cos(0.1) * field + np.sin(0.1) * across
    story.unit.vehicle.move_iron(turned - field, story.now_s)
    story.now_s += 10.0
    story.save()
    assert story.kinds == []
    story.unit.vehicle.motion = Motion()  # a turn would have shown it
    story.save()
    assert story.kinds == ["void_save"]


def test_save_of_partial_or_foreign_values_is_a_violation():
    story = Story()
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.now_s += 5.0
    story.save()
    assert story.kinds == ["half_save"]
    for saved_by_them in (False, True):
        story = Story()
        story.say("VNRRG,23")  # from here on the daemon listens
        story.announce()
        story.prepare()
        story.write()
        story.cable.other_master(f"VNWRG,23,{FOREIGN}", story.now_s)
        if saved_by_them:
            story.cable.other_master("VNWNV", story.now_s)
        story.now_s += 5.0
        story.save()
        assert sorted(story.kinds) == ["foreign_save"] * (not saved_by_them) + ["half_save"]


def test_values_from_before_the_daemon_listened_belong_to_the_unit():
    story = Story()
    story.cable.other_master(f"VNWRG,84,{FOREIGN}", story.now_s)
    story.now_s += 5.0
    story.say("VNRRG,84")
    story.announce({23: GOOD[23]})
    story.prepare(values={23: GOOD[23]})
    story.write({23: GOOD[23]})
    story.save()
    assert story.kinds == []


def test_replacing_foreign_values_unseen_is_a_violation():
    story = Story()
    story.announce()
    story.prepare()
    story.cable.other_master(f"VNWRG,23,{FOREIGN}", story.now_s)
    story.observer.look(story.now_s)
    story.now_s += 5.0
    story.write({23: GOOD[23]})
    assert story.kinds == ["foreign_replaced"]


def test_write_that_was_not_carried_out_changes_no_ownership():
    story = Story()
    story.observer.asked_by_client(f"VNWRG,23,{FOREIGN}")
    story.unit.lies.not_held.add(23)
    story.write({23: FOREIGN})
    assert story.unit.memory.ram[23] == FACTORY
    story.unit.lies.not_held.clear()
    story.announce()
    story.prepare(values={23: GOOD[23]}, shown=FOREIGN)
    story.now_s += 5.0
    story.write({23: GOOD[23]})  # over the value from before the other program
    assert story.kinds == []


def test_unannounced_save_must_not_contain_values_of_the_daemon():
    story = Story()
    story.say("VNWNV")  # a client's save of the unit's own values
    assert story.kinds == []
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.say("VNWNV")
    assert story.kinds == ["unproven_saved"]


def test_foreign_value_that_the_unit_does_not_show_may_be_replaced():
    story = Story()
    story.cable.other_master(f"VNWRG,23,{FOREIGN}", story.now_s)
    story.unit.lies.not_held, story.unit.lies.reads_told = {23}, True
    story.observer.asked_by_client(f"VNWRG,23,{FACTORY}")
    story.write({23: FACTORY})
    assert story.unit.memory.ram[23] == FOREIGN
    assert story.unit.shown(23) == FACTORY
    story.now_s += 5.0
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    assert "foreign_replaced" not in story.kinds


def test_save_of_values_already_in_flash_makes_nothing_permanent():
    story = Story()
    story.unit.memory.flash[23] = story.unit.memory.ram[23] = FACTORY
    story.observer.look(story.now_s)
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.say("VNWNV")
    assert story.kinds == ["unproven_saved"]
    story.unit.restart(story.now_s)
    story.observer.look(story.now_s)
    story.say("VNWNV")
    assert story.kinds == ["unproven_saved"]


def test_foreign_value_from_before_the_first_reading_after_a_restart_belongs_to_the_unit():
    for reads_after_s in (0.0, 2.0):
        story = Story()
        story.observer.begun(story.now_s)
        story.now_s += 10.0
        story.say("VNRRG,84")
        story.unit.restart(story.now_s)
        story.now_s += 3.0
        if not reads_after_s:
            story.say("VNRRG,84")
        story.cable.other_master(f"VNWRG,84,{FOREIGN}", story.now_s)
        story.now_s += 5.0
        if reads_after_s:
            story.say("VNRRG,84")
        story.announce({23: GOOD[23]})
        story.prepare(values={23: GOOD[23]})
        story.write({23: GOOD[23]})
        story.record("PROVEN")
        story.save()
        assert story.kinds == ([] if reads_after_s else ["foreign_save"])


def test_values_written_and_saved_by_a_client_belong_to_it():
    story = Story()
    story.observer.asked_by_client(f"VNWRG,23,{FOREIGN}")
    story.write({23: FOREIGN})
    story.say("VNWNV")
    assert story.kinds == []
    assert story.observer.counts["client writes"] == 1
    story.write({23: GOOD[23]})  # overwrites it without a record
    assert "foreign_replaced" in story.kinds


def test_proven_without_both_values_in_the_device_is_a_violation():
    story = Story()
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.now_s += 5.0
    story.record("PROVEN")
    assert story.kinds == ["proven_not_held"]


@pytest.mark.parametrize("what", ["no restart", "restart before", "not saved", "another unit"])
def test_false_confirmation_is_a_violation(what):
    story = Story()
    story.unit.lies.not_saved = what == "not saved"
    if what == "restart before":
        story.unit.restart(story.now_s)
    story.now_s += 1.0
    story.to_flash()
    if what in ("not saved", "another unit"):
        story.unit.restart(story.now_s)
    if what == "another unit":
        story.cable.exchange(Unit(2, Iron(), story.unit.vehicle), story.now_s)
    story.now_s += 1.0
    story.record("CONFIRMED")
    assert story.kinds == ["false_confirmed"]


def test_all_kinds_of_violations_are_documented():
    assert set(KINDS) < set(write_histories.WRONG)


@pytest.mark.parametrize("stream", ["binary", "imu"])
def test_undisturbed_history_is_saved_and_confirmed(stream):
    tally = write_histories.HistoriesTally()
    with fitted():
        world = write_histories.run_at("silence", "never", tally, stream=stream, seed=1)
    assert tally.wrong == []
    assert (tally.seen["saves"], tally.seen["FLASH_ACKED"]) == (1, 1)
    # a stream without device time does not show the restart, so nothing is confirmed
    assert ("CONFIRMED" in world.kinds) is (stream == "binary")


def test_history_is_deterministic():
    with fitted():
        worlds = [write_histories.run_one(5, 2, write_histories.HistoriesTally()) for _ in range(2)]
    assert worlds[0].moments == worlds[1].moments
    assert worlds[0].states == worlds[1].states


def test_command_continues_where_it_ended(tmp_path):
    file = tmp_path / "found.json"
    command = [sys.executable, str(BENCHMARK), "--seed", "4", "--json", str(file)]
    for wanted in ("2", "2"):
        subprocess.run(
            [*command, "--histories", wanted], capture_output=True, check=False, timeout=300
        )
    found = json.loads(file.read_text())["parts"]["histories"]
    assert (found["runs"], found["tally"]["histories"], found["chunks"]) == (2, 2, [0])
