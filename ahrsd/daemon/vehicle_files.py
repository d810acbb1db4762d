"""What the vehicle and a person say beside the stream, in files: when it is due, and what is wrong.

**The word that a write is safe.** Safe means: the file says exactly `safe`, and it was seen to be
written again within the last `max_age_s`, by a clock that only runs forward. Anything else, also an
error, a file that nobody rewrites and a disk that hangs, is no.

**Columns**: what the vehicle measures, a file with a JSON object.

    {"motor_current_a": 3.2, "rudder_deg": -4.0}

Written under another name and moved there, so that it is never seen half. Values count from when
they were seen to be written; what lay there before the start is nobody's measurement of now. What
is no object of numbers is no word; why is said by `fault`.

`VehicleFiles` asks both, and the operator's inbox (`operator_inbox`), as often as each may change.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from ahrsd.config.config import Config
from ahrsd.daemon.operator_inbox import OperatorAnswer, OperatorCommand, OperatorInbox
from ahrsd.events import Answered, Event
from ahrsd.foreign_file import Contents, FileWatch, boot_s, read_regular
from ahrsd.inputs import Columns, Interlock

# -- The word that a write is safe -----------------------------------------------------------------


_LONGEST_WORD = 64
_EVERY_S = 0.05


class InterlockFile:
    """The newest word, read in a thread of its own; asking never waits."""

    def __init__(
        self,
        path: Path,
        max_age_s: float,
        *,
        read: Callable[[Path, int], Contents] = read_regular,
        now_s: Callable[[], float] = boot_s,
    ) -> None:
        self.path, self.max_age_s = path, max_age_s
        every_s = min(_EVERY_S, max_age_s / 10)
        self._watch = FileWatch(path, _LONGEST_WORD, every_s, read=read, now_s=now_s)

    def safe(self) -> bool:
        """Whether the vehicle says so now."""
        sight = self._watch.sight
        fresh = self._watch.now_s() - sight.since_s <= self.max_age_s
        return fresh and sight.data is not None and sight.data.strip() == b"safe"

    @property
    def fault(self) -> str:
        """Why the file is no word, in one line; empty where it can be read."""
        return f"interlock.file = {text}" if (text := self._watch.fault) else ""

    def close(self) -> None:
        """Look no more."""
        self._watch.close()


# -- Columns ---------------------------------------------------------------------------------------


_LONGEST_OBJECT = 4096
_COLUMNS_EVERY_S = 0.02


class ColumnsFile:
    """The newest word, once, read in a thread of its own; asking never waits.

    max_age_s: what was written longer ago than this is of no use any more
    """

    def __init__(
        self,
        path: Path,
        max_age_s: float = 0.5,
        *,
        read: Callable[[Path, int], Contents] = read_regular,
        now_s: Callable[[], float] = boot_s,
    ) -> None:
        self.path, self.max_age_s = path, max_age_s
        self._watch = FileWatch(path, _LONGEST_OBJECT, _COLUMNS_EVERY_S, read=read, now_s=now_s)
        self._taken = 0
        self._wrong = ""

    def news(self) -> dict[str, float] | None:
        """The columns, if the file was written since the last call and can be understood."""
        sight = self._watch.sight
        if sight.data is None or sight.writings == self._taken:
            return None
        self._taken = sight.writings
        if self._watch.now_s() - sight.since_s > self.max_age_s:
            return None
        try:
            found = columns_of(sight.data)
        except ValueError as error:
            self._wrong = f"{self.path}: {error}"
            return None
        self._wrong = ""
        return found

    @property
    def fault(self) -> str:
        """Why there are no values, in one line; empty where there are."""
        wrong = self._watch.fault or self._wrong
        return f"terms.file = {wrong}" if wrong else ""

    def close(self) -> None:
        """Look no more."""
        self._watch.close()


def columns_of(data: bytes) -> dict[str, float]:
    """The columns in the file's bytes.  Raises ValueError with what is wrong in words."""
    try:
        body = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"is not JSON: {error}") from None
    if isinstance(body, dict) and all(map(_is_number, body.values())):
        return {str(name): float(value) for name, value in body.items()}
    raise ValueError('must be an object of numbers, {"motor_current_a": 3.2}')


