"""The report of a diagnosis: one HTML file with its pictures inside."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ahrsd.diagnosis.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.ordinary_text import in_one_sentence, ordinary_left, size_lines
from ahrsd.diagnosis.shown import shown
from ahrsd.diagnosis.spoken import headline, place, sensitivity, value_text, verdict
from ahrsd.report.template import Picture, number, picture, render

_MG = 1e3
#: what each picture is called, and what is said below it
_OVER_TIME = (
    "innovations over time, before and after",
    "Readings less what the model expected of them a moment before, before (orange) and after "
    "(blue) the effects above; the places that were found are shaded.",
)
_BY_FREQUENCY = (
    "spectrum of the innovations",
    "The same by frequency: 1 everywhere where nothing is left.",
)
_BY_NAME = (
    "evidence of every effect",
    "How much every effect alone would explain; named ones in blue. The line is what a name needs.",
)
#: said below the spectrum where the blue curve is the worse one
_WORSE_SPECTRUM = (
    "Here it is farther from 1 after than before: the named effects explain the readings where "
    "they are located, not how the innovations spread over the frequencies."
)
#: said below the bars where an effect that was not named has the longer bar
_LOST = (
    "A longer grey bar is no contradiction: each bar is of one effect without any other. What a "
    "grey one explains, the named ones explain as well; beside them it adds less than a name "
    "needs, or it fails on parts of the recording that were not fitted."
)
#: the statistics of the checks, in words
_STATISTICS = {
    "normalised_innovation": "mean square of the innovations, 1: as the noise says",
    "autocorrelation": "how much innovations remember of those before them",
    "shift_sensor": "longest shift of their mean, axes of the sensor",
    "shift_world": "longest shift of their mean, axes of the world",
    "shift_turn": "longest shift of their mean, across the field",
    "field_size": "shift or trend of the field's strength",
    "heading": "dependence on the heading",
    "tail": "largest innovations (the highest in a thousand)",
    "line": "highest line of the spectrum over its mean",
    "covariates": "correlation with a logged column or its rate",
}
_BY_CONDITION = (
    "what is left by condition",
    "Under which conditions readings and model differ, before and after: a row a quantity, low "
    "values left, high ones right. Dark is much; noise alone has 1 to 3.",
)
_NOT_FITTED = (
    "gain on parts that were not fitted",
    "What the models gain over the calibration alone on parts of the recording that they were not "
    "fitted to. Moved in time: the same effects where they cannot be.",
)
_BY_FRAME = (
    "what is left, by frame",
    "What is left after the named effects, drawn freely in three frames; grey: two standard "
    "deviations.",
)


def write_diagnosis_report(path: Path, found: Diagnosis, command: str) -> None:
    """Write the page.  OSError where it cannot be written."""
    ordinary = ordinary_left(found)
    page = render(
        "diagnosis.html",
        title=f"Diagnosis of {found.recording}",
        found=found,
        verdict=verdict(found),
        findings=[_finding(found, one) for one in found.findings],
        unexplained=_unexplained(found),
        ordinary=None if ordinary is None else in_one_sentence(ordinary),
        how_real=_how_real(found),
        pictures=_pictures(found),
        sensitivity=sensitivity(found.sensitivity),
        limits=_limits(found),
        checks=[
            (_STATISTICS.get(name, name.replace("_", " ")), check)
            for name, check in found.posterior_predictive.items()
        ],
        baseline=_baseline(found),
        command=command,
    )
    path.write_text(page, encoding="utf-8")


def _finding(found: Diagnosis, one: Finding) -> dict[str, object]:
    held, cost = one.heldout, one.cost_if_left_out
    rows = []
    if cost is not None:
        off = (
            f"hard iron off by {number(cost.hard_iron_shift_gauss * _MG, 'mG')}, heading by "
            f"{number(cost.heading_error_deg, 'deg')}"
        )
        rows.append(("without it", off))
    if held is not None:
        gain = (
            f"{held.nll_gain_per_sample:+.4f} nats per sample; the same effect moved in time gains "
            f"at most {held.placebo_gain:+.4f}"
        )
        rows.append(("on data not fitted", gain))
    if one.alternatives:
        rest = ", ".join(f"{a.effect} ({a.confidence:.1%})" for a in one.alternatives)
        rows.append(("or else", rest))
    if one.separate_from:
        rows.append(("to be sure", one.separate_from))
    return {
        "headline": headline(one),
        "where": place(one.where),
        "sizes": [value_text(value) for value in one.parameters],
        "equation": one.equation,
        "rows": rows,
        "picture": _contribution(found, one),
    }


def _contribution(found: Diagnosis, one: Finding) -> Picture | None:
    if found.drawn is None or one.term is None:
        return None
    from ahrsd.report import diagnosis_figures as figures

    added = found.drawn.contributions[one.term]
    draw = partial(figures.contribution, added)
    return picture(draw, f"{one.effect} over time", "What it adds to the readings.")


def _unexplained(found: Diagnosis) -> list[tuple[str, str]]:
    left = found.unexplained
    if left.where is None or not (left.detected or left.ordinary):
        return []
    rows = [("where", place(left.where))]
    if left.size is not None:
        rows.append(("size", number(left.size, left.unit)))
    if left.ordinary is not None:
        rows += [("part", text) for text in size_lines(left.ordinary)]
        rows += [("yardstick", left.ordinary.why)] if left.ordinary.why else []
    if left.single_source_share is not None:
        rows.append(("one source", f"{left.single_source_share:.0%} of it has one direction"))
    rows += [
        (
            "moves with",
            f"{shown(s.channel)}, correlation {s.correlation:+.2f}, p = {s.p_value:.1g}",
        )
        for s in left.follows
    ]
    return rows


def _how_real(found: Diagnosis) -> str:
    """Only what the pictures below show."""
    from ahrsd.report.diagnosis_figures import stands_out

    if found.drawn is not None and found.drawn.courses and not stands_out(found.drawn):
        return (
            "All of it together is more than chance, but at no moment does it leave the band that "
            "its own uncertainty draws: that it is there is known, its course is not."
        )
    return "It is real: it has a place and a size."


def _limits(found: Diagnosis) -> list[dict[str, object]]:
    """One row an effect: the limits of its parameters; those that are invisible last."""
    seen: dict[str, list[str]] = {}
    hidden: dict[str, list[str]] = {}
    for limit in found.sensitivity:
        if limit.smallest is None:
            hidden.setdefault(limit.effect, []).append(limit.parameter)
        else:
            smallest = f"{limit.parameter} {number(limit.smallest, limit.unit)}"
            seen.setdefault(limit.effect, []).append(smallest)
    rows: list[dict[str, object]] = [{"effect": e, "smallest": texts} for e, texts in seen.items()]
    return rows + [
        {"effect": effect, "smallest": [], "hidden": names} for effect, names in hidden.items()
    ]


def _pictures(found: Diagnosis) -> list[Picture]:
    drawn = found.drawn
    if drawn is None:
        return []
    from ahrsd.report import diagnosis_figures as figures

    worse = figures.spectrum_is_worse(drawn)
    shots = [
        (partial(figures.residual, found, drawn), *_OVER_TIME),
        (partial(figures.spectrum, drawn), *_longer(_BY_FREQUENCY, worse, _WORSE_SPECTRUM)),
    ]
    if drawn.evidence:
        longer = figures.grey_ones_are_longer(found, drawn)
        shots.append((partial(figures.evidence, found, drawn), *_longer(_BY_NAME, longer, _LOST)))
    if found.regime_map:
        shots.append((partial(figures.regime_map, found.regime_map), *_BY_CONDITION))
    if found.validation is not None and found.findings:
        shots.append((partial(figures.validation, found.validation), *_NOT_FITTED))
    if drawn.courses:
        shots.append((partial(figures.courses, drawn), *_BY_FRAME))
    return [picture(*shot) for shot in shots]


def _longer(texts: tuple[str, str], wanted: bool, more: str) -> tuple[str, str]:
    """A picture's name and caption, with a further sentence where it is wanted."""
    return (texts[0], f"{texts[1]} {more}") if wanted else texts


def _baseline(found: Diagnosis) -> list[tuple[str, str]]:
    base = found.baseline
    if base is None:
        return []
    rows = [
        ("rms of the innovations", number(base.heldout_rms_gauss * _MG, "mG")),
        ("normalised innovation (1: as expected)", number(base.normalised_innovation)),
    ]
    if found.model is not None:
        iron = ", ".join(f"{value * _MG:+.2f}" for value in found.model.hard_iron_gauss)
        rows.append(("hard iron with the effects in the model", f"{iron} mG"))
    return rows
