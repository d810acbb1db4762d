"""Modes, purposes, states and transitions of the write-back.

`Mode` is how much an operator allows, `Purpose` is why a command is sent (`permissions` is the
table of both); the rest is the state machine.

Theory of operation
===================

A proposal for registers 23 and 84 waits until it is worth a write (CANDIDATE) and every gate has
passed (QUALIFIED). Approval opens a *transaction*. From PREPARING on, each step is journaled before
it is taken: nothing is sent until the record of the old register values is on the disk.

    CHECKING      async off, all registers read again and compared; nothing was changed yet
    STAGING       23 and 84 written and read back; from here on only ROLLING_BACK leads out
    STAGED        the device holds the new values in RAM; waits for the journal record of that
    TRIAL         the new values are compared with the old ones on the same samples
    PROVEN        better, or not worse, for long enough; still judged, and ended by whatever ends
                  a trial; the last state in mode `stage`
    SAVE_PREPARING waits for the journal record that flash is about to be written
    SAVING        session settings restored, every register compared, then VNWNV: one procedure
    COMMITTED     the device acknowledged; only a reading after its next reset gives CONFIRMED
    SET_ASIDE     values on trial are undone for a client's save or reset, and written again after
                  it; a reset leads through RECONCILING, where the device is read again

"verified", "proven", "committed" and "confirmed" are different words on purpose.

RECONCILING is entered at the start, whenever the link or the device was lost, and whenever another
device answers or this one has unexpected registers: the registers are read and compared with the
journal (`reconcile`), which gives the next state. FAULT is a device in a state that this program
cannot repair alone; FLASH_TORN one whose flash holds neither the old nor the new values. Neither
ends by itself. LOCKED: no writes until an operator unlocks. In FAULT "unlock" means: read again.

A signal that a state does not name is ignored there (and noted), never an error.
Power may be lost at any point; `reconcile` lists what may be found then.
"""

from __future__ import annotations

from enum import Enum, IntEnum, StrEnum
from typing import Final

# -- How much is allowed, and what for -------------------------------------------------------------


class Mode(IntEnum):
    """How much an operator allows, in order of increasing risk."""

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
    CLIENT = "client"
    CLIENT_CALIBRATION = "client's calibration"


# -- States, signals, and the table ----------------------------------------------------------------


class State(StrEnum):
    """State of the write-back; people and the journal see the value."""

    RECONCILING = "RECONCILING"
    OBSERVING = "OBSERVING"
    CANDIDATE = "CANDIDATE"
    QUALIFIED = "QUALIFIED"
    PREPARING = "PREPARING"
    CHECKING = "CHECKING"
    STAGING = "STAGING"
    STAGED = "STAGED"
    TRIAL = "TRIAL"
    PROVEN = "PROVEN"
    SAVE_PREPARING = "SAVE_PREPARING"
    SAVING = "SAVING"
    COMMITTED = "COMMITTED"
    CONFIRMED = "CONFIRMED"
    ROLLING_BACK = "ROLLING_BACK"
    ROLLED_BACK = "ROLLED_BACK"
    SET_ASIDE = "SET_ASIDE"
    FAULT = "FAULT"
    FLASH_TORN = "FLASH_TORN"
    LOCKED = "LOCKED"


class Signal(StrEnum):
    """Events for the state machine."""

    WORTH_WRITING = "worth writing"
    NOT_WORTH_WRITING = "not worth writing"
    GATES_PASSED = "gates passed"
    GATES_FAILED = "gates failed"
    APPROVED = "approved"
    JOURNALLED = "journalled"
    JOURNAL_FAILED = "journal failed"
    DONE = "done"
    DIFFERS = "device differs"
    FAILED = "failed"
    NOT_SENT = "not sent"
    TRIAL_PASSED = "trial passed"
    TRIAL_FAILED = "trial failed"
    SAVE_DUE = "save due"
    ROLL_BACK = "roll back"
    SET_ASIDE = "set aside"
    GO_ON = "trial goes on"
    TIMEOUT = "timeout"
    LINK_LOST = "link lost"
    DEVICE_RESET = "device reset"
    CLIENT_RESET = "reset by a client"
    IN_DOUBT = "device in doubt"
    LOCK = "lock"
    UNLOCK = "unlock"
    NOTHING_OPEN = "nothing open"
    RESUME_TRIAL = "resume trial"
    RESUME_PROVEN = "resume proven"
    RESUME_COMMITTED = "resume committed"
    READ_CONFIRMED = "read confirmed"
    UNDO = "undo"
    UNRESOLVED = "unresolved"
    FOREIGN = "foreign values"
    TORN = "torn"


