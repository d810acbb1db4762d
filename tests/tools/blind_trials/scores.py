"""Every score of a round, with its binomial interval and what it should have been."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from blind_trials.judge import ADDED, RIGHT, WRONG, Verdict

_Z = 1.959964  # 95 %
STRONG = 2.0  # limits


@dataclass(frozen=True, slots=True)
class RoundScore:
    """A row.  `value` is a share of `cases`, or a median or mean where `low` is None."""

    name: str
    value: float | None
    cases: int
    low: float | None
    high: float | None
    target: str
    met: bool | None

    def json(self) -> dict[str, Any]:
        """Its fields."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class ToolResult:
    """A tool's verdicts, misses first, and its scores."""

    tool: str
    verdicts: list[Verdict]
    scores: list[RoundScore]
    mistakes: RoundScore


def wilson(hits: int, cases: int) -> tuple[float, float]:
    """95 % interval of a share."""
    if cases == 0:
        return 0.0, 1.0
    p, z = hits / cases, _Z
    middle = (p + z * z / (2 * cases)) / (1 + z * z / cases)
    half = z / (1 + z * z / cases) * math.sqrt(p * (1 - p) / cases + z * z / (4 * cases**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def share(
    name: str, answers: Sequence[bool], *, least: float | None = None, most: float | None = None
) -> RoundScore:
    """A share with its interval; it should be at least `least` or at most `most`."""
    hits, cases = sum(answers), len(answers)
    value = hits / cases if cases else None
    low, high = wilson(hits, cases)
    target = (
        f">= {least:.1%}" if least is not None else f"<= {most:.1%}" if most is not None else ""
    )
    met = None
    if value is not None and target:
        met = value >= least if least is not None else value <= (most or 0.0)
    return RoundScore(
        name, value, cases, low if cases else None, high if cases else None, target, met
    )


def middle(name: str, values: Sequence[float], *, most: float | None = None) -> RoundScore:
    """A median that should be at most `most`."""
    value = median(values) if values else None
    met = value <= most if value is not None and most is not None else None
    return RoundScore(name, value, len(values), None, None, f"<= {most:g}" if most else "", met)


def least_median(name: str, values: Sequence[float], least: float) -> RoundScore:
    """A median that should be at least `least`."""
    value = median(values) if values else None
    met = value >= least if value is not None else None
    return RoundScore(name, value, len(values), None, None, f">= {least:g}", met)


def calibration_error(pairs: Sequence[tuple[float, bool]], bins: int = 10) -> float | None:
    """Expected calibration error: mean distance of stated confidence and share of right names."""
    if not pairs:
        return None
    total = 0.0
    for number in range(bins):
        inside = [(c, r) for c, r in pairs if min(int(c * bins), bins - 1) == number]
        if inside:
            stated = sum(c for c, _ in inside) / len(inside)
            right = sum(r for _, r in inside) / len(inside)
            total += len(inside) / len(pairs) * abs(stated - right)
    return total


def _known_values(verdicts: Sequence[Verdict], of: Callable[[Verdict], bool | None]) -> list[bool]:
    return [value for v in verdicts if (value := of(v)) is not None]


def scores(verdicts: Sequence[Verdict]) -> list[RoundScore]:
    """All rows; those of kinds that the round does not have are left out."""
    by_kind: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        by_kind.setdefault(verdict.kind, []).append(verdict)
    rows = [
        *_of_nulls(by_kind.get("null", [])),
        *_of_singles(by_kind.get("single", [])),
        *_of_pairs(by_kind.get("pair", [])),
        *_of_unknowns(by_kind),
        *_of_semireal(by_kind.get("semireal", [])),
        *_of_all(verdicts),
    ]
    return [row for row in rows if row.cases]


def _of_nulls(nulls: Sequence[Verdict]) -> list[RoundScore]:
    def false(some: Sequence[Verdict]) -> list[bool]:
        return [v.error for v in some]

    laws = sorted({str(v.truth["noise_law"]) for v in nulls})
    rows = [
        share(
            f"false names on nulls, {law.replace('_', ' ')}",
            false([v for v in nulls if v.truth["noise_law"] == law]),
            most=0.005 if law == "white" else 0.01,
        )
        for law in laws
    ]
    unknown = [bool(v.called_unknown) for v in nulls]
    return [*rows, share("nulls called unknown", unknown, most=0.01)]


def _of_singles(singles: Sequence[Verdict]) -> list[RoundScore]:
    strong = [v for v in singles if (v.multiple or 0.0) >= STRONG]
    known = [v for v in strong if v.detected is not None]
    return [
        share(
            "detected, 2 x limit and more", _known_values(known, lambda v: v.detected), least=0.99
        ),
        share("detected, all strengths", _known_values(singles, lambda v: v.detected)),
        share(
            "first name right, 2 x limit",
            _known_values(strong, lambda v: v.first_right),
            least=0.99,
        ),
        share(
            "first name right, all detected",
            _known_values(singles, lambda v: v.first_right),
            least=0.97,
        ),
        share("first name the key's own word", _known_values(singles, lambda v: v.strict)),
        share("truth in the set", _known_values(singles, lambda v: v.in_set), least=0.99),
        share("nothing added", [v.word == RIGHT for v in singles if v.first_right]),
        share(
            "called unknown though a name exists",
            [bool(v.called_unknown) for v in singles if v.detected],
            most=0.01,
        ),
        share("frame right", _known_values(singles, lambda v: v.frame_right), least=0.9),
        least_median("interval: overlap, median", _numbers(singles, "overlap"), 0.8),
        middle("onset error, median, s", _numbers(singles, "onset_error_s"), most=1.0),
        share(
            "coefficients within 2 s.d.",
            [abs(pull) < 2 for v in singles for pull in v.pulls],
            least=0.92,
        ),
        middle(
            "coefficient error at 4 x limit, median",
            [v.relative for v in singles if v.relative is not None and (v.multiple or 0) >= 4],
            most=0.05,
        ),
        least_median("held-out gain over the oracle's, median", _numbers(singles, "gain"), 0.98),
        share(
            "repaired simulation passes all checks",
            [v.answer.closed for v in singles if v.word == RIGHT and v.answer.closed is not None],
            least=0.97,
        ),
    ]


def _numbers(verdicts: Sequence[Verdict], name: str) -> list[float]:
    return [value for v in verdicts if (value := getattr(v, name)) is not None]


def _of_pairs(pairs: Sequence[Verdict]) -> list[RoundScore]:
    strong = [v for v in pairs if (v.multiple or 0.0) >= STRONG]
    return [
        share("pairs: both named, none added", [v.word == RIGHT for v in pairs]),
        share("pairs, both at 2 x limit", [v.word == RIGHT for v in strong], least=0.90),
        share("pairs: both in the sets", [bool(v.in_set) for v in pairs]),
    ]


def _of_unknowns(by_kind: dict[str, list[Verdict]]) -> list[RoundScore]:
    unknown = [*by_kind.get("withheld", []), *by_kind.get("outside", [])]
    blind = by_kind.get("unidentifiable", [])
    return [
        *(
            share(
                f"unknown called unknown, {kind}",
                [v.word == RIGHT for v in by_kind.get(kind, [])],
                least=0.95,
            )
            for kind in ("withheld", "outside")
        ),
        share(
            "unknown called unknown, withheld, 2 x limit",
            [v.word == RIGHT for v in by_kind.get("withheld", []) if (v.multiple or 0) >= STRONG],
        ),
        share("unknown: frame right", _known_values(unknown, lambda v: v.frame_right), least=0.9),
        least_median("unknown: overlap, median", _numbers(unknown, "overlap"), 0.8),
        share("unidentifiable: nothing invented", [not v.error for v in blind], least=0.95),
    ]


def _of_semireal(semireal: Sequence[Verdict]) -> list[RoundScore]:
    strong = [v for v in semireal if (v.multiple or 0.0) >= STRONG]
    named, false = [not v.error for v in semireal], (WRONG, ADDED)
    return [
        share("semi-real: named", named, least=0.97),
        share("semi-real: named, nothing added", [v.word == RIGHT for v in semireal]),
        share("semi-real: named, 2 x limit and more", [not v.error for v in strong], least=0.97),
        share(
            "semi-real: detected, 2 x limit and more",
            _known_values(strong, lambda v: v.detected),
            least=0.99,
        ),
        share("semi-real: detected, all strengths", _known_values(semireal, lambda v: v.detected)),
        share(
            "semi-real: first name right, all detected",
            _known_values(semireal, lambda v: v.first_right),
            least=0.97,
        ),
        share(
            "semi-real: truth in the set", _known_values(semireal, lambda v: v.in_set), least=0.99
        ),
        share("semi-real: a name that is not true", [v.word in false for v in semireal], most=0.01),
        middle("semi-real: coefficient error, median", _numbers(semireal, "relative"), most=0.1),
        middle("semi-real: onset error, median, s", _numbers(semireal, "onset_error_s"), most=1.0),
    ]


def _stated(verdict: Verdict, right: dict[str, set[str]]) -> float | None:
    """The confidence that the first name counts as right.

    Its own, and that of each alternative for whose signal it counts as right too.
    """
    if verdict.confidence is None:
        return None
    first = verdict.answer.findings[0]
    alike = [
        share
        for name, share in zip(first.alternatives, first.shares, strict=False)
        if first.effect in right.get(name, ())
    ]
    return min(1.0, verdict.confidence + sum(alike))


def _of_all(verdicts: Sequence[Verdict]) -> list[RoundScore]:
    right = {
        str(effect["effect"]): set(effect["right"])
        for v in verdicts
        for effect in v.truth["effects"]
    }
    stated = [
        (confidence, v.word == RIGHT or bool(v.first_right))
        for v in verdicts
        if v.kind in ("null", "single", "pair") and (confidence := _stated(v, right)) is not None
    ]
    error = calibration_error(stated)
    seconds = [v.answer.seconds for v in verdicts if v.answer.seconds is not None]
    rows = [middle("CPU seconds a case, median", seconds, most=5.0)]
    if error is not None:
        met = error <= 0.02
        rows.append(
            RoundScore(
                "calibration error of the confidence",
                error,
                len(stated),
                None,
                None,
                "<= 0.02",
                met,
            )
        )
    return rows


def error_rate(verdicts: Sequence[Verdict]) -> RoundScore:
    """Mistakes where tools are compared: nulls, strong singles and strong pairs."""
    counted = [
        v
        for v in verdicts
        if v.kind == "null" or (v.kind in ("single", "pair") and (v.multiple or 0) >= STRONG)
    ]
    return share("mistakes: nulls, singles and pairs from 2 x limit", [v.error for v in counted])
