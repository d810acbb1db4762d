"""Answers and key together: every case judged, every score, files for people and programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ahrsd.errors import AhrsdError
from blind_trials.answers import ToolAnswer, read_answer
from blind_trials.judge import ORDER, judge
from blind_trials.report import html, markdown
from blind_trials.running import OURS, answered_nothing, could_not_run
from blind_trials.scores import ToolResult, error_rate, scores
from blind_trials.sealing import Json, Round, open_key, read_object, write_object


def unable(trial: Round) -> dict[str, str]:
    """Tools that could not run, and why: theirs are no answers, so they are not scored."""
    found: dict[str, str] = {}
    for tool in trial.tools():
        folder = trial.answers(tool)
        records = [read_object(folder / f"{case}.json") for case in trial.cases]
        if lacking := [why for why in map(could_not_run, records) if why]:
            found[tool] = (
                f"it could not run on {len(lacking)} of {len(records)} cases: {lacking[0]}"
            )
        elif why := answered_nothing(records):
            found[tool] = f"it could not run on {len(records)} of {len(records)} cases: {why}"
    return found


def score(trial: Round, key_path: Path, output: Path) -> list[ToolResult]:
    """Open the key, judge all tools, write score.json, report.md and report.html into `output`.

    A tool that could not run is not judged. AhrsdError where seals are broken or nobody answered.
    """
    left_out = unable(trial)
    tools = sorted(set(trial.tools()) - set(left_out), key=lambda tool: (tool != OURS, tool))
    if not tools:
        raise AhrsdError(
            "\n".join(
                [f"{tool}: not scored: {why}" for tool, why in left_out.items()]
                + [f"{trial.folder}: no finished answers; `ahrsd challenge run` first"]
            )
        )
    key = open_key(trial, key_path, tools)
    results = [_result(tool, key["cases"], _answers(trial, tool)) for tool in tools]
    output.mkdir(parents=True, exist_ok=True)
    opened = trial.opened or {}
    head: Json = {
        "schema": "blind_trials.score/1",
        "ring": key["ring"],
        "cases": len(key["cases"]),
        "sha256_of_salt_and_key": trial.sha256,
        "opened_utc": opened.get("opened_utc"),
        "answers_sha256": opened.get("answers"),
        "not_scored": left_out,
    }
    write_object(output / "score.json", head | {"tools": [_json(result) for result in results]})
    for name, text in (
        ("report.md", markdown(head, results)),
        ("report.html", html(head, results)),
    ):
        try:
            (output / name).write_text(text, encoding="utf-8")
        except OSError as error:
            raise AhrsdError(f"{output / name}: cannot be written: {error.strerror}") from error
    return results


def _answers(trial: Round, tool: str) -> dict[str, ToolAnswer]:
    folder = trial.answers(tool)
    return {case: read_answer(read_object(folder / f"{case}.json")) for case in trial.cases}


def _result(tool: str, truths: list[Json], answers: dict[str, ToolAnswer]) -> ToolResult:
    controls = {
        str(truth["motion"]): answers[str(truth["id"])]
        for truth in truths
        if truth["kind"] == "control"
    }
    verdicts = [
        judge(truth, answers[str(truth["id"])], controls.get(str(truth["motion"])))
        for truth in truths
    ]
    verdicts.sort(key=lambda v: (not v.error, ORDER.index(v.word), v.kind, -(v.multiple or 0)))
    return ToolResult(tool, verdicts, scores(verdicts), error_rate(verdicts))


def _json(result: ToolResult) -> dict[str, Any]:
    return {
        "tool": result.tool,
        "mistakes": result.mistakes.json(),
        "scores": [row.json() for row in result.scores],
        "cases": [
            {
                "id": v.case,
                "kind": v.kind,
                "verdict": v.word,
                "mistake": v.error,
                "planted": [effect["source"] for effect in v.truth["effects"]],
                "multiple": v.multiple,
                "ideal_snr": [effect["snr"] for effect in v.truth["effects"]],
                "named": list(v.answer.names),
                "unexplained": v.answer.unexplained,
                "confidence": v.confidence,
                "frame_right": v.frame_right,
                "overlap": v.overlap,
                "onset_error_s": v.onset_error_s,
                "pulls": list(v.pulls),
                "gain_share": v.gain,
                "cpu_seconds": v.answer.seconds,
                "failure": v.answer.failure,
            }
            for v in result.verdicts
        ],
    }
