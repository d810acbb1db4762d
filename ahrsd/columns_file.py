"""What the vehicle measures beside the stream: a file with a JSON object that it keeps rewriting.

    {"motor_current_a": 3.2, "rudder_deg": -4.0}

Written under another name and moved there, so that it is never seen half. What is no object of
numbers is no word; why is said by `fault`.
"""

from __future__ import annotations

import json
import math
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
            body = json.loads(data)
        except ValueError as error:
            self.fault = f"{self.path}: is not JSON: {error}"
            return None
        if not isinstance(body, dict) or not all(map(_is_number, body.values())):
            self.fault = f'{self.path}: must be an object of numbers, {{"motor_current_a": 3.2}}'
            return None
        self.fault = ""
        return {str(name): float(value) for name, value in body.items()}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
