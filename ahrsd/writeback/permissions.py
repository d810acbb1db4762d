"""The only gate: which commands may be sent, by mode and purpose. No other command may.

| purpose | who | from mode |
|---|---|---|
| READ | identification, configuration, checks | observe |
| STREAM | output set up for the session and restored | observe, with `configure_stream` |
| STAGE | a transaction writes registers 23 and 84 in RAM | stage |
| ROLL_BACK | a transaction restores them | stage |
| SAVE | session settings restored (with `configure_stream`), then VNWNV | commit |
| CLIENT | command of a program on a shared port (`sharing.arbiter`) | passive |
| CLIENT_CALIBRATION | the same, of the owner with `calibration = "pass"` | stage |

A client's settings, in RAM for its session, are restored for a save like the daemon's own.

A mode is an upper limit that a person sets. What the write-back does within it, and the interlock,
are decided elsewhere. The function is total: a command that no row names is refused.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from ahrsd.writeback.states import Mode, Purpose
from drivers.vn100.commands import Command, Pause, Read, Word, Write
from drivers.vn100.registers import REGISTERS, SESSION_SETTINGS

CALIBRATION: Final = (23, 84)
GUARDED: Final = (5, 23, 25, 26, 43, 44, 74, 84)  # not for clients: line rate and calibration
PASSABLE: Final = tuple(n for n in GUARDED if n != 5)  # unless the client's share lets them pass

NEEDS: Final[dict[Purpose, Mode]] = {
    Purpose.READ: Mode.OBSERVE,
    Purpose.STREAM: Mode.OBSERVE,
    Purpose.STAGE: Mode.STAGE,
    Purpose.ROLL_BACK: Mode.STAGE,
    Purpose.SAVE: Mode.COMMIT,
    Purpose.CLIENT: Mode.PASSIVE,
    Purpose.CLIENT_CALIBRATION: Mode.STAGE,
}
WRITES: Final[dict[Purpose, tuple[int, ...]]] = {
    Purpose.READ: (),
    Purpose.STREAM: SESSION_SETTINGS,
    Purpose.STAGE: CALIBRATION,
    Purpose.ROLL_BACK: CALIBRATION,
    Purpose.SAVE: (),
    Purpose.CLIENT: tuple(n for n, row in REGISTERS.items() if row.writable and n not in GUARDED),
    Purpose.CLIENT_CALIBRATION: PASSABLE,
}
WORDS: Final[dict[Purpose, tuple[str, ...]]] = {
    Purpose.READ: (),
    Purpose.STREAM: ("VNASY",),
    Purpose.STAGE: ("VNASY",),
    Purpose.ROLL_BACK: ("VNASY",),
    Purpose.SAVE: ("VNASY", "VNWNV"),
    Purpose.CLIENT: ("VNWNV", "VNRST", "VNKMD", "VNKAD"),
    Purpose.CLIENT_CALIBRATION: (),
}


def permitted(
    command: Command,
    mode: Mode,
    configure_stream: bool,
    purpose: Purpose,
    clients: Collection[int] = (),
) -> bool:
    """Whether `command` may be sent. A pause sends nothing and is always permitted.

    clients: registers that hold a client's session settings
    """
    if isinstance(command, Pause):
        return True
    if isinstance(command, Read):
        return mode >= Mode.OBSERVE or purpose is Purpose.CLIENT
    if mode < NEEDS[purpose] or (purpose is Purpose.STREAM and not configure_stream):
        return False
    if isinstance(command, Write):
        if purpose is Purpose.SAVE:  # restored before VNWNV saves all of RAM
            ours = SESSION_SETTINGS if configure_stream else ()
            return command.register in ours or command.register in set(clients) - set(GUARDED)
        return command.register in WRITES[purpose]
    return isinstance(command, Word) and command.word in WORDS[purpose]
