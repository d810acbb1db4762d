"""The README keeps its word: commands that exist, files that exist, code blocks that are right."""

import re
import tomllib
from pathlib import Path

import pytest

from ahrsd.cli import COMMANDS
from ahrsd.config.config import check_config
from ahrsd.demo import FILES

PROJECT = Path(__file__).parents[2]
README = (PROJECT / "README.md").read_text()
PAGES = [PROJECT / "README.md", *sorted((PROJECT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page):
    text = page.read_text()
    links = re.findall(r"\]\(([^)#:]+)\)", text)
    missing = [link for link in links if not (page.parent / link).exists()]
    assert missing == []


def test_pages_that_are_named_exist():
    for page in PAGES:
        for name in re.findall(r"\bdocs/[a-z-]+\.md\b", page.read_text()):
            assert (PROJECT / name).exists(), f"{page.name}: {name}"


def test_every_command_in_the_table_exists():
    table = README[README.index("| command | does |") : README.index("Exit codes:")]
    named = re.findall(r"^\| `([a-z]+)", table, re.MULTILINE)
    assert len(named) >= 8
    assert set(named) <= set(COMMANDS)


def test_the_two_commands_need_nothing_but_python():
    blocks = re.findall(r"```\n(python3 -m venv .*)\n```", README)
    assert len(blocks) == 2
    assert blocks[0].endswith(".venv/bin/ahrsd demo")
    assert ".venv/bin/python -m pytest" in blocks[1]
    assert "://" not in "".join(blocks)  # no registry is named


def test_the_benchmarks_that_are_quoted_exist():
    scripts = re.findall(r"python (tests/benchmarks/\w+/\w+\.py)", README)
    assert scripts
    assert all((PROJECT / name).exists() for name in scripts)


def test_the_files_of_the_demo_are_named():
    assert all(f"`{name}`" in README for name in FILES)


def test_the_configuration_of_the_operating_page_is_one():
    page = (PROJECT / "docs" / "guide" / "operating.md").read_text()
    body = re.search(r"```toml\n(.*?)```", page, re.DOTALL)
    assert body is not None
    config = check_config(tomllib.loads(body[1]), "operating.md")
    assert config.mode == "stage"


def test_every_configuration_of_the_sharing_page_is_one():
    page = (PROJECT / "docs" / "guide" / "sharing.md").read_text()
    bodies = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    shares = [
        share for body in bodies for share in check_config(tomllib.loads(body), "sharing.md").share
    ]
    assert {share.kind for share in shares} == {"pty", "tcp", "udp"}
    assert {share.send for share in shares} == {"raw", "corrected", "nmea"}
