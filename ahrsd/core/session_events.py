"""Where a conversation with a device stands, and what it brought for the core."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from drivers.vn100.procedures import Identity, Seen
from drivers.vn100.registers import Values


class Phase(Enum):
    """Where the conversation stands."""

    CLOSED = "closed"
    IDENTIFYING = "identifying"
    READING = "reading registers"
    KEEPING = "keeping the user's outputs"
    SETTING_UP = "setting up the stream"
    READY = "ready"
    RUNNING = "running a procedure"
    LOOKING = "asking who answers and what it holds"
    RESTORING = "restoring"
    CLOSING = "noting that all is put back"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class Identified:
    """The device said who it is."""

    identity: Identity


@dataclass(frozen=True, slots=True)
class ConfigurationRead:
    """All registers; `first` where this reading is what must be put back at the end."""

    values: dict[int, Values]


@dataclass(frozen=True, slots=True)
class StreamChanged:
    """Outputs were set up or put back: samples before and after do not follow each other."""

    text: str
    level: str = "info"


@dataclass(frozen=True, slots=True)
class Unanswered:
    """The device does not say who it is; it is only listened to, and asked again now and then."""

    text: str


@dataclass(frozen=True, slots=True)
class Completed:
    """A procedure that was asked for with `run` ended: `error` None where it did what it should."""

    name: str
    result: object
    error: Exception | None


@dataclass(frozen=True, slots=True)
class Looked:
    """Who answered and what it holds; None where there was no answer, and why."""

    seen: Seen | None
    error: Exception | None = None


@dataclass(frozen=True, slots=True)
class Closed:
    """Everything is put back; `error` says what is not."""

    error: Exception | None


Said = Identified | ConfigurationRead | StreamChanged | Unanswered | Completed | Looked | Closed
