"""Hashes that say: this key was fixed before the answers, these answers before the key was seen.

In the cases' folder: `sealed.json` (hash of the key, hashes of the cases), `answers/TOOL/` with
`answers.json` (hashes of the answers), and `opened.json` from the moment somebody scored.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ahrsd.errors import AhrsdError

Json = dict[str, Any]

SEALED, OPENED, ANSWERS = "sealed.json", "opened.json", "answers.json"
CASE, SPEC = "case.csv.gz", "spec.json"
_SALT = "salt"


@dataclass(frozen=True, slots=True)
class Round:
    """A folder of sealed cases."""

    folder: Path
    sha256: str
    ring: str
    cases: tuple[str, ...]

    def case(self, name: str) -> Path:
        """The table of a case."""
        return self.folder / name / CASE

    def spec(self, name: str) -> Path:
        """What its user says of the sensor."""
        return self.folder / name / SPEC

    def answers(self, tool: str) -> Path:
        """Where a tool's answers go."""
        return self.folder / "answers" / tool

    def tools(self) -> list[str]:
        """Tools with a finished set of answers."""
        return sorted(path.parent.name for path in self.folder.glob(f"answers/*/{ANSWERS}"))

    @property
    def opened(self) -> Json | None:
        """What was written when the key was opened; None before."""
        path = self.folder / OPENED
        return read_object(path) if path.exists() else None


def now() -> str:
    """UTC to the second, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def canonical(value: Json) -> bytes:
    """The bytes that are hashed: keys sorted, no spaces."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def file_sha256(path: Path) -> str:
    """Hash of a file.  AhrsdError where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}") from error


def read_object(path: Path) -> Json:
    """A JSON object.  AhrsdError where it is none."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise AhrsdError(f"{path}: is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise AhrsdError(f"{path}: is no JSON object")
    return value


def write_object(path: Path, value: Json) -> None:
    """Written whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error


def key_sha256(key: Json) -> str:
    """Hash of salt and key; the salt is in the key's `salt`."""
    rest = {name: value for name, value in key.items() if name != _SALT}
    return hashlib.sha256(bytes.fromhex(key[_SALT]) + canonical(rest)).hexdigest()


def seal(folder: Path, key_path: Path) -> Round:
    """Give the key its salt, write its hash and the cases' hashes into the cases' folder."""
    key = read_object(key_path) | {_SALT: secrets.token_hex(32)}
    write_object(key_path, key)
    names = [str(case["id"]) for case in key["cases"]]
    sealed: Json = {
        "schema": "blind_trials.sealed/1",
        "ring": key["ring"],
        "sealed_utc": now(),
        "sha256_of_salt_and_key": key_sha256(key),
        "cases": {
            name: {file: file_sha256(folder / name / file) for file in (CASE, SPEC)}
            for name in names
        },
    }
    write_object(folder / SEALED, sealed)
    return open_round(folder)


def open_round(folder: Path) -> Round:
    """The cases of a folder.  AhrsdError where they are not sealed or were changed since."""
    path = folder / SEALED
    if not path.exists():
        raise AhrsdError(f"{folder}: no {SEALED} in it; `ahrsd challenge make` writes one")
    sealed = read_object(path)
    for name, hashes in sealed["cases"].items():
        for file, expected in hashes.items():
            if file_sha256(folder / name / file) != expected:
                raise AhrsdError(
                    f"{folder / name / file}: is not what was sealed; make a new round"
                )
    return Round(
        folder, str(sealed["sha256_of_salt_and_key"]), str(sealed["ring"]), tuple(sealed["cases"])
    )


def close_answers(trial: Round, tool: str) -> str:
    """Hash a tool's finished answers into its `answers.json`; the hash of them all."""
    folder = trial.answers(tool)
    hashes = {name: file_sha256(folder / f"{name}.json") for name in trial.cases}
    total = hashlib.sha256(canonical(hashes)).hexdigest()
    closed: Json = {
        "schema": "blind_trials.answers/1",
        "tool": tool,
        "finished_utc": now(),
        "round_sha256": trial.sha256,
        "sha256": total,
        "answers": hashes,
    }
    write_object(folder / ANSWERS, closed)
    return total


def refuse_opened(trial: Round) -> None:
    """AhrsdError where the key of the round has been seen: no answer counts any more."""
    if (opened := trial.opened) is not None:
        raise AhrsdError(
            f"{trial.folder}: its key was opened on {opened['opened_utc']}; make a new round"
        )


def check_answers(trial: Round, tool: str) -> Json:
    """The tool's `answers.json`.  AhrsdError where an answer changed or belongs elsewhere."""
    folder = trial.answers(tool)
    closed = read_object(folder / ANSWERS)
    if closed["round_sha256"] != trial.sha256:
        raise AhrsdError(f"{folder}: answers to another round; run the tool on this one")
    for name, expected in closed["answers"].items():
        if file_sha256(folder / f"{name}.json") != expected:
            raise AhrsdError(f"{folder / name}.json: was changed after the answers were closed")
    return closed


def open_key(trial: Round, key_path: Path, tools: list[str]) -> Json:
    """The key, and a note of when it was opened and whose answers were closed by then.

    AhrsdError where the key is not the sealed one or answers came after an earlier opening.
    """
    key = read_object(key_path)
    if _SALT not in key or key_sha256(key) != trial.sha256:
        raise AhrsdError(f"{key_path}: is not the key that was sealed with {trial.folder}")
    closed = {tool: check_answers(trial, tool) for tool in tools}
    opened = trial.opened
    if opened is None:
        opened = {
            "schema": "blind_trials.opened/1",
            "opened_utc": now(),
            "answers": {tool: closed[tool]["sha256"] for tool in tools},
        }
        write_object(trial.folder / OPENED, opened)
    for tool in tools:
        if opened["answers"].get(tool) != closed[tool]["sha256"]:
            raise AhrsdError(
                f"{tool}: answers are not those that were closed when the key was opened "
                f"({opened['opened_utc']}); make a new round"
            )
    return key
