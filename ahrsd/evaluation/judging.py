"""All figures of a calibration on a recording, before and after, with warnings; as JSON and as
lines of text.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, Literal, TypeVar

import numpy as np

from ahrsd.baselines.data import field_spread
from ahrsd.calibration_json import StoredCalibration
from ahrsd.evaluation.heading import (
    FOLDS,
    Fixes,
    HeadingFigures,
    HeadingReference,
    ReckoningFigures,
    distance_travelled,
    fixes_within,
    heading_figures,
    reckoning_figures,
    rms_difference,
    turning_fault,
    velocity_of,
)
from ahrsd.evaluation.track import EvaluationError, EvaluationTrack, Tilt, up_directions
from ahrsd.printable import counted
from ahrsd.samples import Array
from ahrsd.world_field import WorldField

# -- Size of the field -----------------------------------------------------------------------------
#
# Norm of the corrected field: its spread, and the error of the norm constraint.
#
# Spread is [R] 4.4, std |h| / mean |h|. The constraint of [L] is |h_k| = |H_k|. If the world's
# field is not known, the mean of |h| replaces |H|, and the error is relative to that.


# -- Figures ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class FieldFigures:
    """Of one calibration. constraint_*: of |h| - |H|, where |H| is the mean of |h| unless given."""

    mean_gauss: float
    spread: float
    fold_spread: tuple[float, ...]
    constraint_rms_gauss: float
    constraint_worst_gauss: float
    size_gauss: Array


def field_figures(field_b: Array, world_gauss: float | None) -> FieldFigures:
    """Figures of corrected fields (N, 3) in gauss."""
    size = np.linalg.norm(field_b, axis=1)
    error = size - (float(np.mean(size)) if world_gauss is None else world_gauss)
    return FieldFigures(
        mean_gauss=float(np.mean(size)),
        spread=field_spread(field_b),
        fold_spread=tuple(field_spread(part) for part in np.array_split(field_b, FOLDS)),
        constraint_rms_gauss=float(np.sqrt(np.mean(error**2))),
        constraint_worst_gauss=float(np.max(np.abs(error))),
        size_gauss=size,
    )


# -- All figures, before and after -----------------------------------------------------------------

_LONG_GAP_S = 1.0
T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Pair(Generic[T]):
    """The same figures with the device's present values and with the calibration."""

    before: T
    after: T


@dataclass(frozen=True, slots=True, eq=False)
class HeadingJudged:
    """Heading errors against one reference."""

    reference: str
    detail: str
    truth: bool
    tilt: str
    figures: Pair[HeadingFigures]


