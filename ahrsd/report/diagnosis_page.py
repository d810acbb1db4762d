"""The report of a diagnosis: one HTML file with its pictures inside.

Orange is before, blue is after, as everywhere in the project.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ahrsd.diagnosis.answer.diagnosis import (
    Contribution,
    Diagnosis,
    Drawn,
    Finding,
    RegimeMap,
    Validation,
)
from ahrsd.diagnosis.answer.text import (
    agrees,
    component_lines,
    direction_text,
    evidence_text,
    headline,
    ordinary_residual,
    ordinary_text,
    residual_is_drawn,
    sensitivity_text,
    setting_text,
    size_text,
    value_text,
    verdict,
    where_text,
)
from ahrsd.diagnosis.columns.roles import label
from ahrsd.report.figures import AFTER, BEFORE, GREY, SERIES, WIDTH_IN, legend_above
from ahrsd.report.template import Picture, number, picture, render
from ahrsd.samples import Array

# -- Pictures --------------------------------------------------------------------------------------


_BINS = 300  # of time
_REGIMES = 10  # quantities in the map
_AXES = "xyz"
_WORSE = 1.05  # times the mean distance of the spectrum from 1, in logarithms


def _figure(height_in: float, rows: int = 1) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    figure.subplots(rows, 1, sharex=rows > 1)
    return figure


def _binned(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Means of `values` in at most _BINS spans of time; empty ones are left out."""
    edges = np.linspace(time_s[0], time_s[-1], min(_BINS, max(len(time_s) // 8, 2)) + 1)
    index = np.clip(np.searchsorted(edges, time_s, "right") - 1, 0, len(edges) - 2)
    count = np.bincount(index, minlength=len(edges) - 1)
    total = np.bincount(index, weights=values, minlength=len(edges) - 1)
    kept = count > 0
    return 0.5 * (edges[1:] + edges[:-1])[kept], total[kept] / count[kept]


def _both(before: Array, after: Array) -> tuple[tuple[Array, str, str], ...]:
    if np.array_equal(before, after):  # no finding: one would hide the other
        return ((before, BEFORE, "no finding"),)
    return (before, BEFORE, "before"), (after, AFTER, "after")


def residual(found: Diagnosis, drawn: Drawn) -> Figure:
    """Readings less what was expected over time, before and after, located spans shaded."""
    figure = _figure(4.6, 3)
    spans = [span for finding in found.findings for span in finding.where.intervals_s]
    if found.unexplained.where is not None:
        spans += found.unexplained.where.intervals_s
    whole = drawn.time_s[-1] - drawn.time_s[0]
    for k, axes in enumerate(figure.axes):
        for begin, end in spans:
            if end - begin < 0.95 * whole:
                axes.axvspan(begin, end, color=GREY, alpha=0.15, lw=0)
        for values, color, name in _both(drawn.before_gauss, drawn.after_gauss):
            series = _binned(drawn.time_s, values[:, k] * 1e3)
            axes.plot(*series, color=color, lw=1.0, label=name)
        axes.set_ylabel(f"{_AXES[k]}, mG")
    legend_above(figure)
    figure.axes[-1].set_xlabel("time, s")
    return figure


def evidence(found: Diagnosis, drawn: Drawn) -> Figure:
    """Nats of every candidate in the first round, the strongest on top; findings in blue."""
    named = {finding.effect for finding in found.findings}
    ranked = sorted(drawn.evidence.items(), key=lambda item: -item[1])[:14]
    figure = _figure(0.5 + 0.24 * max(len(ranked), 2))
    axes = figure.axes[0]
    values = [max(nats, 0.1) for _, nats in ranked]
    colors = [AFTER if name in named else GREY for name, _ in ranked]
    axes.barh(range(len(ranked)), values, color=colors)
    axes.set_yticks(range(len(ranked)), [name for name, _ in ranked], fontsize=8)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.axvline(3.0, color=BEFORE, lw=1.0)
    axes.set_xlabel("evidence, nats")
    return figure


def contribution(one: Contribution) -> Figure:
    """What a finding adds to the readings over time."""
    figure = _figure(2.0)
    axes = figure.axes[0]
    for k in range(3):
        series = _binned(one.time_s, one.added[:, k] * 1e3)
        axes.plot(*series, color=SERIES[k], lw=1.0, label=_AXES[k])
    axes.set_xlabel("time, s")
    axes.set_ylabel({"gauss": "mG", "rad/s": "mrad/s"}[one.unit])
    legend_above(figure)
    return figure


def validation(found: Validation) -> Figure:
    """Gain of whole models over the calibration alone on parts that were not fitted."""
    bars = {
        "calibration alone": (0.0, GREY),
        "time-shifted copies": (found.placebo, BEFORE),
        "with the findings": (found.named, AFTER),
        "with a free time series as well": (found.named + found.free, SERIES[1]),
    }
    figure = _figure(1.7)
    axes = figure.axes[0]
    values = [value for value, _ in bars.values()]
    drawn = axes.barh(range(len(bars)), values, color=[color for _, color in bars.values()])
    axes.bar_label(drawn, [f" {value:+.4f}" for value in values], fontsize=8)
    axes.set_yticks(range(len(bars)), list(bars), fontsize=8)
    axes.margins(x=0.2)
    axes.axvline(0.0, color=GREY, lw=0.8)
    axes.invert_yaxis()
    axes.set_xlabel("gain, nats per sample")
    return figure


def regime_map(maps: tuple[RegimeMap, ...]) -> Figure:
    """The residual by condition: a row a quantity, low values left, before and after."""
    rows = maps[:_REGIMES]
    highest = max(max(one.before + one.after) for one in rows)
    colours = LogNorm(1.0, max(highest, 10.0), clip=True)
    figure = _figure(1.2 + 0.72 * len(rows), 2)
    for axes, side in zip(figure.axes, ("before", "after"), strict=True):
        for row, one in enumerate(rows):
            nats = np.array([getattr(one, side)])
            edges = np.linspace(0.0, 1.0, nats.shape[1] + 1)
            drawn = axes.pcolormesh(
                edges, [row - 0.45, row + 0.45], nats, cmap="YlOrRd", norm=colours, edgecolor="w"
            )
        labels = [
            f"{_plain(one.quantity)}\n{one.edges[0]:.3g} to {one.edges[-1]:.3g}" for one in rows
        ]
        axes.set_yticks(range(len(rows)), labels, fontsize=7)
        axes.set_xticks([])
        axes.invert_yaxis()
        axes.set_title(side)
        axes.grid(visible=False)
        figure.colorbar(drawn, ax=axes, label="nats")
    figure.axes[1].set_xlabel("low to high, equally many samples in every bin")
    return figure


def _plain(name: str) -> str:
    """A column's name in a picture: a dollar sign begins no formula."""
    return label(name).replace("$", r"\$")


def courses(drawn: Drawn) -> Figure:
    """What remains with the findings in the model, in the three frames, by segments of time."""
    shown = [one for one in drawn.courses if len(one.course)]
    figure = _figure(0.4 + 1.5 * max(len(shown), 1), max(len(shown), 1))
    for axes, one in zip(figure.axes, shown, strict=False):
        middle = 0.5 * (np.asarray(one.cut.edges_s[1:]) + np.asarray(one.cut.edges_s[:-1]))
        for k in range(3):
            axes.plot(middle, one.course[:, k] * 1e3, color=SERIES[k], lw=1.2, label=_AXES[k])
        axes.fill_between(
            middle, -2e3 * one.deviation, 2e3 * one.deviation, color=GREY, alpha=0.15, lw=0
        )
        unit = "mrad/s" if one.frame == "gyro" else "mG"
        axes.set_title(f"{one.frame} frame, evidence {max(one.evidence, 0.0):.0f} nats")
        axes.set_ylabel(unit)
    figure.axes[-1].set_xlabel("time, s")
    legend_above(figure)
    return figure


def spectrum(drawn: Drawn) -> Figure:
    """Power of the whitened innovations by frequency, all axes: 1 where nothing remains."""
    figure = _figure(2.4)
    axes = figure.axes[0]
    for values, color, name in _both(drawn.before, drawn.after):
        frequency, power = _power(drawn.time_s, values)
        axes.plot(frequency, power, color=color, lw=1.0, label=name)
    axes.axhline(1.0, color=GREY, lw=0.8)
    _log_log(axes)
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("power, 1 = as expected")
    if spectrum_is_worse(drawn):
        axes.set_title("Farther from 1 after than before")
    legend_above(figure)
    return figure


def spectrum_is_worse(drawn: Drawn) -> bool:
    """Whether the innovations with the findings are farther from 1 than those without."""
    if np.array_equal(drawn.before, drawn.after):
        return False
    before, after = (
        float(np.mean(np.abs(np.log(np.maximum(_power(drawn.time_s, values)[1], 1e-12)))))
        for values in (drawn.before, drawn.after)
    )
    return after > _WORSE * before


def stands_out(drawn: Drawn) -> bool:
    """Whether the freely drawn course of any frame leaves its own band of two deviations."""
    return any(
        bool(np.any(np.abs(one.course) > 2.0 * np.reshape(one.deviation, (-1, 1))))
        for one in drawn.courses
        if len(one.course)
    )


def grey_ones_are_longer(found: Diagnosis, drawn: Drawn) -> bool:
    """Whether an effect that is no finding explains more alone than one that is."""
    named = {finding.effect for finding in found.findings}
    blue = [nats for name, nats in drawn.evidence.items() if name in named]
    grey = [nats for name, nats in drawn.evidence.items() if name not in named]
    return bool(blue) and bool(grey) and max(grey) > min(blue)


def _power(time_s: Array, values: Array) -> tuple[Array, Array]:
    """Averaged periodogram on a logarithmic grid of frequencies; 1 for white innovations."""
    step_s = float(np.median(np.diff(time_s)))
    clean = np.nan_to_num(values - np.nanmean(values, axis=0))
    power = np.mean(np.abs(np.fft.rfft(clean, axis=0)) ** 2, axis=1) / len(clean)
    frequency = np.fft.rfftfreq(len(clean), step_s)
    edges = np.geomspace(frequency[1], frequency[-1] * 1.001, 50)
    index = np.searchsorted(edges, frequency[1:], "right") - 1
    count = np.bincount(index, minlength=len(edges))[: len(edges) - 1]
    total = np.bincount(index, weights=power[1:], minlength=len(edges))[: len(edges) - 1]
    kept = count > 0
    return np.sqrt(edges[1:] * edges[:-1])[kept], total[kept] / count[kept]


def _log_log(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")


# -- The page --------------------------------------------------------------------------------------


_MG = 1e3
#: the title of each picture, and its caption
_OVER_TIME = (
    "innovations over time, before and after",
    "Readings minus the filter's prediction, without (orange) and with (blue) the effects above; "
    "the intervals of the findings are shaded.",
)
_BY_FREQUENCY = (
    "spectrum of the innovations",
    "The same by frequency: 1 everywhere if nothing remains.",
)
_BY_NAME = (
    "evidence of every effect",
    "How much every effect alone would explain; findings in blue. The line is the evidence that a "
    "finding needs.",
)
#: added below what is drawn before and after if a residual remains
_WITH_RESIDUAL = (
    'What remains without a name is in the model "after" as a free time series; the repaired model '
    "in model.json does not have it."
)
#: added below the spectrum where the blue curve is the worse one
_WORSE_SPECTRUM = (
    "Here it is farther from 1 after than before: the findings explain the readings in their "
    "intervals, not the distribution of the innovations over frequency."
)
#: added below the bars where an effect that is no finding has the longer bar
_LOST = (
    "A longer grey bar is no contradiction: each bar is of one effect without any other. What a "
    "grey effect explains, the findings explain as well. Next to them it adds less than a finding "
    "needs, or it fails on parts of the recording that were not fitted."
)
#: the statistics of the checks, in words
_STATISTICS = {
    "normalised_innovation": "mean square of the innovations (1: as the noise level predicts)",
    "autocorrelation": "autocorrelation of the innovations",
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
    "residual by condition",
    "Under which conditions readings and model differ, without and with the effects above. Each "
    "row is one quantity, from low values (left) to high ones (right). Dark is much; noise alone "
    "gives 1 to 3.",
)
_NOT_FITTED = (
    "gain on parts that were not fitted",
    "What the models gain over the calibration alone on parts of the recording that they were not "
    "fitted to. Time-shifted copies are the same effects at times where they cannot be.",
)
_BY_FRAME = (
    "residual by frame",
    "What remains with the findings in the model, as a free time series in three frames; grey: "
    "two standard deviations.",
)


def write_diagnosis_report(path: Path, found: Diagnosis, command: str) -> None:
    """Write the page.  OSError where it cannot be written."""
    ordinary = ordinary_residual(found)
    page = render(
        "diagnosis.html",
        title=f"Diagnosis of {found.recording}",
        found=found,
        verdict=verdict(found),
        agrees=agrees(found),
        findings=[_finding(found, one) for one in found.findings],
        unexplained=_unexplained(found),
        ordinary=None if ordinary is None else ordinary_text(ordinary),
        how_real=_how_real(found),
        pictures=_pictures(found),
        sensitivity=sensitivity_text(found.sensitivity),
        limits=_limits(found),
        checks=[
            (_STATISTICS.get(name, name.replace("_", " ")), check)
            for name, check in found.posterior_predictive.items()
        ],
        with_residual=_WITH_RESIDUAL if residual_is_drawn(found) else "",
        baseline=_baseline(found),
        command=command,
    )
    path.write_text(page, encoding="utf-8")


def _finding(found: Diagnosis, one: Finding) -> dict[str, object]:
    held, cost = one.heldout, one.cost_if_left_out
    rows = [("setting", read)] if (read := setting_text(one.setting)) else []
    if cost is not None:
        off = (
            f"hard iron off by {number(cost.hard_iron_shift_gauss * _MG, 'mG')}, heading by "
            f"{number(cost.heading_error_deg, 'deg')}"
        )
        rows.append(("cost if left out", off))
    if held is not None:
        gain = (
            f"{held.nll_gain_per_sample:+.4f} nats per sample; time-shifted copies of the effect "
            f"gain at most {held.placebo_gain:+.4f}"
        )
        rows.append(("on data not fitted", gain))
    if one.priors is not None:
        rows.append(("evidence", evidence_text(one.priors)))
    if one.alternatives:
        rest = ", ".join(f"{a.effect} ({a.confidence:.1%})" for a in one.alternatives)
        rows.append(("or else", rest))
    if one.separate_from:
        rows.append(("to be sure", one.separate_from))
    return {
        "headline": headline(one),
        "where": where_text(one.where),
        "sizes": [value_text(value) for value in one.parameters],
        "equation": one.equation,
        "rows": rows,
        "picture": _contribution(found, one),
    }


def _contribution(found: Diagnosis, one: Finding) -> Picture | None:
    if found.drawn is None or one.term is None:
        return None

    added = found.drawn.contributions[one.term]
    draw = partial(contribution, added)
    return picture(draw, f"{one.effect} over time", "What it adds to the readings.")


def _unexplained(found: Diagnosis) -> list[tuple[str, str]]:
    left = found.unexplained
    if not (left.detected or left.ordinary):
        return []
    rows = [] if left.where is None else [("where", where_text(left.where))]
    if left.where is not None and left.where.direction is not None:
        rows.append(("along", direction_text(left.where.direction)))
    if left.size is not None:
        rows.append(("size", size_text(left.size, left.unit)))
    if left.ordinary is not None:
        rows += [("component", text) for text in component_lines(left.ordinary)]
        rows += [("why", left.ordinary.why)] if left.ordinary.why else []
    if left.single_source_share is not None:
        rows.append(("one source", f"{left.single_source_share:.0%} of it has one direction"))
    rows += [
        (
            "follows",
            f"{label(s.channel)}, correlation {s.correlation:+.2f}, p = {s.p_value:.1g}",
        )
        for s in left.follows
    ]
    if left.priors is not None:
        rows.append(("evidence", evidence_text(left.priors)))
    if left.heldout is not None:
        gain = f"{left.heldout.nll_gain_per_sample:+.4f} nats per sample"
        rows.append(("on data not fitted", f"{gain} with a free time series in its place"))
    return rows


def _how_real(found: Diagnosis) -> str:
    """Only what the pictures below show."""

    if found.drawn is not None and found.drawn.courses and not stands_out(found.drawn):
        return (
            "As a whole it is more than chance, but at no moment does it exceed its own "
            "uncertainty band: it exists, but its time series is not known."
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

    worse, remains = spectrum_is_worse(drawn), residual_is_drawn(found)
    shots = [
        (partial(residual, found, drawn), *_longer(_OVER_TIME, remains, _WITH_RESIDUAL)),
        (partial(spectrum, drawn), *_longer(_BY_FREQUENCY, worse, _WORSE_SPECTRUM)),
    ]
    if drawn.evidence:
        longer = grey_ones_are_longer(found, drawn)
        shots.append((partial(evidence, found, drawn), *_longer(_BY_NAME, longer, _LOST)))
    if found.regime_map:
        shots.append(
            (
                partial(regime_map, found.regime_map),
                *_longer(_BY_CONDITION, remains, _WITH_RESIDUAL),
            )
        )
    if found.validation is not None and found.findings:
        shots.append((partial(validation, found.validation), *_NOT_FITTED))
    if drawn.courses:
        shots.append((partial(courses, drawn), *_BY_FRAME))
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
