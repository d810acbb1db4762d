"""The vehicle's word that a write is safe: a file that it keeps rewriting.

Safe means: the file says exactly `safe`, and it was seen to be written again within the last
`max_age_s`, by a clock that only runs forward. Anything else, also an error, a file that nobody
rewrites and a disk that hangs, is no.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ahrsd.foreign_file import Contents, FileWatch, boot_s, read_regular

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