def _is_number(value: object) -> bool:
    """Also no whole number that is beyond all floats."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and abs(value) <= sys.float_info.max
    )


# -- All of them, when they are due ----------------------------------------------------------------


_INTERLOCK_S = 0.2  # longest interval at which the interlock is read
_COLUMNS_S = 0.04  # interval at which the columns are read


class Vehicle(Protocol):
    """Who says whether a write is safe now."""

    def safe(self) -> bool:
        """The word; anything that goes wrong is no."""


class VehicleFiles:
    """See the module; each part may be absent.

    interlock: who says that a write is safe; a word counts for `max_age_s`
    columns:   what the vehicle measures, for the terms of a repaired model
    words:     where a person speaks to the daemon
    """

    def __init__(
        self,
        interlock: Vehicle | None = None,
        columns: ColumnsFile | None = None,
        words: OperatorInbox | None = None,
        *,
        max_age_s: float = 1.0,
    ) -> None:
        self.interlock, self.columns, self.words = interlock, columns, words
        self._safe = False
        self._interlock_s = min(_INTERLOCK_S, max_age_s / 3)
        self._next_interlock_ns = self._next_columns_ns = 0
        self._wrong: dict[InterlockFile | ColumnsFile | OperatorInbox, str] = {}  # as last told

    @staticmethod
    def of(config: Config) -> VehicleFiles:
        """Begin to look at those that the configuration names."""
        words = None if config.mode == "passive" else OperatorInbox.in_state(config.state)
        files = VehicleFiles(None, None, words, max_age_s=config.interlock.max_age_s)
        files._open(config)
        return files

    def _open(self, config: Config) -> None:
        word, terms = config.interlock, config.terms
        self.interlock = None if word.file is None else InterlockFile(word.file, word.max_age_s)
        self.columns = None if terms.file is None else ColumnsFile(terms.file, terms.max_age_s)
        self._wrong = {}

    def change(self, config: Config) -> None:
        """Look at other files, where the configuration names others now."""
        present = (_path(self.interlock), _path(self.columns))
        if (config.interlock.file, config.terms.file) != present:
            self._close_files()
            self._open(config)

    def heard(self, now_ns: int) -> Iterator[Interlock | Columns]:
        """The vehicle's word and columns, where it is time to ask."""
        if self.interlock is not None and now_ns >= self._next_interlock_ns:
            self._next_interlock_ns = now_ns + int(self._interlock_s * 1e9)
            self._safe = self.interlock.safe()
            yield Interlock(now_ns, self._safe)
        if self.columns is not None and now_ns >= self._next_columns_ns:
            self._next_columns_ns = now_ns + int(_COLUMNS_S * 1e9)
            if (values := self.columns.news()) is not None:
                yield Columns(now_ns, values)

    def commands(self) -> list[OperatorCommand]:
        """What a person said since the last call."""
        return [] if self.words is None else self.words.take()

    def answer(self, event: Event) -> None:
        """Tell a person what became of the word."""
        if isinstance(event, Answered) and event.word and self.words is not None:
            self.words.answer(event.word, OperatorAnswer(event.accepted, event.text))

    @property
    def word(self) -> str:
        """The vehicle's, for a person: none, safe, not safe."""
        return "none" if self.interlock is None else "safe" if self._safe else "not safe"

    def news_of_faults(self) -> list[str]:
        """What became wrong with a file since the last call, or is over, in words."""
        said = []
        for file in (self.interlock, self.columns, self.words):
            if isinstance(file, InterlockFile | ColumnsFile | OperatorInbox):
                before = self._wrong.get(file, "")
                if (text := file.fault) != before:
                    self._wrong[file] = text
                    said.append(text or f"over: {before}")
        return said

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with files, as told last."""
        return tuple(text for text in self._wrong.values() if text)

    def _close_files(self) -> None:
        for file in (self.interlock, self.columns):
            if isinstance(file, InterlockFile | ColumnsFile):
                file.close()

    def close(self, least_s: float) -> None:
        """Look no more; a person's last words are answered within `least_s`."""
        self._close_files()
        if self.words is not None:
            self.words.close(least_s)


def _path(file: Vehicle | ColumnsFile | None) -> Path | None:
    return file.path if isinstance(file, InterlockFile | ColumnsFile) else None
