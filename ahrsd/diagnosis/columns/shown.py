"""A column's name as a person is shown it: whatever a file calls its columns, one short line."""

from __future__ import annotations

#: characters of a name that are shown
MOST = 48


def shown(name: str) -> str:
    """The name with what is not printable as its escape, and its middle left out if it is long."""
    if len(name) > MOST:
        name = f"{name[: MOST - 13]}...{name[-10:]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
