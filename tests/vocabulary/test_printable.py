"""Counts in English, in the lines that a person reads."""

import ast
import re
from pathlib import Path

from ahrsd.printable import counted

PROJECT = Path(__file__).parents[2]
THINGS = "sample|row|line|message|column|record|gap|reading|thing|packet|place|finding"
PLURAL = re.compile(rf" (?:(?!holds)\w+ )?(?:{THINGS})s\b")
#: in front of a number that is a limit or a whole, and so never one
LIMIT = re.compile(r"(?:of|of over|than|least|most|every|all|first|newest|needs|limit) $")


def test_one_is_singular_and_nothing_else_is():
    assert [counted(n, "sample") for n in (0, 1, 2)] == ["0 samples", "1 sample", "2 samples"]
    assert [counted(n, "message", ",") for n in (1, 1234)] == ["1 message", "1,234 messages"]


def plural_always(tree: ast.AST) -> list[str]:
    """Numbers in f-strings that have a plural behind them whatever they are."""
    found = []
    for text in ast.walk(tree):
        if not isinstance(text, ast.JoinedStr):
            continue
        before = ""
        for number, behind in zip(text.values, [*text.values[1:], None], strict=True):
            if isinstance(number, ast.Constant):
                before = str(number.value)
                continue
            words = str(behind.value) if isinstance(behind, ast.Constant) else ""
            if PLURAL.match(words) and not LIMIT.search(before):
                named = ast.unparse(number).strip("f'\"{}")
                if not re.fullmatch(r"[\w.]*\.?_?[A-Z_]+(?::.*)?", named):
                    found.append(f"line {text.lineno}: {named}{words}")
            before = ""
    return found


def test_a_plural_that_is_always_there_is_found():
    tree = ast.parse(
        """f"{n} samples"; f"{n} of {len(n)} rows"; f"over {_MOST} rows"; counted(n)"""
    )
    assert plural_always(tree) == ["line 1: n samples"]


def test_no_line_says_1_things():
    found = {
        str(path.relative_to(PROJECT)): said
        for path in sorted((PROJECT / "ahrsd").rglob("*.py"))
        if (said := plural_always(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert found == {}
