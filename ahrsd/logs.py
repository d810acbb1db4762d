"""Logging for the shells: a sentence, then the facts as key=value.

    log.info("port opened", extra=facts(port="/dev/ttyUSB0", baud=115200))

On a terminal a line starts with the time; under systemd it starts with the priority that
journald understands (sd-daemon(3)), because journald has the time already.
"""

from __future__ import annotations

import logging
import os
import sys

_PRIORITY = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}


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
        """One record as one line (a traceback adds its own)."""
        values: dict[str, object] = getattr(record, "facts", {})
        text = " ".join([super().format(record), *(f"{k}={_quoted(v)}" for k, v in values.items())])
        name = record.name.removeprefix("ahrsd.")
        if self._journald:
            return f"<{_PRIORITY.get(record.levelname, 6)}>{name}: {text}"
        clock = f"{self.formatTime(record, self.datefmt)}.{record.msecs:03.0f}"
        return f"{clock} {record.levelname:<7} {name}: {text}"


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
