"""A tool's answer, read leniently: what is missing is no claim, what is odd is no crash."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

Json = dict[str, Any]
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class ClaimedParameter:
    """A number of a finding, in the unit it came with."""

    name: str
    value: float
    std: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class ClaimedEffect:
    """One named effect."""

    effect: str
    confidence: float | None
    alternatives: tuple[str, ...]
    frame: str | None
    spans_s: tuple[Span, ...]
    parameters: tuple[ClaimedParameter, ...]
    gain: float | None
    separate_from: str | None
    shares: tuple[float, ...] = ()  # confidence of each alternative

    @property
    def names(self) -> tuple[str, ...]:
        """The effect and what it cannot be told from."""
        return (self.effect, *self.alternatives)


@dataclass(frozen=True, slots=True)
class ToolAnswer:
    """One case's answer; `failure` is why there is none."""

    failure: str | None
    printed: str
    seconds: float | None  # CPU
    mismatch: bool = False
    findings: tuple[ClaimedEffect, ...] = ()
    unexplained: bool = False
    unexplained_frame: str | None = None
    unexplained_spans_s: tuple[Span, ...] = ()
    closed: bool | None = None  # all predictive checks inside after the repair

    @property
    def names(self) -> tuple[str, ...]:
        """Named effects, strongest first."""
        return tuple(finding.effect for finding in self.findings)

    @property
    def everything(self) -> frozenset[str]:
        """Every name in every set."""
        return frozenset(name for finding in self.findings for name in finding.names)


def read_answer(record: Json) -> ToolAnswer:
    """An answer out of what `running` wrote."""
    seconds, printed = _number(record.get("cpu_seconds")), str(record.get("said", ""))
    value = record.get("answer")
    if not isinstance(value, dict):
        return ToolAnswer(str(record.get("failure") or "no answer"), printed, seconds)
    unexplained = _object(value.get("unexplained"))
    where = _object(unexplained.get("where"))
    return ToolAnswer(
        failure=None,
        printed=printed,
        seconds=seconds,
        mismatch=bool(value.get("mismatch")),
        findings=tuple(
            _finding(entry) for entry in _list(value.get("findings")) if isinstance(entry, dict)
        ),
        unexplained=bool(unexplained.get("detected")),
        unexplained_frame=_text(where.get("frame")),
        unexplained_spans_s=_spans(where.get("intervals_s")),
        closed=_closed(_object(value.get("posterior_predictive"))),
    )


def _finding(entry: Json) -> ClaimedEffect:
    where, heldout = _object(entry.get("where")), _object(entry.get("heldout"))
    others = [
        other
        for other in _list(entry.get("alternatives"))
        if isinstance(other, dict) and "effect" in other
    ]
    return ClaimedEffect(
        effect=str(entry.get("effect")),
        confidence=_number(entry.get("confidence")),
        alternatives=tuple(str(other["effect"]) for other in others),
        frame=_text(where.get("frame")),
        spans_s=_spans(where.get("intervals_s")),
        parameters=tuple(_parameters(entry.get("parameters"))),
        gain=_number(heldout.get("nll_gain_per_sample")),
        separate_from=_text(entry.get("separate_from")),
        shares=tuple(_number(other.get("confidence")) or 0.0 for other in others),
    )


def _parameters(value: object) -> list[ClaimedParameter]:
    out = []
    for entry in _list(value):
        number = _number(_object(entry).get("value"))
        if number is not None:
            unit = str(entry.get("unit") or "1")
            out.append(
                ClaimedParameter(str(entry.get("name")), number, _number(entry.get("std")), unit)
            )
    return out


def _closed(checks: Json) -> bool | None:
    inside = [
        check["inside_after"]
        for check in checks.values()
        if isinstance(check, dict) and check.get("inside_after") is not None
    ]
    return all(inside) if inside else None


def _spans(value: object) -> tuple[Span, ...]:
    out = []
    for span in _list(value):
        if isinstance(span, list) and len(span) == 2:
            begin, end = _number(span[0]), _number(span[1])
            if begin is not None and end is not None:
                out.append((begin, end))
    return tuple(out)


def _number(value: object) -> float | None:
    real = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if real and math.isfinite(value) else None  # type: ignore[arg-type]


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _object(value: object) -> Json:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
