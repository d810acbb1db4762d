"""The decision log: the conclusions with their times, as plain values, and their hash.

Two runs over the same inputs must yield the same log; the hash shows whether they did, also on
another processor. An entry keeps 9 significant digits for people. For the hash, every number except
the entry's time is rounded further, to `_HASHED_DIGITS` significant digits and to `_HASHED_STEP`:
the last digits of a solver depend on the processor's arithmetic (differences up to 3e-9 of a number
were seen between kernels of one library), and no decision depends on them.
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
_HASHED_STEP = 6  # decimal places: 1 uG, 1 urad/s, far below any gate's limit


@dataclass(slots=True)
class DecisionLog:
    """Entries in order, all in the hash. Keeps the newest `keep` as text of some 4 kB each; None:
    all.
    """

    keep: int | None = None
    count: int = 0
    _lines: deque[bytes] = field(default_factory=deque)
    _hash: hashlib._Hash = field(default_factory=hashlib.sha256)

    def add(
        self, at_s: float, state: str, gates: Iterable[GateResult] = (), **facts: object
    ) -> None:
        """Add a decision at device time `at_s`; facts are plain values."""
        entry: dict[str, object] = {
            "at_s": _round_for_json(at_s),
            "state": state,
            "gates": [
                {
                    "gate": g.gate,
                    "value": _round_for_json(g.value),
                    "limit": _round_for_json(g.limit),
                    "ok": g.ok,
                }
                for g in gates
            ],
        }
        entry.update({name: _round_for_json(value) for name, value in facts.items()})
        line = json.dumps(entry, sort_keys=True).encode()
        self._hash.update(hashed_form(entry))
        self.count += 1
        self._lines.append(line)
        if self.keep is not None and len(self._lines) > self.keep:
            self._lines.popleft()

    def add_verdict(
        self, at_s: float, state: str, gates: Iterable[GateResult], estimate: Estimate
    ) -> None:
        """Add the verdict on an estimate."""
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
        """Hash of all entries so far."""
        return self._hash.hexdigest()


def hashed_form(entry: dict[str, object]) -> bytes:
    """The bytes of an entry that are hashed, without digits that depend on the processor."""
    rest = {name: value for name, value in entry.items() if name != "at_s"}
    rounded = {
        "at_s": entry["at_s"],
        **{name: _round_for_hash(value) for name, value in rest.items()},
    }
    return json.dumps(rounded, sort_keys=True).encode()


def _round_for_hash(value: object) -> object:
    if isinstance(value, float):
        return (
            round(_round_to_digits(value, _HASHED_DIGITS), _HASHED_STEP) + 0.0
        )  # -0.0 becomes 0.0
    if isinstance(value, list):
        return [_round_for_hash(v) for v in value]
    if isinstance(value, dict):
        return {name: _round_for_hash(v) for name, v in value.items()}
    return value


def _round_to_digits(value: float, digits: int) -> float:
    return float(f"{value:.{digits - 1}e}")


def _round_for_json(value: object) -> object:
    """The value with numbers rounded, null if not finite: the same in JSON on every machine."""
    if isinstance(value, float):
        return _round_to_digits(value, _DIGITS) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_round_for_json(v) for v in value]
    if isinstance(value, dict):
        return {str(k): _round_for_json(v) for k, v in value.items()}
    return value
