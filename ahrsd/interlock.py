"""The vehicle's word that a write is safe: a file that it keeps rewriting.

Safe means: the file exists, says exactly `safe`, and was written within the last `max_age_s`.
Anything else, also an error, is no.
"""

from __future__ import annotations

import time
from pathlib import Path

_LONGEST_WORD = 64


class InterlockFile:
    """Reads the word."""

    def __init__(self, path: Path, max_age_s: float) -> None:
        self.path, self.max_age_s = path, max_age_s

    def safe(self) -> bool:
        """Whether the vehicle says so now."""
        try:
            age_s = time.time() - self.path.stat().st_mtime
            with self.path.open("rb") as file:
                word = file.read(_LONGEST_WORD)
        except OSError:
            return False
        return -1.0 <= age_s <= self.max_age_s and word.strip() == b"safe"
