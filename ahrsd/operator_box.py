"""A person's word to the running daemon: a folder into which `ahrsd operator` puts one file a word.

Who may write into the folder may approve, so the file system's permissions decide; the daemon makes
it for its own user alone. A word is taken once: its file is removed before the word acts. A word
that lay there for longer than `LONGEST_S` was said to another run and is dropped.
"""

from __future__ import annotations

import json
import logging
import os
import time
from pathlib import Path
from typing import Final

VERBS: Final = ("arm", "disarm", "approve", "lock", "unlock", "rollback")
LONGEST_S: Final = 30.0
_LARGEST_BYTES = 1024

log = logging.getLogger(__name__)


class OperatorBox:
    """The folder, for both sides."""

    def __init__(self, state_directory: Path) -> None:
        self.folder = state_directory / "operator"

    def prepare(self) -> None:
        """Make the folder, readable and writable by this user alone. Raises OSError."""
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def put(self, verb: str, argument: str = "") -> Path:
        """Say a word; returns its file, which is gone once the daemon took it. Raises OSError."""
        name = f"{time.time_ns()}-{os.getpid()}"
        draft, word = self.folder / f".{name}", self.folder / f"{name}.json"
        draft.write_text(json.dumps({"verb": verb, "argument": argument}))
        draft.rename(word)  # whole or not at all
        return word

    def heard(self, verb: str, argument: str, wait_s: float) -> bool:
        """Say a word and wait; False where nobody took it, then it is gone. Raises OSError."""
        word, until_s = self.put(verb, argument), time.monotonic() + wait_s
        while word.exists():
            if time.monotonic() > until_s:
                try:
                    word.unlink()
                except FileNotFoundError:  # taken in this moment
                    return True
                return False
            time.sleep(0.05)
        return True

    def take(self) -> list[tuple[str, str]]:
        """The words (verb, argument) since the last time, oldest first. Never raises."""
        try:
            files = sorted(self.folder.glob("*.json"))
        except OSError:
            return []
        return [word for file in files if (word := _taken(file)) is not None]


def _taken(file: Path) -> tuple[str, str] | None:
    """The word in a file that could be removed; None where it is not one."""
    try:
        age_s = time.time() - file.lstat().st_mtime
        with file.open("rb") as stream:
            body = stream.read(_LARGEST_BYTES)
        file.unlink()
    except OSError as error:
        log.warning("operator: %s: %s", file.name, error.strerror)
        return None
    if not -1.0 <= age_s <= LONGEST_S:
        log.warning("operator: a word %.0f s old is too old and was dropped", age_s)
        return None
    try:
        word = json.loads(body)
        verb, argument = word["verb"], word["argument"]
    except (ValueError, TypeError, KeyError, RecursionError):
        verb, argument = None, None
    if verb not in VERBS or not isinstance(argument, str):
        log.warning("operator: %s is not a word; use `ahrsd operator`", file.name)
        return None
    return verb, argument
