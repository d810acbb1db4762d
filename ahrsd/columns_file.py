"""What the vehicle measures beside the stream: a file with a JSON object that it keeps rewriting.

    {"motor_current_a": 3.2, "rudder_deg": -4.0}

Written under another name and moved there, so that it is never seen half. What is no object of
numbers is no word; why is said by `fault`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

_LONGEST = 4096


class ColumnsFile:
    """Reads the newest word, once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fault = ""
        self._seen_ns = -1

    def news(self) -> dict[str, float] | None:
        """The columns, if the file was written since the last call and can be understood."""
        try:
            written_ns = self.path.stat().st_mtime_ns
            if written_ns == self._seen_ns:
                return None
            with self.path.open("rb") as file:
                data = file.read(_LONGEST)
        except OSError as error:
            self.fault = f"{self.path}: {error.strerror}"
            return None
        self._seen_ns = written_ns
        try:
            found = columns_of(data)
        except ValueError as error:
            self.fault = f"{self.path}: {error}"
            return None
        self.fault = ""
        return found


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