@dataclass(frozen=True, slots=True, eq=False)
class Reckoned:
    """Dead reckoning against a position reference."""

    velocity: str
    reference: str
    distance_m: float
    fixes: Fixes
    figures: Pair[ReckoningFigures]


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The figures of a calibration on a recording."""

    recording: str
    calibration: StoredCalibration
    track: EvaluationTrack
    field: Pair[FieldFigures]
    headings: tuple[HeadingJudged, ...]
    reckoned: Reckoned | None
    world: WorldField | None
    warnings: tuple[str, ...]

    @property
    def held_out(self) -> bool:
        """Whether the calibration was made from another recording, by its name."""
        return _recording_stem(self.recording) != _recording_stem(self.calibration.recording)

    @property
    def better(self) -> bool:
        """Whether it is no worse than the device's present values, by the best criterion available.

        That is the first heading reference that is true, otherwise the spread of the field.
        """
        for judged in self.headings:
            if judged.truth:
                return judged.figures.after.rms_deg <= judged.figures.before.rms_deg
        return self.field.after.spread <= self.field.before.spread


def judge(
    recording: str,
    track: EvaluationTrack,
    calibration: StoredCalibration,
    references: Sequence[HeadingReference],
    *,
    fixes: Fixes | None = None,
    world: WorldField | None = None,
    tilt_source: Tilt = "auto",
) -> Evaluation:
    """Evaluate `calibration` on a recording.

    references: in order of reliability; one that the recording hardly overlaps gives a warning.
    Raises EvaluationError if the recording does not have the requested tilt.
    """
    warnings: list[str] = list(calibration.remarks)
    after_b = calibration.correction.apply(track.raw_b_gauss)
    fields = Pair(track.before_b_gauss, after_b)
    total = None if world is None else world.total_gauss
    field = _before_and_after(fields, lambda b: field_figures(b, total))
    up_b, up_source = _choose_up(track, tilt_source, references, warnings)
    declination = 0.0 if world is None else world.declination_rad
    headings = []
    for reference in references:
        up = up_b if reference.up_b is None else reference.up_b
        if up is None:
            continue
        if (fault := turning_fault(track, reference, up)) is not None:
            warnings.append(f"{reference.name} {fault}; it is left out")
            continue
        compare_with_reference = partial(
            heading_figures, track.time_s, up_b=up, reference=reference
        )
        try:
            figures = _before_and_after(
                fields, partial(compare_with_reference, declination_rad=declination)
            )
        except EvaluationError as error:
            warnings.append(str(error))
            continue
        source = up_source if reference.up_b is None else "reference"
        headings.append(
            HeadingJudged(reference.name, reference.detail, reference.truth, source, figures)
        )
    reckoned = None
    if fixes is not None and up_b is not None:
        reckoned = _dead_reckoning(track, fields, up_b, fixes, warnings)
    found = Evaluation(
        recording, calibration, track, field, tuple(headings), reckoned, world, tuple(warnings)
    )
    return _with_caveats(found)


def _before_and_after(fields: Pair[Array], figures: Callable[[Array], T]) -> Pair[T]:
    return Pair(figures(fields.before), figures(fields.after))


def _choose_up(
    track: EvaluationTrack,
    source: Tilt,
    references: Sequence[HeadingReference],
    warnings: list[str],
) -> tuple[Array | None, str]:
    try:
        up_b, found = up_directions(track, source)
    except EvaluationError as error:
        if source != "auto":
            raise
        if any(reference.up_b is None for reference in references) or not references:
            warnings.append(f"no heading of its own: {error}")
        return None, ""
    if found == "device" and source == "auto":
        warnings.append("no acceleration in the recording: roll and pitch are the device's own")
    return up_b, found


def _dead_reckoning(
    track: EvaluationTrack, fields: Pair[Array], up_b: Array, fixes: Fixes, warnings: list[str]
) -> Reckoned | None:
    inside = fixes_within(track, fixes)
    if inside is None:
        warnings.append(f"{fixes.source}: too few fixes within the recording for dead reckoning")
        return None
    velocity = velocity_of(track, fixes)
    way_m = distance_travelled(track, velocity, inside)
    if way_m is None:
        warnings.append("the distance travelled is too short: no dead reckoning")
        return None
    gaps = track.time_s[list(track.starts[1:])] - track.time_s[[k - 1 for k in track.starts[1:]]]
    if np.any(gaps > _LONG_GAP_S):
        warnings.append(
            f"straight lines in the dead reckoning: "
            f"{counted(int(np.count_nonzero(gaps > _LONG_GAP_S)), 'gap')} of more than "
            f"{_LONG_GAP_S:g} s"
        )
    figures = _before_and_after(
        fields, lambda b: reckoning_figures(track, b, up_b, velocity, inside, way_m)
    )
    return Reckoned(velocity.source, fixes.source, way_m, inside, figures)


def _with_caveats(found: Evaluation) -> Evaluation:
    warnings = list(found.warnings)
    if not found.held_out:
        warnings.append(
            f"by its name the calibration was made from this very recording ({found.recording}): "
            "its figures are not held out and flatter it"
        )
    if found.world is None:
        warnings.append(
            "position and date are not both known (--position, --date): |H| is the mean of the "
            "corrected field, and the declination is part of the constant that is removed"
        )
    if not found.headings:
        warnings.append("there is no heading to compare with: only the field is judged")
    elif not any(judged.truth for judged in found.headings):
        warnings.append("the only heading to compare with is the device's own, which is no truth")
    return replace(found, warnings=tuple(dict.fromkeys(warnings)))


def _recording_stem(name: str) -> str:
    """The name of a recording without the suffixes of its storage."""
    return name.split(".", 1)[0]


# -- As JSON and as lines --------------------------------------------------------------------------


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
            _two_columns("RMS error [deg]", before.rms_deg, after.rms_deg),
            _two_columns("worst error [deg]", before.worst_deg, after.worst_deg),
            _two_columns("RMS per fifth of the time: least [deg]", *_ends(before, after, min)),
            _two_columns("RMS per fifth of the time: most [deg]", *_ends(before, after, max)),
            _two_columns("constant removed [deg]", before.offset_deg, after.offset_deg),
        ]
    about = "its own mean" if found.world is None else f"{found.world.model}"
    one, other = found.field.before, found.field.after
    lines += [
        "field, held out" if found.held_out else "field",
        _two_columns("spread, std over mean [%]", 100 * one.spread, 100 * other.spread),
        _two_columns("mean [mG]", 1e3 * one.mean_gauss, 1e3 * other.mean_gauss),
        _two_columns(
            f"constraint error about {about}, RMS [mG]",
            1e3 * one.constraint_rms_gauss,
            1e3 * other.constraint_rms_gauss,
        ),
        _two_columns(
            "constraint error, worst [mG]",
            1e3 * one.constraint_worst_gauss,
            1e3 * other.constraint_worst_gauss,
        ),
    ]
    if found.reckoned is not None:
        lines += _reckoned_lines(found.reckoned)
    return lines + [f"  warning: {text}" for text in found.warnings]


def comparison_lines(found: Sequence[Evaluation], without: Mapping[str, str]) -> list[str]:
    """One row per calibration, least heading error first; without: reason by method without an
    answer.
    """
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
        _row("(before)", *_comparison_figures(first, "before")),
    ]
    by_heading = sorted(found, key=lambda one: _comparison_figures(one, "after")[0])
    for one in by_heading if first.headings else found:
        row = _row(one.calibration.method, *_comparison_figures(one, "after"))
        apart = _rms_interval(one, first)
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
            one.calibration.method: _rms_interval(one, found[0]) for one in found[1:]
        },
        "without": dict(without),
    }


def _rms_interval(one: Evaluation, first: Evaluation) -> tuple[float, float] | None:
    """95 % interval of its heading RMS less that of the first, deg."""
    if one is first or not first.headings:
        return None
    return rms_difference(one.headings[0].figures.after, first.headings[0].figures.after)


def _comparison_figures(found: Evaluation, which: Literal["before", "after"]) -> tuple[float, ...]:
    """Heading RMS and worst (deg), dead reckoning (%), spread (%); NaN if there is none."""
    nan = float("nan")
    heading = getattr(found.headings[0].figures, which) if found.headings else None
    dead_reckoning = None if found.reckoned is None else getattr(found.reckoned.figures, which)
    return (
        nan if heading is None else heading.rms_deg,
        nan if heading is None else heading.worst_deg,
        nan if dead_reckoning is None else dead_reckoning.rms_percent,
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
        _two_columns("XY error, RMS [% of distance]", before.rms_percent, after.rms_percent),
        _two_columns(
            "XY error at the end [% of distance]", before.final_percent, after.final_percent
        ),
        _two_columns("XY error, worst [m]", before.worst_m, after.worst_m),
    ]


def _ends(
    before: HeadingFigures, after: HeadingFigures, which: Callable[[tuple[float, ...]], float]
) -> tuple[float, float]:
    return which(before.fold_rms_deg), which(after.fold_rms_deg)


def _two_columns(label: str, before: float, after: float) -> str:
    return f"  {label:42}{before:10.2f}{after:10.2f}"
