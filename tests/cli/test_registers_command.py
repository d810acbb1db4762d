"""`ahrsd registers` against the emulated device: what it says, writes, journals and undoes."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace

import pytest

from ahrsd.cli.device.register_changes import apply, gate, save_to_flash
from ahrsd.daemon.journal import Journal, Record, journal_path
from ahrsd.errors import DeviceError, JournalError
from drivers.serial_port import SerialPort
from drivers.vn100.commands import Read, Unsteady, identify
from drivers.vn100.device import Device

SERIAL = 100130608
BAUD = ("--baud", "115200")
NEW = ["1.1", "0", "0", "0", "1", "0", "0", "0", "0.9", "0.125", "-0.0625", "0.03"]
NEW_VALUES = (1.1, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.9, 0.125, -0.0625, 0.03)
IDENTITY = ["1", "0", "0", "0", "1", "0", "0", "0", "1", "0", "0", "0"]
BIAS = ["1", "0", "0", "0", "1", "0", "0", "0", "1", "0.01", "0", "0"]
FACTORY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def kinds(tmp_path) -> list[str]:
    return [record.kind for record in Journal.open(journal_path(tmp_path, SERIAL)).records()]


def ram(emulator, number: int = 23) -> tuple[float, ...]:
    return tuple(round(float(value), 6) for value in emulator.memory.get(number))


def test_read_prints_a_table_or_json(run, emulated, capsys):
    with emulated() as (_, path):
        assert run("registers", "read", path, "23", "4", *BAUD) == 0
        table = capsys.readouterr().out.splitlines()
        assert run("registers", "read", path, "--json", "-", *BAUD) == 0
    assert table[0].startswith("VN-100")
    assert f"serial {SERIAL}, firmware 3.1.0.0" in table[0]
    assert table[1:] == [
        " 23  Magnetometer Calibration",
        "     c [1 0 0; 0 1 0; 0 0 1]  b [0 0 0] gauss",
        "  4  Firmware Version",
        "     version 3.1.0.0",
    ]
    body = json.loads(capsys.readouterr().out)
    assert body["schema"] == "ahrsd.registers/1"
    assert body["device"]["serial"] == str(SERIAL)
    assert tuple(body["registers"]["23"]) == FACTORY
    assert len(body["registers"]) > 15


def test_reading_sends_nothing_but_reads(run, emulated, capsys):
    with emulated() as (emulator, path):
        before = {n: emulator.memory.get(n) for n in (23, 26, 75, 84)}
        assert run("registers", "read", path, *BAUD) == 0
        assert {n: emulator.memory.get(n) for n in before} == before
        assert emulator.counters["saves"] == 0


def test_write_is_journaled_verified_and_explains_the_rollback(run, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):
        code = run("registers", "write", path, 23, *NEW, "--yes",
                   "--state-directory", tmp_path, *BAUD)  # fmt: skip
        assert code == 0
        assert ram(emulator) == NEW_VALUES
        assert emulator.counters["saves"] == 0
    assert kinds(tmp_path) == ["HAND_PREPARED", "HAND_VERIFIED"]
    record = Journal.open(journal_path(tmp_path, SERIAL)).records()[0]
    assert tuple(record.facts["old"]["23"]) == FACTORY
    assert record.facts["device"]["serial"] == str(SERIAL)
    shown = capsys.readouterr().out
    assert f"ahrsd registers rollback {path} 1 --yes" in shown
    assert "$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76" in shown


@pytest.mark.parametrize("by", ["--state-directory", "default"])
def test_the_command_that_is_printed_works_when_it_is_pasted(
    run, emulated, tmp_path, capsys, monkeypatch, by
):
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "of the user"))
    place = () if by == "default" else (by, tmp_path / "with a blank")
    with emulated() as (emulator, path):
        assert run("registers", "write", path, 23, *NEW, "--yes", *place, *BAUD) == 0
        assert ram(emulator) == NEW_VALUES
        shown = capsys.readouterr().out
        (line,) = [line for line in shown.splitlines() if line.startswith("to go back: ")]
        pasted = shlex.split(line.removeprefix("to go back: ").removesuffix(", or send"))
        assert pasted[0] == "ahrsd"
        assert run(*pasted[1:]) == 0
        assert ram(emulator) == FACTORY


def test_without_yes_nothing_is_written(run, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):
        assert run("registers", "write", path, 23, ",".join(NEW),
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
        assert ram(emulator) == FACTORY
    assert list(tmp_path.iterdir()) == []
    output = capsys.readouterr()
    assert "nothing was written; add --yes to do it" in output.out
    assert output.err == ""
    assert "new  c [1.1 0 0; 0 1 0; 0 0 0.9]  b [0.125 -0.0625 0.03] gauss" in output.out


def test_unchanged_values_are_not_written_again(run, emulated, tmp_path, capsys):
    with emulated() as (_, path):
        assert run("registers", "write", path, 23, *IDENTITY, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
    assert "holds the wanted values already" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_rollback_finds_the_change_in_force(run, emulated, tmp_path, capsys):
    options = ("--yes", "--state-directory", tmp_path, *BAUD)
    with emulated() as (emulator, path):
        assert run("registers", "write", path, 23, *NEW, *options) == 0
        assert run("registers", "write", path, 84, *BIAS,
                   *options) == 0  # fmt: skip
        assert run("registers", "rollback", path, *options) == 0
        assert ram(emulator, 84) == FACTORY
        assert ram(emulator) == NEW_VALUES
        assert run("registers", "rollback", path, *options) == 0
        assert ram(emulator) == FACTORY
        assert run("registers", "rollback", path, *options) == 1
        assert "none of the journal's changes" in capsys.readouterr().err
        assert run("registers", "rollback", path, "99", *options) == 1
        assert "record 99 is no change; changes are: 1, 3, 5, 7" in capsys.readouterr().err
    capsys.readouterr()
    assert run("registers", "history", "--state-directory", tmp_path) == 0
    shown = capsys.readouterr().out
    assert "journal-100130608.jsonl: 8 records" in shown
    assert "reason=rollback undoes=3" in shown
    assert "to go back send  $VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*76" in shown


def test_save_writes_flash_once_and_journals_it(run, emulated, tmp_path):
    with emulated() as (emulator, path):
        assert run("registers", "write", path, 23, *NEW, "--yes", "--save",
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
        assert emulator.counters["saves"] == 1
    assert kinds(tmp_path) == [
        "HAND_PREPARED",
        "HAND_VERIFIED",
        "HAND_FLASH_SENT",
        "HAND_FLASH_ACKED",
    ]


def test_refused_write_leaves_the_device_unchanged(run, emulated, tmp_path, capsys):
    with emulated(faults=("refused_write",)) as (emulator, path):
        assert run("registers", "write", path, 23, *NEW, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 1  # fmt: skip
        assert ram(emulator) == FACTORY
    assert kinds(tmp_path) == ["HAND_PREPARED", "HAND_FAILED"]
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "the old values are back" in error


@pytest.mark.parametrize(
    ("number", "values", "words"),
    [
        (5, ("9600",), "register 5 is not written: the device would answer at its new rate"),
        (6, ("0", "2"), "register 6 is written for the connected port only"),
        (7, ("1", "1"), "register 7 is written for the connected port only"),
    ],
)
def test_what_cannot_be_read_back_is_not_written(
    run, emulated, tmp_path, capsys, number, values, words
):
    with emulated() as (emulator, path):
        assert run("registers", "write", path, number, *values, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 2  # fmt: skip
        assert emulator.memory.ram == emulator.memory.flash
    assert words in capsys.readouterr().err
    assert kinds(tmp_path) == []


def on_trial(tmp_path, emulator) -> None:
    """A daemon that was killed while it had values on trial."""
    old, new = {"23": FACTORY, "84": FACTORY}, {"23": NEW_VALUES, "84": tuple(map(float, BIAS))}
    facts = {"serial": SERIAL, "txn": "a-1", "firmware": "3.1.0.0", "snapshot": {},
             "heading_change_deg": 9.0, "approver": "operator", "old": old, "new": new}  # fmt: skip
    journal = Journal.open(journal_path(tmp_path, SERIAL))
    journal.append("PREPARED", **facts)
    journal.append("RAM_VERIFIED", txn="a-1")
    for number, values in new.items():
        emulator.memory.preset(int(number), values)


def test_save_by_hand_keeps_no_values_of_a_trial(run, emulated, tmp_path, capsys):
    state = ("--state-directory", tmp_path, *BAUD)
    with emulated() as (emulator, path):
        on_trial(tmp_path, emulator)
        assert run("registers", "write", path, 35, 1, 0, 1, 1, "--yes", "--save", *state) == 1
        assert "unproven values of a trial in registers 23, 84" in capsys.readouterr().err
        assert emulator.memory.get(35) == (1, 1, 1, 1)
        assert emulator.counters["saves"] == 0
        assert run("registers", "rollback", path, 1, "--yes", "--save", *state) == 0
        assert ram(emulator) == ram(emulator, 84) == FACTORY
        assert emulator.counters["saves"] == 1


def test_values_of_a_trial_are_saved_when_a_person_names_them(run, emulated, tmp_path):
    with emulated() as (emulator, path):
        on_trial(tmp_path, emulator)
        emulator.memory.preset(84, FACTORY)
        assert run("registers", "write", path, 23, *NEW, "--yes", "--save",
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
        assert emulator.counters["saves"] == 1


def test_save_by_hand_keeps_no_outputs_of_a_killed_session(run, emulated, tmp_path, capsys):
    state, kept = ("--state-directory", tmp_path, *BAUD), {"6": [14], "75": [0, 1, 0]}
    with emulated() as (emulator, path):
        journal = Journal.open(journal_path(tmp_path, SERIAL))
        journal.append("OUTPUTS_KEPT", serial=SERIAL, old=kept)
        emulator.memory.preset(6, (0,))
        emulator.memory.preset(75, (1, 8, 1, 0x0829))
        assert run("registers", "write", path, 23, *NEW, "--yes", "--save", *state) == 1
        assert "the outputs of a killed session" in capsys.readouterr().err
        assert ram(emulator) == FACTORY
        assert emulator.counters["saves"] == 0
        assert run("registers", "rollback", path, 1, "--yes", "--save", *state) == 0
        assert (emulator.memory.get(6, 1), emulator.memory.get(75)) == ((14,), (0, 1, 0))


def test_values_that_could_not_be_put_back_are_not_replaced(run, emulated, tmp_path, capsys):
    dust = (1.0, *(-3.02119e-30,) * 3, 1.0, *(-3.02119e-30,) * 3, 1.0, 0.1, 0.2, 0.3)
    with emulated() as (emulator, path):
        emulator.memory.preset(23, dust)
        held = emulator.memory.get(23)
        assert run("registers", "write", path, 23, *NEW, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 2  # fmt: skip
        assert emulator.memory.get(23) == held
    assert "the present values could not be put back" in capsys.readouterr().err


def test_rotation_is_said_to_act_after_a_restart(run, emulated, tmp_path, capsys):
    turned = ("0", "1", "0", "-1", "0", "0", "0", "0", "1")
    with emulated() as (_, path):
        assert run("registers", "write", path, 26, *turned, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
    said = capsys.readouterr().out.splitlines()
    assert said[-1].startswith(
        "register 26 acts only once it is saved and the device has restarted"
    )


def test_rollback_finds_a_write_that_was_broken_off(run, emulated, tmp_path):
    with emulated() as (emulator, path):
        on_trial(tmp_path, emulator)
        emulator.memory.preset(84, FACTORY)
        assert run("registers", "rollback", path, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
        assert ram(emulator) == ram(emulator, 84) == FACTORY


def test_another_unit_is_neither_written_nor_put_back(emulated, tmp_path):
    with emulated() as (emulator, path), SerialPort(path, 115200) as port:
        device = Device(port, gate({23}, save=False))
        judged = replace(device.run(identify()), serial=SERIAL + 1)
        journal = Journal.open(tmp_path / "j.jsonl")
        with pytest.raises(DeviceError, match=f"another.*NOT put back.*{SERIAL}, not {SERIAL + 1}"):
            apply(device, journal, judged, {23: NEW_VALUES})
        assert ram(emulator) == FACTORY


class FirstReadingAltered(Device):
    """Of what is read of register 23, the first reading is altered on its way."""

    altered = False

    def run(self, procedure, timeout_s=60.0):
        return super().run(self._alter(procedure), timeout_s)

    def _alter(self, procedure):
        reply = None
        try:
            while True:
                command = procedure.send(reply)
                reply = yield command
                if command == Read(23) and not self.altered:
                    self.altered = True
                    reply = replace(reply, tokens=("2", *reply.tokens[1:]))
        except StopIteration as end:
            return end.value


def test_altered_reading_is_never_put_back(emulated, tmp_path):
    """What the journal calls old is what `rollback` writes."""
    with emulated() as (emulator, path), SerialPort(path, 115200) as port:
        device = FirstReadingAltered(port, gate({23}, save=False))
        journal, identity = Journal.open(tmp_path / "j.jsonl"), device.run(identify())
        with pytest.raises(Unsteady, match=r"register 23 reads \(2.0, .*, then \(1.0, "):
            apply(device, journal, identity, {23: NEW_VALUES})
        assert ram(emulator) == FACTORY
    assert journal.records() == []


class FullDisk(Journal):
    """A journal that cannot take records of one kind."""

    kind = ""

    def append(self, kind: str, **facts: object) -> Record:
        if kind == self.kind:
            raise JournalError("the disk is full")
        return super().append(kind, **facts)


@pytest.mark.parametrize(
    ("kind", "said", "holds"),
    [
        ("HAND_PREPARED", "^the disk is full", FACTORY),
        ("HAND_VERIFIED", "^the new values are in RAM, written and verified; not rec", NEW_VALUES),
        ("HAND_FAILED", "; the old values are back; not recorded: the disk is full", FACTORY),
        ("HAND_FLASH_SENT", "^not saved to flash: the new values are in RAM only; not", NEW_VALUES),
        ("HAND_FLASH_ACKED", "^saved to flash; not recorded: the disk is full", NEW_VALUES),
    ],
)
def test_full_disk_behind_a_write_does_not_hide_what_was_done(
    emulated, tmp_path, kind, said, holds
):
    faults = ("refused_write",) if kind == "HAND_FAILED" else ()
    with emulated(faults=faults) as (emulator, path), SerialPort(path, 115200) as port:
        device = Device(port, gate({23}, save=True))
        identity = device.run(identify())
        journal = FullDisk(tmp_path / "j.jsonl", [], 0, b"", lambda: "")
        journal.kind = kind
        with pytest.raises(JournalError, match=said):
            record = apply(device, journal, identity, {23: NEW_VALUES})
            save_to_flash(device, journal, identity, record)
        assert ram(emulator) == holds
        assert emulator.counters["saves"] == (kind == "HAND_FLASH_ACKED")


def test_save_without_an_answer_is_told_as_unknown(run, emulated, tmp_path, capsys):
    with emulated(faults=("power_cut_wnv@0",)) as (_, path):
        assert run("registers", "write", path, 23, *NEW, "--yes", "--save",
                   "--state-directory", tmp_path, *BAUD) == 1  # fmt: skip
    assert "whether it was saved is not known: switch the device off" in capsys.readouterr().err
    assert kinds(tmp_path)[-1] == "HAND_FLASH_SENT"


def test_without_a_journal_nothing_is_written(run, emulated, tmp_path, capsys):
    (tmp_path / "state").write_text("a file where the folder should be")
    with emulated() as (emulator, path):
        assert run("registers", "write", path, 23, *NEW, "--yes",
                   "--state-directory", tmp_path / "state", *BAUD) == 1  # fmt: skip
        assert ram(emulator) == FACTORY
    assert "nothing will be written to the device" in capsys.readouterr().err


def test_unknown_firmware_is_never_written(run, emulated, tmp_path, capsys):
    with emulated(scenario="unknown-firmware") as (emulator, path):
        assert run("registers", "write", path, 23, *NEW, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 2  # fmt: skip
        assert ram(emulator) == FACTORY
    assert "firmware 7.0.0.0 is unknown" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["23", "1", "2"], "register 23: 2 values, at least 12 needed"),
        (["23", *["1", "0", "0", "0", "1", "0", "0", "0", "x", "0", "0", "0"]], "'x' is no f32"),
        (["4", "3.1"], "register 4 is never written: it is read only"),
        (["200", "1"], "the VN-100 has no register 200"),
        (["23", *["0"] * 12], "the correction matrix of register 23 is not positive definite"),
        (["84", *["0"] * 12], "the correction matrix of register 84 is not positive definite"),
        (["25", *["0"] * 12], "the correction matrix of register 25 is not positive definite"),
        (["23", "-1", *IDENTITY[1:]], "a rotation of the axes belongs in register 26"),
        (["23", *IDENTITY[:8], "0.1", "0", "0", "0"], "has the condition 10.0, limit 8.0"),
        (["23", *["100" if v == "1" else v for v in IDENTITY]], "multiplies by 100, limits 0.2"),
        (["84", *["57.3" if v == "1" else v for v in IDENTITY]], "multiplies by 57.3, limits 0.2"),
        (["23", *IDENTITY[:9], "12", "0", "0"], "hard iron 12 gauss, limit 1.3 gauss"),
        (["25", *IDENTITY[:9], "0", "0", "9.81"], "accelerometer bias 9.81 m/s^2, limit 5.0 m/s^2"),
        (["84", *IDENTITY[:9], "0.5", "0", "0"], "gyro bias 0.5 rad/s, limit 0.175 rad/s"),
    ],
)
def test_wrong_values_never_reach_the_port(run, arguments, words, capsys):
    assert run("registers", "write", "/dev/does-not-exist", *arguments, "--yes") == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_missing_port_is_code_75(run, capsys):
    assert run("registers", "read", "/dev/does-not-exist", *BAUD) == 75
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "/dev/does-not-exist does not exist" in error


def test_diff_of_device_file_and_journal(run, emulated, tmp_path, capsys):
    state = ("--state-directory", tmp_path)
    (tmp_path / "calibration.json").write_text(json.dumps({"registers": {"23": NEW_VALUES}}))
    with emulated() as (_, path):
        assert run("registers", "read", path, "--json", tmp_path / "a.json", *BAUD) == 0
        assert run("registers", "diff", tmp_path / "a.json", path, *BAUD, *state) == 0
        capsys.readouterr()
        assert run("registers", "diff", path, tmp_path / "calibration.json", *BAUD) == 1
        shown = capsys.readouterr().out.splitlines()
        assert shown[1:] == [
            "  -  c [1 0 0; 0 1 0; 0 0 1]  b [0 0 0] gauss",
            "  +  c [1.1 0 0; 0 1 0; 0 0 0.9]  b [0.125 -0.0625 0.03] gauss",
            "1 register compared, 1 differ",
        ]
        assert run("registers", "write", path, 23, *NEW, "--yes", *state, *BAUD) == 0
        assert run("registers", "diff", "1:new", path, *state, *BAUD) == 0
        assert run("registers", "diff", "1", path, *state, *BAUD) == 1
    assert run("registers", "diff", "1", tmp_path / "calibration.json", *state) == 1
    assert run("registers", "diff", "1:new", tmp_path / "calibration.json", *state) == 0


@pytest.mark.parametrize(
    ("first", "code", "words"),
    [
        ("missing.json", 2, "cannot be read: No such file"),
        ("other.json", 2, 'has no "registers"'),
        ("unknown.json", 2, "register 200 is no register"),
        ("1", 1, "there is no journal"),
        ("empty.json", 2, "have no register in common"),
    ],
)
def test_diff_of_invalid_registers_is_refused(
    run, tmp_path, monkeypatch, capsys, first, code, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.json").write_text('{"a": 1}')
    (tmp_path / "unknown.json").write_text('{"registers": {"200": [1]}}')
    (tmp_path / "empty.json").write_text('{"registers": {}}')
    (tmp_path / "good.json").write_text('{"registers": {"23": [1]}}')
    assert run("registers", "diff", first, "good.json", "--state-directory", tmp_path) == code
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


# -- write --from ----------------------------------------------------------------------------------


def calibration(folder, **changes):
    body = {
        "schema": "ahrsd.calibration/1", "converged": True, "warnings": [],
        "device": {"serial": SERIAL},
        "registers": {"23": list(NEW_VALUES), "84": [*FACTORY[:9], 0.01, 0, 0]},
        "registers_in_force": {"23": list(FACTORY), "84": list(FACTORY)},
    }  # fmt: skip
    path = folder / "calibration.json"
    path.write_text(json.dumps(body | changes))
    return path


@pytest.fixture
def write_from(run, tmp_path):
    def call(port, path, *options):
        words = ("registers", "write", port, "--from", path, "--state-directory", tmp_path)
        return run(*words, *BAUD, *options)

    return call


def test_a_calibration_is_written_whole_journaled_and_can_be_undone(
    run, write_from, emulated, tmp_path, capsys
):
    with emulated() as (emulator, port):
        before = {n: emulator.memory.get(n) for n in (23, 84)}
        path = calibration(tmp_path)
        assert write_from(port, path) == 0  # only said
        assert {n: emulator.memory.get(n) for n in (23, 84)} == before
        assert write_from(port, path, "--yes") == 0
        assert ram(emulator) == NEW_VALUES
        assert ram(emulator, 84) == (*FACTORY[:9], 0.01, 0.0, 0.0)
        assert emulator.counters["saves"] == 0
        assert write_from(port, path, "--yes") == 0  # it holds them already
        assert "holds the wanted values already" in capsys.readouterr().out
        assert run("registers", "rollback", port, "--yes",
                   "--state-directory", tmp_path, *BAUD) == 0  # fmt: skip
        assert {n: emulator.memory.get(n) for n in (23, 84)} == before
    records = Journal.open(journal_path(tmp_path, SERIAL)).records()
    assert [r.kind for r in records] == ["HAND_PREPARED", "HAND_VERIFIED"] * 2
    assert records[0].facts["calibration"] == "calibration.json"


def test_restart_between_two_writes_leaves_no_half_a_calibration(
    write_from, emulated, tmp_path, capsys
):
    with emulated(faults=("power_cut_wrg=2@0",)) as (emulator, port):
        assert write_from(port, calibration(tmp_path), "--yes") == 1
        assert emulator.counters["restarts"] == 1
        assert ram(emulator) == ram(emulator, 84) == FACTORY
    assert kinds(tmp_path) == ["HAND_PREPARED", "HAND_FAILED"]
    assert "the old values are back" in capsys.readouterr().err


FLIPPED = [-1.0, *FACTORY[1:]]
FAR = [*FACTORY[:9], 1.4, 0, 0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": "ahrsd.registers/1"}, "is no calibration.json"),
        ({"converged": False, "warnings": ["turn further"]}, "must not be written: turn further"),
        ({"registers": {}}, "it must not be written"),
        ({"registers": {"6": [0]}}, "has no register 23"),
        ({"registers": {"23": [1, 2]}}, "registers 23: "),
        ({"registers": {"23": ["nan", *FACTORY[1:]]}}, "registers 23: "),
        ({"registers": {"23": FLIPPED}}, "register 23 is not positive definite"),
        ({"registers": {"23": FAR}}, "hard iron 1.4 gauss, limit 1.3"),
        ({"registers_in_force": {}}, "it is not known which registers were in force"),
        ({"registers_in_force": {"23": list(NEW_VALUES), "84": list(FACTORY)},
          "registers": {"84": [*FACTORY[:9], 0.01, 0, 0]}},
         "register 23 of the device is not what was in force"),
        ({"device": None}, "does not say of which device it is; give --serial"),
        ({"device": {"serial": 7}}, f"is of the device 7, and this one is {SERIAL}"),
    ],
)  # fmt: skip
def test_forbidden_write_is_refused_in_one_line(
    write_from, emulated, tmp_path, capsys, changes, words
):
    with emulated() as (emulator, port):
        before = dict(emulator.memory.ram)
        assert write_from(port, calibration(tmp_path, **changes), "--yes") in (1, 2)
        assert emulator.memory.ram == before
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert kinds(tmp_path) == []


def test_a_person_may_say_which_device_it_is(write_from, emulated, tmp_path, capsys):
    path = calibration(tmp_path, device=None)
    with emulated() as (emulator, port):
        assert write_from(port, path, "--serial", 7, "--yes") == 2
        assert write_from(port, path, "--serial", SERIAL, "--yes") == 0
        assert ram(emulator) == NEW_VALUES
    path = calibration(tmp_path)
    assert write_from("/dev/null", path, "--serial", 7, "--yes") == 2
    assert f"is of the device {SERIAL}, not of 7" in capsys.readouterr().err


def test_a_lock_holds_for_a_calibration_too(run, write_from, emulated, tmp_path, capsys):
    with emulated() as (emulator, port):
        assert run("registers", "lock", "crew aboard", "--serial", SERIAL,
                   "--state-directory", tmp_path) == 0  # fmt: skip
        before = dict(emulator.memory.ram)
        assert write_from(port, calibration(tmp_path), "--yes") == 1
        assert emulator.memory.ram == before
    assert "locked: crew aboard" in capsys.readouterr().err


def test_either_values_or_a_file(run, tmp_path):
    path = calibration(tmp_path)
    assert run("registers", "write", "/dev/null", 23, *NEW, "--from", path) == 2
    assert run("registers", "write", "/dev/null") == 2
    assert run("registers", "write", "/dev/null", 23) == 2
    assert run("registers", "write", "/dev/null", 222, *NEW) == 2
