"""The report of a diagnosis: one HTML file, pictures inside, nothing loaded from elsewhere."""

from __future__ import annotations

from functools import partial
from html import escape
from pathlib import Path

from ahrsd.diagnosis.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.shown import shown
from ahrsd.diagnosis.spoken import headline, place, sensitivity, value_text, verdict
from ahrsd.report.page import CSS, number, picture, section, table

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
    title = f"Diagnosis of {found.recording}"
    parts = [
        f'<p class="verdict {"no" if found.mismatch else "yes"}">{escape(verdict(found))}</p>',
        *(_finding(found, number_, one) for number_, one in enumerate(found.findings, start=1)),
        _unexplained(found),
        _pictures(found),
        _sensitivity(found),
        _checks(found),
        _baseline(found),
        _notes(found),
        f'<p class="soft">Made by <code>{escape(command)}</code>.</p>',
    ]
    path.write_text(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{CSS}</style></head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n",
        encoding="utf-8",
    )


def _finding(found: Diagnosis, number_: int, one: Finding) -> str:
    held, cost = one.heldout, one.cost_if_left_out
    rows = [
        ("where", escape(place(one.where))),
        ("size", "<br>".join(escape(value_text(value)) for value in one.parameters)),
        ("left out", f"<code>{escape(one.equation)}</code>"),
    ]
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
        rows.append(("or else", escape(rest)))
    if one.separate_from:
        rows.append(("to be sure", escape(one.separate_from)))
    parts = [table(("", ""), [[escape(name), text] for name, text in rows])]
    if found.drawn is not None and one.term is not None:
        from ahrsd.report import diagnosis_figures as figures

        added = found.drawn.contributions[one.term]
        parts.append(
            picture(
                partial(figures.contribution, added),
                f"{one.effect} over time",
                "What it adds to the readings.",
            )
        )
    return section(f"{number_}. {headline(one)}", *parts)


def _unexplained(found: Diagnosis) -> str:
    left = found.unexplained
    if not left.detected or left.where is None:
        return ""
    rows = [("where", escape(place(left.where)))]
    if left.size is not None:
        rows.append(("size", escape(number(left.size, left.unit))))
    if left.single_source_share is not None:
        rows.append(("one source", f"{left.single_source_share:.0%} of it has one direction"))
    rows += [
        (
            "moves with",
            escape(f"{shown(s.channel)}, correlation {s.correlation:+.2f}, p = {s.p_value:.1g}"),
        )
        for s in left.follows
    ]
    words = (
        f"<p>Nothing in the library explains this. {_how_real(found)} A name would be a guess.</p>"
    )
    return section(
        "Unknown, here", words, table(("", ""), [[escape(name), text] for name, text in rows])
    )


def _how_real(found: Diagnosis) -> str:
    """Only what the pictures below show."""
    from ahrsd.report.diagnosis_figures import stands_out

    if found.drawn is not None and found.drawn.courses and not stands_out(found.drawn):
        return (
            "All of it together is more than chance, but at no moment does it leave the band that "
            "its own uncertainty draws: that it is there is known, its course is not."
        )
    return "It is real: it has a place and a size."


def _sensitivity(found: Diagnosis) -> str:
    """One row an effect: the range of its parameters' limits; those that are invisible last."""
    if not found.sensitivity:
        return ""
    seen: dict[str, list[str]] = {}
    hidden: dict[str, list[str]] = {}
    for limit in found.sensitivity:
        if limit.smallest is None:
            hidden.setdefault(limit.effect, []).append(limit.parameter)
        else:
            shown = f"{limit.parameter} {number(limit.smallest, limit.unit)}"
            seen.setdefault(limit.effect, []).append(shown)
    rows = [[escape(effect), escape(", ".join(texts))] for effect, texts in seen.items()]
    rows += [
        [
            escape(effect),
            f'<span class="soft">cannot be seen here: {escape(", ".join(names))}</span>',
        ]
        for effect, names in hidden.items()
    ]
    text = f"<p>This recording would have shown {escape(sensitivity(found.sensitivity))}.</p>"
    inner = table(("effect", "would have been seen from"), rows)
    count = len(seen | hidden)
    folded = (
        f"<details><summary>all {count} effects that were looked for</summary>{inner}</details>"
    )
    return section("What would have been seen", text, folded)


def _pictures(found: Diagnosis) -> str:
    drawn = found.drawn
    if drawn is None:
        return ""
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
    return section("Before and after", *(picture(*shot) for shot in shots))


def _longer(texts: tuple[str, str], wanted: bool, more: str) -> tuple[str, str]:
    """A picture's name and caption, with a further sentence where it is wanted."""
    return (texts[0], f"{texts[1]} {more}") if wanted else texts


def _checks(found: Diagnosis) -> str:
    if not found.posterior_predictive:
        return ""

    def mark(inside: bool) -> str:
        return '<span class="good">in</span>' if inside else '<span class="bad">out</span>'

    rows = [
        [
            escape(_STATISTICS.get(name, name.replace("_", " "))),
            f"{number(check.value)} ({number(check.band[0])} to {number(check.band[1])})",
            mark(check.inside_before),
            mark(check.inside_after),
        ]
        for name, check in found.posterior_predictive.items()
    ]
    text = (
        "<p>The recording's own statistics against simulations along its motion: by the "
        "calibration alone (before), and with the effects above (after), whose range is shown.</p>"
    )
    head = ("statistic", "recording (simulated)", "before", "after")
    return section("Does the repaired simulation look like the recording?", text, table(head, rows))


def _baseline(found: Diagnosis) -> str:
    base = found.baseline
    if base is None:
        return ""
    rows = [
        ["rms of the innovations", number(base.heldout_rms_gauss * _MG, "mG")],
        ["normalised innovation (1: as expected)", number(base.normalised_innovation)],
    ]
    if found.model is not None:
        iron = ", ".join(f"{value * _MG:+.2f}" for value in found.model.hard_iron_gauss)
        rows.append(["hard iron with the effects in the model", f"{iron} mG"])
    return section("The calibration alone", table(("", ""), rows))


def _notes(found: Diagnosis) -> str:
    if not found.notes:
        return ""
    return section(
        "Notes", "<ul>" + "".join(f"<li>{escape(n)}</li>" for n in found.notes) + "</ul>"
    )
