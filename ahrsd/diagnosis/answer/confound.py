"""What would separate two effects that this motion cannot tell apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ahrsd.diagnosis.effects.effect import Effect


def separating_manoeuvre(library: Mapping[str, Effect], name: str, others: Sequence[str]) -> str:
    """What to drive so that `name` and the likeliest of `others` come apart, in words."""
    for other in others:
        for one, two in ((name, other), (other, name)):
            if one in library:
                for confuser, words in library[one].confusers:
                    if confuser == two:
                        return words
    return library[name].manoeuvre if name in library else ""
