"""The configuration as text: a commented file that loads to the same values, and the reference.

python -m ahrsd.config.text > docs/reference/configuration.md
"""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ahrsd.config.loading import Config, listed_sections

_WIDTH = 96
_SIGNS = ((Ge, "ge", ">="), (Gt, "gt", ">"), (Le, "le", "<="), (Lt, "lt", "<"))

_PREFACE = """\
# Configuration

`ahrsd run --config FILE` reads TOML; every key has a default, so an empty file is a configuration.
`ahrsd run --print-config` prints the one in force, with these comments. A key that is not here is
an error. Written by `python -m ahrsd.config.text > docs/reference/configuration.md` from the code.
"""


def print_config(config: Config) -> str:
    """TOML with a comment on each key; load_config of it gives an equal configuration."""
    lines: list[str] = []
    for name, section in _sections(config):
        lines += [""] * bool(lines)
        if name:
            title = f"[[{name}]]" if name in _listed() else f"[{name}]"
            lines += [*_comment(type(section).__doc__ or ""), title]
        for key, field in _keys(type(section)):
            value = getattr(section, key)
            allowed = _allowed(field)
            lines += _comment(_text(field) + f" ({allowed})" * bool(allowed))
            lines.append(f"# {key} =" if value is None else f"{key} = {to_toml(value)}")
    return "\n".join(lines) + "\n"


def reference() -> str:
    """The reference of all keys, in Markdown."""
    lines = [_PREFACE]
    for name, section in [*_sections(Config()), *_listed().items()]:
        title = f"## `[{name}]`" if name else "## Keys in front of all tables"
        title = f"## `[[{name}]]`, as often as needed" if name in _listed() else title
        lines += [title, "", type(section).__doc__ or "", ""]
        lines += ["| key | default | allowed | effect |", "|---|---|---|---|"]
        for key, field in _keys(type(section)):
            value = field.get_default()
            default = "" if value is None else f"`{to_toml(value)}`"
            lines.append(f"| `{key}` | {default} | {_allowed(field)} | {_text(field)} |")
        lines.append("")
    return "\n".join(lines)


def to_toml(value: object) -> str:
    """One value as TOML spells it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, date):
        return value.isoformat()
    text = str(value) if isinstance(value, Path) else value
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _sections(config: Config) -> Iterator[tuple[str, BaseModel]]:
    yield "", config
    for name in type(config).model_fields:
        value = getattr(config, name)
        if isinstance(value, BaseModel):
            yield name, value
        elif name in _listed():
            yield from ((name, one) for one in value)


def _listed() -> dict[str, BaseModel]:
    """Tables that may be there several times, with their defaults."""
    return {name: section.model_construct() for name, section in listed_sections().items()}


def _keys(section: type[BaseModel]) -> Iterator[tuple[str, FieldInfo]]:
    for name, field in section.model_fields.items():
        if not isinstance(field.get_default(), BaseModel) and name not in _listed():
            yield name, field


def _text(field: FieldInfo) -> str:
    return " ".join((field.description or "").split())


def _allowed(field: FieldInfo) -> str:
    """What a key takes: its choices, its limits, or its type."""
    if get_origin(field.annotation) is Literal:
        return " ".join(to_toml(choice) for choice in get_args(field.annotation))
    limits = [
        f"{sign} {getattr(limit, name):.12g}"
        for kind, name, sign in _SIGNS
        for limit in field.metadata
        if isinstance(limit, kind)
    ]
    return ", ".join(limits) or _kind(field.annotation)


def _kind(annotation: object) -> str:
    kinds = get_args(annotation) or (annotation,)
    names = {bool: "true or false", Path: "path", date: "date"}
    return " ".join(names[kind] for kind in kinds if kind in names)


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")


if __name__ == "__main__":
    sys.stdout.write(reference())
