"""Errors that a person can act on; each ends as one line on stderr and an exit code.

::

    AhrsdError (2)
    ├── RecordingError (2)   a recording that cannot be used: file, what, remedy
    ├── ConfigError (2)      a configuration that is wrong: one line per key
    ├── CaptureError (2)     a capture file that cannot be created
    ├── JournalError (1)     the journal cannot be written or trusted: no register may be written
    └── DeviceError (1, 75)  what the device or its port answered, in the words of the driver

Anything else that reaches the command line is a bug: traceback, exit 70.
"""

from __future__ import annotations

from ahrsd.printable import LINE, printable

EXIT_DONE = 0
EXIT_NO = 1
EXIT_USAGE = 2
EXIT_INTERNAL = 70
EXIT_BUSY = 75


class AhrsdError(Exception):
    """One line that says what is wrong, where, and what to do; `exit_code` is the process's."""

    exit_code: int = EXIT_USAGE


class RecordingError(AhrsdError):
    """A recording that no command can use."""

    def __init__(self, path: object, what: str, remedy: str) -> None:
        super().__init__(printable(f"{printable(path, 500)}: {what}; {remedy}", LINE))
        self.path = path
        self.what = what
        self.remedy = remedy


class ConfigError(AhrsdError):
    """A configuration that is wrong; `lines` has one entry per wrong key."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__("\n".join(lines))
        self.lines = lines


class CaptureError(AhrsdError):
    """A capture file that cannot be created."""


class JournalError(AhrsdError):
    """The journal cannot be made durable or is damaged; no register may be written meanwhile."""

    exit_code = EXIT_NO


class DeviceError(AhrsdError):
    """The device or its port said no."""

    def __init__(self, message: str, exit_code: int = EXIT_NO) -> None:
        super().__init__(message)
        self.exit_code = exit_code
