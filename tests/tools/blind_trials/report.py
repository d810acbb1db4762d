"""The round as a page: scores of every tool, then every case, misses first."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ahrsd.printable import counted
from ahrsd.report.template import render

if TYPE_CHECKING:
    from blind_trials.answers import ClaimedEffect
    from blind_trials.judge import Verdict
    from blind_trials.scores import RoundScore, ToolResult

_Table = tuple[tuple[str, ...], list[tuple[str, ...]]]
_CASES = (
    "case", "verdict", "kind", "planted (x limit, ideal s/n)", "motion", "noise", "said", "unknown",
)  # fmt: skip


def markdown(head: dict[str, Any], results: Sequence[ToolResult]) -> str:
    """The report as Markdown."""
    lines = [f"# {_title(head)}", "", _facts(head), ""]
    for heading, words, (columns, rows) in _sections(results):
        lines += [f"## {heading}", "", *([words, ""] if words else [])]
        lines += [_row(columns), _row(["---"] * len(columns)), *map(_row, rows), ""]
    return "\n".join(lines)


def html(head: dict[str, Any], results: Sequence[ToolResult]) -> str:
    """The same as one self-contained page."""
    return render(
        "trial.html",
        Path(__file__).with_name("templates"),
        title=_title(head),
        facts=_facts(head),
        sections=_sections(results),
    )


def _title(head: dict[str, Any]) -> str:
    return f"Sealed trial: {counted(head['cases'], 'case')}, ring {head['ring']}"


def _facts(head: dict[str, Any]) -> str:
    return (
        f"Key sealed as {head['sha256_of_salt_and_key']}, opened {head['opened_utc']}, when the "
        "answers of all tools below were closed. Intervals are 95 % (Wilson)."
        + "".join(
            f" {tool} is not scored: {why}." for tool, why in head.get("not_scored", {}).items()
        )
    )


def _sections(results: Sequence[ToolResult]) -> Iterable[tuple[str, str, _Table]]:
    if len(results) > 1:
        yield "Tools", _comparison(results), _tools(results)
    for result in results:
        columns = ("score", "value", "95 %", "cases", "wanted", "met")
        yield f"Scores of {result.tool}", "", (columns, [_score(row) for row in result.scores])
    for result in results:
        wrong = sum(v.error for v in result.verdicts)
        words = f"{wrong} of {len(result.verdicts)} are mistakes; they come first."
        yield f"Cases of {result.tool}", words, (_CASES, [_case(v) for v in result.verdicts])


def _comparison(results: Sequence[ToolResult]) -> str:
    rates = {result.tool: result.mistakes.value for result in results}
    ours = rates.pop(results[0].tool)
    others = [rate for rate in rates.values() if rate is not None]
    if ours is None or not others:
        return ""
    best = min(others)
    ratio = f"{best / ours:.1f} times" if ours > 0 else "more than any number of times"
    return f"The best other tool makes {ratio} the mistakes of {results[0].tool}."


def _tools(results: Sequence[ToolResult]) -> _Table:
    columns = ("tool", "mistakes", "95 %", "cases")
    rows: list[tuple[str, ...]] = []
    for result in results:
        row = result.mistakes
        rows.append((result.tool, _number(row.value, row), _interval(row), f"{row.cases}"))
    return columns, rows


def _score(row: RoundScore) -> tuple[str, ...]:
    met = "" if row.met is None else "yes" if row.met else "NO"
    value = _number(row.value, row)
    return row.name, value, _interval(row), f"{row.cases}", row.target, met


def _number(value: float | None, row: RoundScore) -> str:
    if value is None:
        return ""
    return f"{value:.1%}" if row.low is not None else f"{value:.3g}"


def _interval(row: RoundScore) -> str:
    return "" if row.low is None or row.high is None else f"{row.low:.1%} to {row.high:.1%}"


def _case(v: Verdict) -> tuple[str, ...]:
    planted = "; ".join(_planted(effect) for effect in v.truth["effects"]) or "nothing"
    said = ", ".join(map(_found, v.answer.findings))
    withheld = f", {v.truth['withheld']} withheld" if v.truth["withheld"] else ""
    return (
        v.case,
        v.word,
        v.kind + withheld,
        planted,
        str(v.truth["motion"]),
        str(v.truth["noise_law"]),
        said or v.answer.failure or "nothing",
        (v.answer.unexplained_frame or "yes") if v.answer.unexplained else "",
    )


def _found(finding: ClaimedEffect) -> str:
    sure = "" if finding.confidence is None else f" {finding.confidence:.2f}"
    return "/".join(finding.names) + sure


def _planted(effect: dict[str, Any]) -> str:
    snr = "" if effect["snr"] is None else f", {effect['snr']:.0f}"
    return f"{effect['source']} ({effect['multiple']:.1f}{snr})"


def _row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
