"""The decision log: what was concluded when, as plain values, and its hash.

Two runs over the same inputs must yield the same log; the hash says whether they did. Numbers are
rounded to 9 significant digits before hashing, below what differs between processors.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from ahrsd.events import GateResult

_DIGITS = 9


@dataclass(slots=True)
class DecisionLog:
    """Entries in order. The newest `keep` are kept whole; all of them are in the hash."""

    keep: int = 4096
    entries: list[dict[str, object]] = field(default_factory=list)
    count: int = 0
    _hash: hashlib._Hash = field(default_factory=hashlib.sha256)

    def add(
        self, at_s: float, state: str, gates: Iterable[GateResult] = (), **facts: object
    ) -> None:
        """One decision at device time `at_s`; facts are plain values."""
        entry: dict[str, object] = {
            "at_s": _plain(at_s),
            "state": state,
            "gates": [
                {
                    "gate": g.gate,
                    "value": _plain(g.value),
                    "limit": _plain(g.limit),
                    "ok": g.ok,
                }
                for g in gates
            ],
        }
        entry.update({name: _plain(value) for name, value in facts.items()})
        self._hash.update(json.dumps(entry, sort_keys=True).encode())
        self.count += 1
        self.entries.append(entry)
        del self.entries[: -self.keep]

    @property
    def sha256(self) -> str:
        """Hash of every entry so far."""
        return self._hash.hexdigest()


def _plain(value: object) -> object:
    """Rounded, finite or null: what JSON and another machine can both say."""
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        return float(f"{value:.{_DIGITS - 1}e}")
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    return value