S, E = State, Signal

_AWAY: Final = {
    E.LINK_LOST: S.RECONCILING,
    E.DEVICE_RESET: S.RECONCILING,
    E.CLIENT_RESET: S.RECONCILING,
    E.IN_DOUBT: S.RECONCILING,  # another device answers, or it holds what it should not
}
_WATCHING: Final = {**_AWAY, E.LOCK: S.LOCKED, E.WORTH_WRITING: S.CANDIDATE}

TABLE: Final[dict[State, dict[Signal, State]]] = {
    S.RECONCILING: {
        E.NOTHING_OPEN: S.OBSERVING,
        E.RESUME_TRIAL: S.TRIAL,
        E.RESUME_PROVEN: S.PROVEN,
        E.RESUME_COMMITTED: S.COMMITTED,
        E.READ_CONFIRMED: S.CONFIRMED,
        E.UNDO: S.ROLLING_BACK,
        E.UNRESOLVED: S.FAULT,
        E.TORN: S.FLASH_TORN,
        E.FOREIGN: S.LOCKED,
        E.SET_ASIDE: S.SET_ASIDE,  # a client reset the device, which is as it was
        E.TIMEOUT: S.RECONCILING,
        **_AWAY,
    },
    S.OBSERVING: _WATCHING,
    S.CANDIDATE: {
        **_AWAY,
        E.LOCK: S.LOCKED,
        E.NOT_WORTH_WRITING: S.OBSERVING,
        E.GATES_PASSED: S.QUALIFIED,
    },
    S.QUALIFIED: {
        **_AWAY,
        E.LOCK: S.LOCKED,
        E.NOT_WORTH_WRITING: S.OBSERVING,
        E.GATES_FAILED: S.CANDIDATE,
        E.APPROVED: S.PREPARING,
        E.TIMEOUT: S.CANDIDATE,
    },
    S.PREPARING: {
        **_AWAY,
        E.JOURNALLED: S.CHECKING,
        E.JOURNAL_FAILED: S.OBSERVING,
        E.ROLL_BACK: S.OBSERVING,
        E.TIMEOUT: S.OBSERVING,
    },
    S.CHECKING: {
        **_AWAY,
        E.DONE: S.STAGING,
        E.DIFFERS: S.OBSERVING,
        E.FAILED: S.OBSERVING,
        E.ROLL_BACK: S.OBSERVING,
        E.TIMEOUT: S.OBSERVING,
    },
    S.STAGING: {
        **_AWAY,
        E.DONE: S.STAGED,
        E.DIFFERS: S.FAULT,
        E.FAILED: S.ROLLING_BACK,
        E.ROLL_BACK: S.ROLLING_BACK,
        E.TIMEOUT: S.ROLLING_BACK,
    },
    S.STAGED: {
        **_AWAY,
        E.JOURNALLED: S.TRIAL,
        E.JOURNAL_FAILED: S.ROLLING_BACK,
        E.ROLL_BACK: S.ROLLING_BACK,
        E.TIMEOUT: S.ROLLING_BACK,
    },
    S.TRIAL: {
        **_AWAY,
        E.TRIAL_PASSED: S.PROVEN,
        E.TRIAL_FAILED: S.ROLLING_BACK,
        E.ROLL_BACK: S.ROLLING_BACK,
        E.TIMEOUT: S.ROLLING_BACK,
    },
    S.PROVEN: {
        **_AWAY,
        E.SAVE_DUE: S.SAVE_PREPARING,
        E.TRIAL_FAILED: S.ROLLING_BACK,
        E.ROLL_BACK: S.ROLLING_BACK,
        E.TIMEOUT: S.ROLLING_BACK,
    },
    S.SAVE_PREPARING: {
        **_AWAY,
        E.JOURNALLED: S.SAVING,
        E.JOURNAL_FAILED: S.PROVEN,
        E.ROLL_BACK: S.ROLLING_BACK,
        E.TIMEOUT: S.PROVEN,
    },
    S.SAVING: {
        **_AWAY,
        E.DONE: S.COMMITTED,
        E.NOT_SENT: S.PROVEN,
        E.FAILED: S.FAULT,
        E.TIMEOUT: S.FAULT,
    },
    S.COMMITTED: _WATCHING,
    S.CONFIRMED: _WATCHING,
    S.ROLLING_BACK: {
        **_AWAY,
        E.DONE: S.ROLLED_BACK,
        E.SET_ASIDE: S.SET_ASIDE,
        E.FAILED: S.FAULT,
        E.TIMEOUT: S.FAULT,
    },
    S.ROLLED_BACK: _WATCHING,
    S.SET_ASIDE: {
        **_AWAY,
        E.GO_ON: S.PREPARING,
        E.ROLL_BACK: S.ROLLED_BACK,  # the old values are in RAM already: the trial is over
        E.TIMEOUT: S.ROLLED_BACK,
    },
    S.FAULT: {**_AWAY, E.ROLL_BACK: S.ROLLING_BACK, E.UNLOCK: S.RECONCILING},
    S.FLASH_TORN: {**_AWAY, E.UNLOCK: S.OBSERVING},
    S.LOCKED: {**_AWAY, E.UNLOCK: S.OBSERVING},
}

