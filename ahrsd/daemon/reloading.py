"""The configuration read again while the daemon runs (SIGHUP): what may change then, and how.

    reload = Reloader(load, config)
    reload.ask()                         # in a signal handler; a thread of its own calls `load`
    for well, text in reload.take(apply) # once a second, in the daemon's loop: applied, and said

Only what is named in `MAY_CHANGE` takes effect at once: limits of the gates, the vehicle's files,
and how much is recorded. Everything else is a promise about the whole run (mode, device, who
approves, budgets) and waits for the next start, which is said. A file that is wrong in any place
changes nothing.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from pydantic import BaseModel

from ahrsd.config.loading import Config
from ahrsd.config.text import to_toml
from ahrsd.errors import ConfigError

#: table -> keys of it; None: all but those that are also part of another promise
MAY_CHANGE: dict[str, frozenset[str] | None] = {
    "gates": None,
    "interlock": frozenset({"file"}),
    "terms": frozenset({"file"}),
    "capture": frozenset({"part_megabytes", "keep_megabytes"}),
}
_NOT = frozenset({"gates.max_step_auto_deg"})  # who approves what


@dataclass(frozen=True, slots=True)
class Change:
    """What a new configuration brings.

    config: the one in force from now on; changed: keys with their new values; waits: keys that
    only the next start takes
    """

    config: Config
    changed: tuple[str, ...]
    waits: tuple[str, ...]


def merged(old: Config, new: Config) -> Change:
    """The old configuration with what may change taken from the new one."""
    changed: list[str] = []
    waits: list[str] = []
    tables: dict[str, BaseModel] = {}
    for name in Config.model_fields:
        before, after = getattr(old, name), getattr(new, name)
        if before == after:
            continue
        if not isinstance(before, BaseModel):
            waits.append(name)
            continue
        taken: dict[str, Any] = {}
        for key in type(before).model_fields:
            value = getattr(after, key)
            if getattr(before, key) == value:
                continue
            if may_change(name, key):
                taken[key] = value
                changed.append(f"{name}.{key} = {'none' if value is None else to_toml(value)}")
            else:
                waits.append(f"{name}.{key}")
        tables[name] = before.model_copy(update=taken)
    return Change(old.model_copy(update=tables), tuple(changed), tuple(waits))


def may_change(table: str, key: str) -> bool:
    """Whether a running daemon takes this key."""
    keys = MAY_CHANGE.get(table, frozenset())
    return f"{table}.{key}" not in _NOT and (keys is None or key in keys)


class Reloader:
    """Reads the file when asked to; only its own thread waits for it."""

    def __init__(self, load: Callable[[], Config] | None, config: Config) -> None:
        self.config = config
        self._load = load
        self._found: SimpleQueue[Config | ConfigError] = SimpleQueue()

    def ask(self) -> None:
        """Read it again; safe in a signal handler."""
        threading.Thread(target=self._read, name="reload", daemon=True).start()

    def _read(self) -> None:
        if self._load is None:
            self._found.put(ConfigError(["there is no file to read again: give --config"]))
            return
        try:
            self._found.put(self._load())
        except ConfigError as error:
            self._found.put(error)

    def take(self, apply: Callable[[Change], None]) -> list[tuple[bool, str]]:
        """Apply what was read since the last call; (whether it is well, a sentence) for the log."""
        said: list[tuple[bool, str]] = []
        while not self._found.empty():
            found = self._found.get()
            if isinstance(found, ConfigError):
                said += [(False, f"the old configuration stays: {line}") for line in found.lines]
                continue
            change = merged(self.config, found)
            if change.changed:
                self.config = change.config
                apply(change)
            text = ", ".join(change.changed) or "nothing that may change now has changed"
            said.append((True, f"configuration read again: {text}"))
            if change.waits:
                said.append((False, f"not before the next start: {', '.join(change.waits)}"))
        return said
