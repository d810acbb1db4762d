"""An evaluation as JSON and as lines for a person."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

from ahrsd.counting import counted
from ahrsd.evaluation.dead_reckoning import ReckoningFigures
from ahrsd.evaluation.heading import HeadingFigures, rms_difference
from ahrsd.evaluation.judging import Evaluation, FieldFigures, HeadingJudged, Reckoned

SCHEMA = "ahrsd.evaluation/1"
SCHEMA_OF_MANY = "ahrsd.evaluations/1"


def evaluation_json(found: Evaluation) -> dict[str, object]:
    """`ahrsd.evaluation/1`, see docs/guide/evaluate.md."""
    calibration, world, track = found.calibration, found.world, found.track
    return {
        "schema": SCHEMA,
        "recording": found.recording,
        "samples": len(track),
        "duration_s": float(track.time_s[-1] - track.time_s[0]),
        "calibration": {
            "file": calibration.source,
            "method": calibration.method,
            "recording": calibration.recording,
            "converged": calibration.converged,
        },
        "held_out": found.held_out,
        "better": found.better,
        "field": {
            "before": _field_json(found.field.before),
            "after": _field_json(found.field.after),
        },
        "heading": [_heading_json(judged) for judged in found.headings],
        "dead_reckoning": None if found.reckoned is None else _reckoned_json(found.reckoned),
        "world_field": None
        if world is None
        else {
            "model": world.model,
            "total_gauss": world.total_gauss,
            "declination_rad": world.declination_rad,
            "inclination_rad": world.inclination_rad,
            "valid_until": world.valid_until,
        },
        "warnings": list(found.warnings),
    }


def _field_json(figures: FieldFigures) -> dict[str, object]:
    return {
        "mean_gauss": figures.mean_gauss,
        "spread": figures.spread,
        "fold_spread": list(figures.fold_spread),
        "constraint_rms_gauss": figures.constraint_rms_gauss,
        "constraint_worst_gauss": figures.constraint_worst_gauss,
    }


def _heading_json(judged: HeadingJudged) -> dict[str, object]:
    def one(figures: HeadingFigures) -> dict[str, object]:
        return {
            "rms_deg": figures.rms_deg,
            "worst_deg": figures.worst_deg,
            "offset_deg": figures.offset_deg,
            "fold_rms_deg": list(figures.fold_rms_deg),
            "fold_spread_deg": figures.fold_spread_deg,
        }

    return {
        "reference": judged.reference,
        "detail": judged.detail,
        "truth": judged.truth,
        "tilt": judged.tilt,
        "instants": len(judged.figures.after.error_deg),
        "before": one(judged.figures.before),
        "after": one(judged.figures.after),
    }


def _reckoned_json(reckoned: Reckoned) -> dict[str, object]:
    def one(figures: ReckoningFigures) -> dict[str, object]:
        return {
            "rms_percent": figures.rms_percent,
            "final_percent": figures.final_percent,
            "worst_m": figures.worst_m,
            "offset_deg": figures.offset_deg,
        }

    return {
        "velocity": reckoned.velocity,
        "reference": reckoned.reference,
        "distance_m": reckoned.distance_m,
        "before": one(reckoned.figures.before),
        "after": one(reckoned.figures.after),
    }


def evaluation_lines(found: Evaluation) -> list[str]:
    """The same as a table."""
    calibration, track = found.calibration, found.track
    duration_s = track.time_s[-1] - track.time_s[0]
    lines = [
        f"{found.recording}: {counted(len(track), 'sample')}, {duration_s:.0f} s; calibration "
        f"{calibration.method} of {calibration.recording or calibration.source}",
        f"{'':44}{'before':>10}{'after':>10}",
    ]
    for judged in found.headings:
        before, after = judged.figures.before, judged.figures.after
        lines += [
            f"heading against {judged.reference}: {len(after.error_deg)} instants; "
            + "; ".join(text for text in (judged.detail, f"tilt: {judged.tilt}") if text),
            _line("RMS error [deg]", before.rms_deg, after.rms_deg),
            _line("worst error [deg]", before.worst_deg, after.worst_deg),
            _line("RMS per fifth of the time: least [deg]", *_ends(before, after, min)),
            _line("RMS per fifth of the time: most [deg]", *_ends(before, after, max)),
            _line("constant removed [deg]", before.offset_deg, after.offset_deg),
        ]
    about = "its own mean" if found.world is None else f"{found.world.model}"
    one, other = found.field.before, found.field.after
    lines += [
        "field, held out" if found.held_out else "field",
        _line("spread, std over mean [%]", 100 * one.spread, 100 * other.spread),
        _line("mean [mG]", 1e3 * one.mean_gauss, 1e3 * other.mean_gauss),
        _line(
            f"constraint error about {about}, RMS [mG]",
            1e3 * one.constraint_rms_gauss,
            1e3 * other.constraint_rms_gauss,
        ),
        _line(
            "constraint error, worst [mG]",
            1e3 * one.constraint_worst_gauss,
            1e3 * other.constraint_worst_gauss,
        ),
    ]
    if found.reckoned is not None:
        lines += _reckoned_lines(found.reckoned)
    return lines + [f"  warning: {text}" for text in found.warnings]


def comparison_lines(found: Sequence[Evaluation], without: Mapping[str, str]) -> list[str]:
    """One row per calibration, least heading error first; without: method to why it has none."""
    first = found[0]
    duration_s = first.track.time_s[-1] - first.track.time_s[0]
    lines = [f"{first.recording}: {counted(len(first.track), 'sample')}, {duration_s:.0f} s"]
    if first.headings:
        against = first.headings[0]
        lines.append(
            f"heading against {against.reference}, RMS, one constant removed; tilt: {against.tilt}"
        )
    if first.reckoned is not None:
        lines.append(f"dead reckoning by {first.reckoned.velocity}, XY error RMS over distance")
    lines += [
        f"{'method':20}{'heading [deg]':>14}{'worst [deg]':>13}{'XY error [%]':>14}"
        f"{'spread [%]':>12}  heading RMS less that of {first.calibration.method}, 95 %",
        _row("(before)", *_figures(first, "before")),
    ]
    by_heading = sorted(found, key=lambda one: _figures(one, "after")[0])
    for one in by_heading if first.headings else found:
        row = _row(one.calibration.method, *_figures(one, "after"))
        apart = _apart(one, first)
        between = "" if apart is None else f"  {apart[0]:+.2f} to {apart[1]:+.2f}"
        lines.append(row + between + ("" if one.calibration.converged else "  not converged"))
    lines += [f"{name:20}no answer: {why}" for name, why in without.items()]
    common = set.intersection(*(set(one.warnings) for one in found))
    return lines + [f"  warning: {text}" for text in first.warnings if text in common]


def comparison_json(found: Sequence[Evaluation], without: Mapping[str, str]) -> dict[str, object]:
    """The evaluations of several calibrations on one recording."""
    return {
        "schema": SCHEMA_OF_MANY,
        "recording": found[0].recording,
        "evaluations": [evaluation_json(one) for one in found],
        "heading_rms_difference_deg": {
            one.calibration.method: _apart(one, found[0]) for one in found[1:]
        },
        "without": dict(without),
    }


def _apart(one: Evaluation, first: Evaluation) -> tuple[float, float] | None:
    """95 % interval of how much larger its heading RMS is than that of the first, deg."""
    if one is first or not first.headings:
        return None
    return rms_difference(one.headings[0].figures.after, first.headings[0].figures.after)


def _figures(found: Evaluation, which: Literal["before", "after"]) -> tuple[float, ...]:
    """Heading RMS and worst (deg), dead reckoning (%), spread (%); NaN where there is none."""
    nan = float("nan")
    heading = getattr(found.headings[0].figures, which) if found.headings else None
    reckoned = None if found.reckoned is None else getattr(found.reckoned.figures, which)
    return (
        nan if heading is None else heading.rms_deg,
        nan if heading is None else heading.worst_deg,
        nan if reckoned is None else reckoned.rms_percent,
        100 * getattr(found.field, which).spread,
    )


def _row(name: str, heading: float, worst: float, reckoned: float, spread: float) -> str:
    return f"{name:20}{heading:14.2f}{worst:13.2f}{reckoned:14.2f}{spread:12.2f}".replace(
        "nan", "  -"
    )


def _reckoned_lines(reckoned: Reckoned) -> list[str]:
    before, after = reckoned.figures.before, reckoned.figures.after
    return [
        f"dead reckoning by {reckoned.velocity} over {reckoned.distance_m:.0f} m, "
        f"against {reckoned.reference}",
        _line("XY error, RMS [% of distance]", before.rms_percent, after.rms_percent),
        _line("XY error at the end [% of distance]", before.final_percent, after.final_percent),
        _line("XY error, worst [m]", before.worst_m, after.worst_m),
    ]


def _ends(
    before: HeadingFigures, after: HeadingFigures, which: Callable[[tuple[float, ...]], float]
) -> tuple[float, float]:
    return which(before.fold_rms_deg), which(after.fold_rms_deg)


def _line(label: str, before: float, after: float) -> str:
    return f"  {label:42}{before:10.2f}{after:10.2f}"
