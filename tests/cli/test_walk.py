"""The walk for newcomers names files and names that exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]
PAGE = (PROJECT / "docs" / "design" / "walk.md").read_text(encoding="utf-8")
STOPS = re.findall(r"`((?:ahrsd|drivers)/[\w/]+\.py): ([\w.]+)`", PAGE)


def defined(body: list[ast.stmt], name: str) -> list[ast.stmt] | None:
    """What stands inside the definition of this name, None where there is no such definition."""
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return node.body
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return []
    return None


@pytest.mark.parametrize(("path", "name"), STOPS, ids=[f"{p}:{n}" for p, n in STOPS])
def test_every_stop_exists(path: str, name: str) -> None:
    body: list[ast.stmt] | None = ast.parse((PROJECT / path).read_text(encoding="utf-8")).body
    for part in name.split("."):
        body = defined(body, part) if body is not None else None
        assert body is not None, f"{path} has no {name}"


def test_each_walk_has_ten_to_fifteen_stops() -> None:
    for walk in PAGE.split("\n## ")[1:]:
        stops = [line for line in walk.splitlines() if line.startswith("| `")]
        assert 10 <= len(stops) <= 15
