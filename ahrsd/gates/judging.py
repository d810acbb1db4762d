"""Evidence against the table: what holds, since when, and what a person can do about the rest.

Fail closed: a number that is not finite is not ok, whatever its row says, and a row of the table
that is not among the results counts as red.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from operator import attrgetter

from ahrsd.events import GateResult
from ahrsd.evidence.values import Evidence
from ahrsd.gates.limits import GateLimits
from ahrsd.gates.table import GATES, Gate, Level

_ROUNDING = 1e-6  # of the limit: 10 Hz that is summed up to 9.9999999 is 10 Hz


def judge(
    evidence: Evidence,
    limits: GateLimits,
    at_s: float,
    previous: tuple[GateResult, ...] = (),
) -> tuple[GateResult, ...]:
    """Every row that applies, in the order of the table; `since_s`: when its `ok` last changed."""
    before = {result.gate: result for result in previous}
    return tuple(
        _result(gate, evidence, limits, at_s, before.get(gate.gate))
        for gate in GATES
        if not gate.applies or attrgetter(gate.applies)(evidence)
    )


def for_level(results: Iterable[GateResult], level: Level) -> tuple[GateResult, ...]:
    """The results that guard `level` and what is below it.

    UNATTENDED adds its rows to those of RAM; what it adds for flash is the operator's policy.
    """
    guards = {gate.gate: gate.level for gate in GATES}
    wanted = _levels(level)
    return tuple(r for r in results if guards.get(r.gate, Level.CANDIDATE) in wanted)


_UNATTENDED = frozenset(gate.gate for gate in GATES if gate.level is Level.UNATTENDED)


def guards_a_write(gate: str) -> bool:
    """Whether it guards what a person approves: the write or its save.

    These are the gates that are counted, wherever a number of gates is told. The others guard only
    a write that nobody approves.
    """
    return gate not in _UNATTENDED


def holds(results: Iterable[GateResult], level: Level) -> bool:
    """Whether every row that guards `level` is there and ok."""
    chosen = {r.gate: r.ok for r in for_level(results, level)}
    needed = {g.gate for g in GATES if g.level in _levels(level) and not g.applies}
    return needed <= chosen.keys() and all(chosen.values())


def limit_of(gate: Gate, limits: GateLimits) -> float:
    """The number a row is compared with."""
    return float(getattr(limits, gate.limit)) if isinstance(gate.limit, str) else gate.limit


def _levels(level: Level) -> set[Level]:
    if level is Level.UNATTENDED:
        return {Level.CANDIDATE, Level.RAM, Level.UNATTENDED}
    return {other for other in Level if other <= level}


def _result(
    gate: Gate,
    evidence: Evidence,
    limits: GateLimits,
    at_s: float,
    before: GateResult | None,
) -> GateResult:
    value, limit = float(attrgetter(gate.value)(evidence)), limit_of(gate, limits)
    measured = math.isfinite(value)
    slack = _ROUNDING * abs(limit)
    ok = measured and (value <= limit + slack if gate.at_most else value >= limit - slack)
    words = (gate.advice if measured else gate.missing).format(v=value, l=limit, e=evidence)
    return GateResult(
        gate=gate.gate,
        value=value,
        limit=limit,
        ok=ok,
        since_s=before.since_s if before is not None and before.ok == ok else at_s,
        unit=gate.unit,
        advice="" if ok else words,
    )
