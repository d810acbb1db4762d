"""What the vehicle says beside the stream, in files that it keeps rewriting: its word, and columns.

**The word that a write is safe.** Safe means: the file says exactly `safe`, and it was seen to be
written again within the last `max_age_s`, by a clock that only runs forward. Anything else, also an
error, a file that nobody rewrites and a disk that hangs, is no.

**Columns**: what the vehicle measures, a file with a JSON object.

    {"motor_current_a": 3.2, "rudder_deg": -4.0}

Written under another name and moved there, so that it is never seen half. Values count from when
they were seen to be written; what lay there before the start is nobody's measurement of now. What
is no object of numbers is no word; why is said by `fault`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

from ahrsd.foreign_file import Contents, FileWatch, boot_s, read_regular

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
