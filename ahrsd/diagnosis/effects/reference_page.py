"""The reference page of the library of effects.

python -m ahrsd.diagnosis.effects.reference_page > docs/reference/effects.md
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import numpy as np

from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects.effect import Effect, Parameter
from ahrsd.diagnosis.effects.library import EFFECTS

_PREFACE = """\
# Effects

The library of `ahrsd diagnose`: the effects that may make a recording differ from the calibration
model. `ahrsd simulate --effect` and `ahrsd emulate --effect` can simulate them. Written from the
code by `python -m ahrsd.diagnosis.effects.reference_page > docs/reference/effects.md`.

```
m = A h + b + D theta + noise      magnetometer, gauss;  A soft iron, b hard iron
w_read = w + w_b + W theta + noise gyro, rad/s;  w_b bias
h: field in the sensor frame, dh/dt = h x w;  R: sensor frame to north, east, down
```

`--effect ID` simulates an effect at its typical size, `--effect ID=2` at twice that, and
`--effect ID=name=value,name=value` with the given parameters, all others 0; parts of the setting
(`onset_s`, `time_constant_s`, ...) are given the same way. Columns that the effect needs are
invented and written next to the samples.

"typical" is strength 1 of `simulate`; "prior" is one prior standard deviation of the parameter, and
a fitted value beyond "limit" is rejected. Codes and most sizes are those of the project's design
dossier, which names the sources given here; they were not all read again for this page.
"""
_FAMILIES = {
    "sensor": "On the sensor and the vehicle",
    "world": "In the world",
    "gyro": "Gyro",
    "link": "Link, clock and people",
}
_KINDS = {
    "mean": "",
    "variance": "It changes the scatter of the readings, not their mean: no parameter is fitted.",
    "discrete": "It is present or not, and is tested before any physics.",
}


def page(library: Mapping[str, Effect] = EFFECTS) -> str:
    """The page in Markdown."""
    lines = [_PREFACE]
    for family, title in _FAMILIES.items():
        lines += [f"## {title}", ""]
        for effect in library.values():
            if effect.family == family:
                lines += _effect_lines(effect)
    lines += _column_lines()
    return "\n".join(lines)


def _effect_lines(effect: Effect) -> Iterator[str]:
    yield f"### `{effect.identifier}` ({effect.code})"
    yield ""
    yield f"{effect.words[:1].upper()}{effect.words[1:]}."
    if _KINDS[effect.kind]:
        yield _KINDS[effect.kind]
    yield ""
    yield f"    {effect.equation}"
    yield ""
    yield "| parameter | unit | typical | prior | limit |"
    yield "|---|---|---|---|---|"
    pairs = zip(effect.parameters, effect.typical, strict=True)
    for _, alike in groupby(pairs, lambda pair: _row_key(pair[0])):
        yield _parameter_row(list(alike))
    yield ""
    yield f"* Looks like: {effect.signature}."
    if effect.needs:
        needs = " and ".join(" or ".join(need.split("|")) for need in effect.needs)
        yield f"* Needs: {needs}."
    yield f"* Seen: {effect.size}."
    yield f"* Do: {effect.manoeuvre}."
    for other, separation in effect.confusers:
        yield f"* Not [`{other}`](#{_anchor(other)}): {separation}."
    yield f"* Source: {effect.source}."
    yield ""


def _row_key(parameter: Parameter) -> tuple[object, ...]:
    """What parameters in one row of the table have in common."""
    stem, _, _ = parameter.name.rpartition("_")
    return stem or parameter.name, parameter.unit, parameter.scale, parameter.bound


def _parameter_row(alike: Sequence[tuple[Parameter, float]]) -> str:
    first = alike[0][0]
    names = ", ".join(f"`{parameter.name}`" for parameter, _ in alike)
    typical = ", ".join(f"{value:.3g}" for _, value in alike)
    least = "" if np.isinf(first.least) else f"{first.least:.3g} to "
    return f"| {names} | {first.unit} | {typical} | {first.scale:.3g} | {least}{first.bound:.3g} |"


def _anchor(identifier: str) -> str:
    """The anchor that a Markdown viewer gives the heading."""
    code = EFFECTS[identifier].code.lower().replace(",", "").replace(" ", "-")
    return f"{identifier}-{code}"


def _column_lines() -> Iterator[str]:
    """The roles of further columns."""
    yield "## Columns of a recording"
    yield ""
    yield "A column's name and unit give it its role; the first row that fits decides. Attitude"
    yield "(`ref_q*`, `vn_*`) has none, and a 0/1 column of another name is a switch, or pulses"
    yield "if it is never on for more than a few samples. Gaps of at most 2 s are filled. A column"
    yield "with longer gaps, without any change, or with values that its unit excludes is left out,"
    yield "and a note says why."
    yield ""
    yield "| role | what | name fits | effect counts as zero at | from | to |"
    yield "|---|---|---|---|---|---|"
    for name, role in roles.ROLES.items():
        pattern = role.pattern.replace("|", "\\|")
        zero = "0" if role.zero == "zero" else "the recording's mean"
        low, high = role.limits
        yield f"| {name} | {role.words} | `{pattern}` | {zero} | {low:g} | {high:g} |"
    yield ""


if __name__ == "__main__":
    sys.stdout.write(page())
