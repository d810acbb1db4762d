"""The observer of writes sees each wrong that it is there for, and none in a right history."""

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
    """A unit, its observer, and somebody who plays the daemon by hand."""

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


def test_a_right_story_is_right():
    story = Story()
    story.to_flash()
    story.unit.restart(story.now_s)
    story.now_s += 1.0
    story.observer.look(story.now_s)
    story.record("CONFIRMED")
    assert story.kinds == []
    assert story.observer.counts["saves"] == 1


def test_values_that_were_announced_for_another_unit():
    story = Story()
    story.announce()
    story.cable.exchange(Unit(2, Iron(), story.unit.vehicle, presets={6: "0"}), 10.0)
    story.prepare(serial=1)
    story.write()
    assert story.kinds == ["not_judged_here", "other_journal"] * 2


def test_values_that_nobody_announced_or_that_are_wrong_for_the_unit():
    story = Story()
    story.prepare()
    story.write({23: GOOD[23]})
    assert story.kinds == ["not_judged_here"]
    story = Story()
    story.announce({23: FOREIGN})
    story.prepare(values={23: FOREIGN})
    story.write({23: FOREIGN})
    assert story.kinds == ["not_judged_here"]


def test_old_values_of_another_unit_are_not_this_ones():
    story = Story()
    users = {23: FOREIGN, 6: "0"}
    story.cable.exchange(Unit(2, Iron(), story.unit.vehicle, presets=users), 10.0)
    story.prepare(serial=2)
    story.write({23: FACTORY})
    assert story.kinds == ["not_judged_here"]


def test_a_save_of_what_the_iron_made_wrong_a_while_ago():
    story = Story()
    story.announce()
    story.prepare()
    story.write()
    story.unit.vehicle.move_iron(np.array([0.05, 0.0, 0.0]), story.now_s)
    story.now_s += 10.0
    story.save()
    assert story.kinds == ["void_save"]


def test_a_save_just_after_the_iron_changed_is_nobodys_fault():
    story = Story()
    story.announce()
    story.prepare()
    story.write()
    story.unit.vehicle.move_iron(np.array([0.05, 0.0, 0.0]), story.now_s - 0.1)
    story.save()
    assert story.kinds == []


def test_iron_that_leaves_the_fields_length_as_it_is_shows_in_no_reading_at_rest():
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
    story.unit.vehicle.motion = Motion()  # had it turned, it would have shown
    story.save()
    assert story.kinds == ["void_save"]


def test_a_save_of_half_and_of_somebodys_values():
    story = Story()
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.now_s += 5.0
    story.save()
    assert story.kinds == ["half_save"]
    for saved_by_them in (False, True):
        story = Story()
        story.say("VNRRG,23")  # from here on somebody listens
        story.announce()
        story.prepare()
        story.write()
        story.cable.other_master(f"VNWRG,23,{FOREIGN}", story.now_s)
        if saved_by_them:
            story.cable.other_master("VNWNV", story.now_s)
        story.now_s += 5.0
        story.save()
        assert sorted(story.kinds) == ["foreign_save"] * (not saved_by_them) + ["half_save"]


def test_what_was_there_before_anybody_listened_is_the_units_own():
    story = Story()
    story.cable.other_master(f"VNWRG,84,{FOREIGN}", story.now_s)
    story.now_s += 5.0
    story.say("VNRRG,84")
    story.announce({23: GOOD[23]})
    story.prepare(values={23: GOOD[23]})
    story.write({23: GOOD[23]})
    story.save()
    assert story.kinds == []


def test_somebodys_values_are_not_replaced_unseen():
    story = Story()
    story.announce()
    story.prepare()
    story.cable.other_master(f"VNWRG,23,{FOREIGN}", story.now_s)
    story.observer.look(story.now_s)
    story.now_s += 5.0
    story.write({23: GOOD[23]})
    assert story.kinds == ["foreign_replaced"]


def test_a_write_that_the_unit_did_not_carry_out_makes_nothing_somebodys():
    story = Story()
    story.observer.asked_by_client(f"VNWRG,23,{FOREIGN}")
    story.unit.lies.not_held.add(23)
    story.write({23: FOREIGN})
    assert story.unit.memory.ram[23] == FACTORY
    story.unit.lies.not_held.clear()
    story.announce()
    story.prepare(values={23: GOOD[23]}, shown=FOREIGN)
    story.now_s += 5.0
    story.write({23: GOOD[23]})  # over what was there before the other program came
    assert story.kinds == []


def test_a_save_that_no_record_announced_may_hold_nothing_of_the_daemons():
    story = Story()
    story.say("VNWNV")  # a client's, of what the unit had
    assert story.kinds == []
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.say("VNWNV")
    assert story.kinds == ["unproven_saved"]


def test_a_register_that_shows_another_value_than_it_holds_is_replaced_unseen_by_anybody():
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


def test_a_save_of_what_is_in_flash_already_makes_nothing_permanent():
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


def test_somebodys_value_from_before_the_first_reading_behind_a_restart_is_the_units_own():
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


def test_what_a_client_wrote_and_saved_is_its_own():
    story = Story()
    story.observer.asked_by_client(f"VNWRG,23,{FOREIGN}")
    story.write({23: FOREIGN})
    story.say("VNWNV")
    assert story.kinds == []
    assert story.observer.counts["client writes"] == 1
    story.write({23: GOOD[23]})  # over it, and no record knows of it
    assert "foreign_replaced" in story.kinds


def test_proven_without_both_values_in_the_device():
    story = Story()
    story.announce()
    story.prepare()
    story.write({23: GOOD[23]})
    story.now_s += 5.0
    story.record("PROVEN")
    assert story.kinds == ["proven_not_held"]


@pytest.mark.parametrize("what", ["no restart", "restart before", "not saved", "another unit"])
def test_a_false_confirmed(what):
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


def test_all_kinds_are_named():
    assert set(KINDS) < set(write_histories.WRONG)


@pytest.mark.parametrize("stream", ["binary", "imu"])
def test_an_undisturbed_history_goes_to_flash_and_is_confirmed(stream):
    tally = write_histories.HistoriesTally()
    with fitted():
        world = write_histories.run_at("silence", "never", tally, stream=stream, seed=1)
    assert tally.wrong == []
    assert (tally.seen["saves"], tally.seen["FLASH_ACKED"]) == (1, 1)
    # a stream without device time does not show the restart: nothing is confirmed then
    assert ("CONFIRMED" in world.kinds) is (stream == "binary")


def test_a_history_is_the_same_each_time():
    with fitted():
        worlds = [write_histories.run_one(5, 2, write_histories.HistoriesTally()) for _ in range(2)]
    assert worlds[0].moments == worlds[1].moments
    assert worlds[0].states == worlds[1].states


def test_the_command_goes_on_where_it_ended(tmp_path):
    file = tmp_path / "found.json"
    command = [sys.executable, str(BENCHMARK), "--seed", "4", "--json", str(file)]
    for wanted in ("2", "2"):
        subprocess.run(
            [*command, "--histories", wanted], capture_output=True, check=False, timeout=300
        )
    found = json.loads(file.read_text())["parts"]["histories"]
    assert (found["runs"], found["tally"]["histories"], found["chunks"]) == (2, 2, [0])
