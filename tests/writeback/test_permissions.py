"""The gate over all commands: what a mode may send, and nothing else."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ahrsd.writeback.permissions import CALIBRATION, permitted
from ahrsd.writeback.states import Mode, Purpose
from drivers.vn100.commands import WORDS, Command, Pause, Read, Word, Write
from drivers.vn100.registers import REGISTERS, SESSION_SETTINGS

WRITES = [
    Write(row.id, row.defaults[generation])
    for row in REGISTERS.values()
    for generation in (2, 3)
    if row.writable and generation in row.defaults
]
SPOKEN = [Word(word, arguments) for word, takes in WORDS.items() for arguments in takes]
READS = [Read(number) for number in REGISTERS]
COMMANDS: list[Command] = [*WRITES, *SPOKEN, *READS]

modes = st.sampled_from(Mode)
OURS = [purpose for purpose in Purpose if purpose is not Purpose.CLIENT]
purposes = st.sampled_from(OURS)
commands = st.sampled_from(COMMANDS)


def allowed(mode: Mode, configure_stream: bool, purpose: Purpose) -> set[str]:
    """First words of the commands that pass, without reads."""
    passed = [c for c in COMMANDS if permitted(c, mode, configure_stream, purpose)]
    written = {str(c.register) for c in passed if isinstance(c, Write)}
    return written | {c.word for c in passed if isinstance(c, Word)}


def test_lists_of_commands_are_complete() -> None:
    assert {c.register for c in WRITES} >= {23, 84, 44, 26, 5, 6, 7, 75, 76, 77, 0, 21}
    assert {c.word for c in SPOKEN} >= {"VNWNV", "VNRST", "VNRFS", "VNASY", "VNSGB", "VNTAR"}


CALIBRATES = (23, 25, 26, 43, 44, 74, 84)
STREAM = {str(n) for n in SESSION_SETTINGS}
TABLE = {
    (Mode.STAGE, False, Purpose.STAGE): {"23", "84", "VNASY"},
    (Mode.STAGE, False, Purpose.ROLL_BACK): {"23", "84", "VNASY"},
    (Mode.COMMIT, False, Purpose.STAGE): {"23", "84", "VNASY"},
    (Mode.COMMIT, False, Purpose.ROLL_BACK): {"23", "84", "VNASY"},
    (Mode.COMMIT, False, Purpose.SAVE): {"VNASY", "VNWNV"},
    (Mode.COMMIT, True, Purpose.SAVE): {"VNASY", "VNWNV", *STREAM},
    (Mode.OBSERVE, True, Purpose.STREAM): {"VNASY", *STREAM},
    (Mode.STAGE, True, Purpose.STREAM): {"VNASY", *STREAM},
    (Mode.COMMIT, True, Purpose.STREAM): {"VNASY", *STREAM},
    (Mode.STAGE, False, Purpose.CLIENT_CALIBRATION): {str(n) for n in CALIBRATES},
    (Mode.COMMIT, False, Purpose.CLIENT_CALIBRATION): {str(n) for n in CALIBRATES},
}


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("configure_stream", [False, True])
@pytest.mark.parametrize("purpose", OURS)
def test_commands_allowed_per_mode_and_purpose(
    mode: Mode, configure_stream: bool, purpose: Purpose
) -> None:
    """If the table above has no row, or only one without the stream, nothing passes."""
    row = TABLE.get((mode, configure_stream, purpose), TABLE.get((mode, False, purpose), set()))
    assert allowed(mode, configure_stream, purpose) == row
    reads = [permitted(c, mode, configure_stream, purpose) for c in READS]
    assert set(reads) == {mode is not Mode.PASSIVE}


@pytest.mark.parametrize("mode", Mode)
@pytest.mark.parametrize("configure_stream", [False, True])
def test_client_commands_pass_in_every_mode_except_calibration_writes(
    mode: Mode, configure_stream: bool
) -> None:
    """`sharing.arbiter` decides before which client may send what."""
    passed = allowed(mode, configure_stream, Purpose.CLIENT)
    registers = {str(c.register) for c in WRITES} - {
        str(n) for n in (5, 23, 25, 26, 43, 44, 74, 84)
    }
    assert passed == registers | {"VNWNV", "VNRST", "VNKMD", "VNKAD"}
    assert all(permitted(c, mode, configure_stream, Purpose.CLIENT) for c in READS)


@given(st.sampled_from(WRITES), modes, st.booleans(), st.sets(st.sampled_from(sorted(REGISTERS))))
def test_save_may_restore_client_settings_but_no_calibration(
    command: Write, mode: Mode, stream: bool, clients: set[int]
) -> None:
    may = permitted(command, mode, stream, Purpose.SAVE, clients)
    theirs = command.register in clients - {5, 23, 25, 26, 43, 44, 74, 84}
    ours = stream and command.register in SESSION_SETTINGS
    assert may == (mode is Mode.COMMIT and (theirs or ours))


@given(commands, st.booleans(), purposes)
def test_passive_sends_nothing(command: Command, stream: bool, purpose: Purpose) -> None:
    assert not permitted(command, Mode.PASSIVE, stream, purpose)


@given(st.sampled_from([*WRITES, *SPOKEN]), purposes)
def test_observe_never_permits_a_write(command: Command, purpose: Purpose) -> None:
    assert not permitted(command, Mode.OBSERVE, False, purpose)


@given(st.sampled_from(WRITES), modes, st.booleans(), purposes)
def test_no_mode_writes_any_other_register(
    command: Write, mode: Mode, stream: bool, purpose: Purpose
) -> None:
    if permitted(command, mode, stream, purpose):
        client = purpose is Purpose.CLIENT_CALIBRATION
        calibrates = CALIBRATES if client else CALIBRATION
        assert command.register in {*calibrates, *SESSION_SETTINGS}
        assert command.register in SESSION_SETTINGS or mode >= Mode.STAGE


@given(commands, st.booleans(), purposes)
def test_vnwnv_only_in_commit_and_only_for_a_save(
    command: Command, stream: bool, purpose: Purpose
) -> None:
    save = Word("VNWNV")
    assert permitted(save, Mode.COMMIT, stream, purpose) == (purpose is Purpose.SAVE)
    assert not permitted(save, Mode.STAGE, stream, purpose)


@given(commands, modes, modes, st.booleans(), purposes)
def test_higher_mode_never_permits_less(
    command: Command, one: Mode, other: Mode, stream: bool, purpose: Purpose
) -> None:
    low, high = sorted((one, other))
    assert permitted(command, low, stream, purpose) <= permitted(command, high, stream, purpose)


@pytest.mark.parametrize("mode", Mode)
def test_pause_is_always_permitted(mode: Mode) -> None:
    assert permitted(Pause(1.0), mode, False, Purpose.READ)
