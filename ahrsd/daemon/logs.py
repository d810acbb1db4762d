"""Logging for the shells: a sentence, then the facts as key=value.

    log.info("port opened", extra=facts(port="/dev/ttyUSB0", baud=115200))

What others wrote (an operator's reason, a device's name) is in these lines, so characters that a
terminal or a log would obey are shown as they are spelt: a record is one line, and no text can
begin another one.

On a terminal a line starts with the time; under systemd it starts with the priority that
journald understands (sd-daemon(3)), because journald has the time already.
"""

from __future__ import annotations

import logging
import os
import sys

from ahrsd.printable import printable

_PRIORITY = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}
_LONGEST = 8000  # characters of a line: nothing of ours is so long, but what others wrote may be


def facts(**values: object) -> dict[str, dict[str, object]]:
    """The `extra` argument of a log call."""
    return {"facts": values}


def _quoted(value: object) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return repr(text) if not text or " " in text or "=" in text or "\n" in text else text


class FactsFormatter(logging.Formatter):
    """`12:30:01.250 INFO  daemon: port opened port=/dev/ttyUSB0 baud=115200`."""

    def __init__(self, journald: bool = False) -> None:
        super().__init__("%(message)s", datefmt="%H:%M:%S")
        self._journald = journald

    def format(self, record: logging.LogRecord) -> str:
        """One record as one line (a traceback, of `exc_info` or `trace`, adds its own)."""
        values: dict[str, object] = getattr(record, "facts", {})
        message = record.getMessage()
        text = " ".join([message, *(f"{k}={_quoted(v)}" for k, v in values.items())])
        trace = getattr(record, "trace", "")
        if record.exc_info:
            trace = self.formatException(record.exc_info)
        name = record.name.removeprefix("ahrsd.")
        if self._journald:
            head = f"<{_PRIORITY.get(record.levelname, 6)}>"
            first = f"{name}: {text}"
        else:
            head = ""
            clock = f"{self.formatTime(record, self.datefmt)}.{record.msecs:03.0f}"
            first = f"{clock} {record.levelname:<7} {name}: {text}"
        lines = [first, *trace.rstrip("\n").split("\n")] if trace else [first]
        return "\n".join(head + printable(one, _LONGEST) for one in lines)


def configure(verbose: int = 0) -> None:
    """Send the log to stderr: warnings, with `-v` information, with `-vv` the traffic."""
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbose, logging.DEBUG)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(FactsFormatter(journald="JOURNAL_STREAM" in os.environ))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    for name in ("ahrsd", "drivers"):
        logging.getLogger(name).setLevel(level)
