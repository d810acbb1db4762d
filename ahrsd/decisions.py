"""The decision log: what was concluded when, as plain values, and its hash.

Two runs over the same inputs must yield the same log; the hash says whether they did. Numbers are
rounded to 9 significant digits before hashing, below what differs between processors.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from ahrsd.calibration import Estimate
from ahrsd.events import GateResult

_DIGITS = 9


@dataclass(slots=True)
class DecisionLog:
    """Entries in order, all of them in the hash. The newest `keep` stay, as text of some 4 kB each;
    None: all.
    """

    keep: int | None = None
    count: int = 0
    _lines: deque[bytes] = field(default_factory=deque)
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
        line = json.dumps(entry, sort_keys=True).encode()
        self._hash.update(line)
        self.count += 1
        self._lines.append(line)
        if self.keep is not None and len(self._lines) > self.keep:
            self._lines.popleft()

    def judged(
        self, at_s: float, state: str, gates: Iterable[GateResult], estimate: Estimate
    ) -> None:
        """A verdict on an estimate."""
        self.add(
            at_s,
            state,
            gates,
            hard_iron_gauss=estimate.hard_iron_gauss.tolist(),
            gyro_bias_rad_s=estimate.gyro_bias_rad_s.tolist(),
            converged=estimate.converged,
        )

    @property
    def entries(self) -> list[dict[str, object]]:
        """The newest entries, oldest first."""
        return [json.loads(line) for line in self._lines]

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
