"""The decision log: what was concluded when, as plain values, and its hash.

Two runs over the same inputs must yield the same log; the hash says whether they did, also on
another processor. An entry keeps 9 significant digits for people. The hash is over the entry with
every number but its time rounded further, to `_HASHED_DIGITS` significant digits and to
`_HASHED_STEP`: the last digits of a solver belong to the processor's arithmetic (up to 3e-9 of a
number was seen to differ between kernels of one library), and no decision depends on them.
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
_HASHED_DIGITS = 4
_HASHED_STEP = 6  # decimal places: 1 uG, 1 urad/s, and far below any gate's limit


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
        self._hash.update(hashed_form(entry))
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


def hashed_form(entry: dict[str, object]) -> bytes:
    """The bytes of an entry that are hashed: what decides, without what a processor adds to it."""
    rest = {name: value for name, value in entry.items() if name != "at_s"}
    coarse = {"at_s": entry["at_s"], **{name: _coarse(value) for name, value in rest.items()}}
    return json.dumps(coarse, sort_keys=True).encode()


def _coarse(value: object) -> object:
    if isinstance(value, float):
        return round(_rounded(value, _HASHED_DIGITS), _HASHED_STEP) + 0.0  # -0.0 becomes 0.0
    if isinstance(value, list):
        return [_coarse(v) for v in value]
    if isinstance(value, dict):
        return {name: _coarse(v) for name, v in value.items()}
    return value


def _rounded(value: float, digits: int) -> float:
    return float(f"{value:.{digits - 1}e}")


def _plain(value: object) -> object:
    """Rounded, finite or null: what JSON and another machine can both say."""
    if isinstance(value, float):
        return _rounded(value, _DIGITS) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    return value
