"""The changelog can be made from the files in docs/changes, and none of them is left out."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).parent.parent
WAITING = sorted(
    path for path in (PROJECT / "docs" / "changes").iterdir() if path.name != "README.md"
)


def build(*options: str, folder: Path = PROJECT) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "towncrier", "build", "--version", "9.8.7", *options],
        cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout


@pytest.fixture
def project(tmp_path):
    """The changelog and its settings, with one change that waits."""
    for name in ("pyproject.toml", "CHANGELOG.md"):
        shutil.copy(PROJECT / name, tmp_path)
    changes = tmp_path / "docs" / "changes"
    changes.mkdir(parents=True)
    (changes / "+pump.fixed.md").write_text("A pump is no longer a thruster.\n", encoding="utf-8")
    subprocess.run(["git", "init", "--quiet", tmp_path], check=True)  # where towncrier adds files
    return tmp_path


def test_every_change_that_waits_is_in_the_draft():
    draft = " ".join(build("--draft").split())
    assert "## 9.8.7 (" in draft
    for path in WAITING:
        assert path.suffix == ".md" and path.name.startswith("+")
        assert " ".join(path.read_text(encoding="utf-8").split()) in draft, path.name


def test_a_release_stands_above_those_before_and_changes_nothing_in_them(project):
    before = (PROJECT / "CHANGELOG.md").read_text(encoding="utf-8")
    build("--yes", "--date", "2027-01-02", folder=project)
    after = (project / "CHANGELOG.md").read_text(encoding="utf-8")
    top, mark, rest = before.partition("<!-- towncrier release notes start -->\n")
    assert mark and after.startswith(top + mark) and after.endswith(rest.lstrip())
    added = after[len(top + mark) : -len(rest.lstrip())]
    words = " ".join(added.split())
    assert words == "## 9.8.7 (2027-01-02) ### Fixed - A pump is no longer a thruster."
