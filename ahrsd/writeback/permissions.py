"""The one gate: which command may become bytes, by mode and purpose.  Everything else may not.

| purpose | who | from mode |
|---|---|---|
| READ | identification, configuration, checks | observe |
| STREAM | output set up for the session and put back | observe, with `configure_stream` |
| STAGE | a transaction writes registers 23 and 84 in RAM | stage |
| ROLL_BACK | a transaction puts them back | stage |
| SAVE | session settings put back (with `configure_stream`), then VNWNV | commit |

A mode is a ceiling that a person sets; what the machine does below it is decided elsewhere, and
the interlock is asked there. This function is total: a command that no row names is refused.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Final

from drivers.vn100.commands import Command, Pause, Read, Word, Write
from drivers.vn100.procedures import SESSION_SETTINGS

CALIBRATION: Final = (23, 84)


class Mode(IntEnum):
    """How much a person allows; the order is the order of harm."""

    PASSIVE = 0
    OBSERVE = 1
    STAGE = 2
    COMMIT = 3


class Purpose(Enum):
    """Why a command is sent."""

    READ = "read"
    STREAM = "stream"
    STAGE = "stage"
    ROLL_BACK = "roll back"
    SAVE = "save"


NEEDS: Final[dict[Purpose, Mode]] = {
    Purpose.READ: Mode.OBSERVE,
    Purpose.STREAM: Mode.OBSERVE,
    Purpose.STAGE: Mode.STAGE,
    Purpose.ROLL_BACK: Mode.STAGE,
    Purpose.SAVE: Mode.COMMIT,
}
WRITES: Final[dict[Purpose, tuple[int, ...]]] = {
    Purpose.READ: (),
    Purpose.STREAM: SESSION_SETTINGS,
    Purpose.STAGE: CALIBRATION,
    Purpose.ROLL_BACK: CALIBRATION,
    Purpose.SAVE: (),
}
WORDS: Final[dict[Purpose, tuple[str, ...]]] = {
    Purpose.READ: (),
    Purpose.STREAM: ("VNASY",),
    Purpose.STAGE: ("VNASY",),
    Purpose.ROLL_BACK: ("VNASY",),
    Purpose.SAVE: ("VNASY", "VNWNV"),
}


def permitted(command: Command, mode: Mode, configure_stream: bool, purpose: Purpose) -> bool:
    """Whether `command` may be sent. A pause sends nothing and is always permitted."""
    if isinstance(command, Pause):
        return True
    if isinstance(command, Read):
        return mode >= Mode.OBSERVE
    if mode < NEEDS[purpose] or (purpose is Purpose.STREAM and not configure_stream):
        return False
    if isinstance(command, Write):
        ours = purpose is Purpose.SAVE and configure_stream  # put back before VNWNV saves all
        return command.register in (SESSION_SETTINGS if ours else WRITES[purpose])
    return isinstance(command, Word) and command.word in WORDS[purpose]
