"""The reference page of effects agrees with the library."""

from __future__ import annotations

import re
from pathlib import Path

from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.effects.reference_page import page

PROJECT = Path(__file__).parents[3]


def test_reference_page_is_generated_from_the_library():
    assert (PROJECT / "docs" / "reference" / "effects.md").read_text() == page(), (
        "run: python -m ahrsd.diagnosis.effects.reference_page > docs/reference/effects.md"
    )


def test_reference_page_has_every_effect_and_no_broken_link():
    text = page()
    headings = re.findall(r"^### `(\w+)` \((.+)\)$", text, re.MULTILINE)
    assert [name for name, _ in headings] == sorted(EFFECTS, key=order)
    anchors = {f"{n}-{c}".lower().replace(",", "").replace(" ", "-") for n, c in headings}
    links = set(re.findall(r"\]\(#([^)]+)\)", text))
    assert links and links <= anchors


def order(name: str) -> tuple[int, int]:
    families = ["sensor", "world", "gyro", "link"]
    return families.index(EFFECTS[name].family), list(EFFECTS).index(name)