# States with a time limit, the limit, and the next state: the TIMEOUT edges of the table, repeated
# here so that a reader sees all of them at once.
ON_TIMEOUT: Final[dict[State, tuple[float, State]]] = {
    S.RECONCILING: (30.0, S.RECONCILING),  # keeps waiting for the device, says so once
    S.QUALIFIED: (600.0, S.CANDIDATE),  # an approval must be of what is true now
    S.PREPARING: (5.0, S.OBSERVING),  # nothing was sent
    S.CHECKING: (30.0, S.OBSERVING),  # nothing was changed
    S.STAGING: (30.0, S.ROLLING_BACK),  # it may have been changed
    S.STAGED: (5.0, S.ROLLING_BACK),
    S.TRIAL: (60.0, S.ROLLING_BACK),  # since the last finite metric: unjudged is not proven
    S.PROVEN: (600.0, S.ROLLING_BACK),  # since the last finite metric: a proof ages
    S.SAVE_PREPARING: (5.0, S.PROVEN),  # VNWNV was not sent
    S.SAVING: (30.0, S.FAULT),  # it may have been carried out: only a reset tells
    S.ROLLING_BACK: (30.0, S.FAULT),
    S.SET_ASIDE: (30.0, S.ROLLED_BACK),  # a later write would be a new one, with a new approval
}

# The device's RAM may hold values of a transaction that are not in flash; the vehicle uses them.
CHANGED_IN_RAM: Final = frozenset(
    {
        S.STAGING,
        S.STAGED,
        S.TRIAL,
        S.PROVEN,
        S.SAVE_PREPARING,
        S.SAVING,
        S.ROLLING_BACK,
    }
)
# The vehicle uses new values that may still be undone: whatever voids them ends these states.
LIVED_WITH: Final = frozenset({S.TRIAL, S.PROVEN, S.SAVE_PREPARING, S.SAVING})
WITHOUT_TRANSACTION: Final = frozenset(
    {S.OBSERVING, S.CANDIDATE, S.QUALIFIED, S.COMMITTED, S.CONFIRMED, S.ROLLED_BACK}
)
