"""All figures of a calibration on a recording, before and after, and what may not be believed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from ahrsd.baselines.data import field_spread
from ahrsd.counting import counted
from ahrsd.evaluation import dead_reckoning
from ahrsd.evaluation.dead_reckoning import ReckoningFigures
from ahrsd.evaluation.heading import FOLDS, HeadingFigures, compare
from ahrsd.evaluation.references import Fixes, HeadingReference
from ahrsd.evaluation.stored import StoredCalibration
from ahrsd.evaluation.track import EvaluationError, EvaluationTrack, Tilt, up_directions
from ahrsd.samples import Array
from ahrsd.world_field import WorldField

# -- Size of the field -----------------------------------------------------------------------------
#
# Size of the corrected field: its spread, and the error of the norm constraint.
#
# Spread is [R] 4.4, std |h| / mean |h|. [L]'s constraint is |h_k| = |H_k|; where the world's field
# is not known the mean of |h| stands for |H|, and the error is then about that.


@dataclass(frozen=True, slots=True, eq=False)
class FieldFigures:
    """Of one calibration. constraint_*: of |h| - |H|, |H| the mean of |h| unless it was given."""

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
    """What a calibration is worth on a recording."""

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
        return _stem(self.recording) != _stem(self.calibration.recording)

    @property
    def better(self) -> bool:
        """Whether it is no worse than the device's present values, by the best witness there is.

        That is the first heading reference that is true, else the spread of the field.
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
    """Judge `calibration` on a recording.

    references: in order of belief; one that the recording hardly overlaps ends in a warning.
    Raises EvaluationError where a tilt was asked for that the recording does not have.
    """
    said: list[str] = list(calibration.remarks)
    after_b = calibration.correction.apply(track.raw_b_gauss)
    fields = Pair(track.before_b_gauss, after_b)
    total = None if world is None else world.total_gauss
    field = _both(fields, lambda b: field_figures(b, total))
    up_b, up_source = _up(track, tilt_source, references, said)
    declination = 0.0 if world is None else world.declination_rad
    headings = []
    for reference in references:
        up = up_b if reference.up_b is None else reference.up_b
        if up is None:
            continue
        look = partial(compare, track.time_s, up_b=up, reference=reference)
        try:
            figures = _both(fields, partial(look, declination_rad=declination))
        except EvaluationError as error:
            said.append(str(error))
            continue
        source = up_source if reference.up_b is None else "reference"
        headings.append(
            HeadingJudged(reference.name, reference.detail, reference.truth, source, figures)
        )
    reckoned = None
    if fixes is not None and up_b is not None:
        reckoned = _reckoned(track, fields, up_b, fixes, said)
    found = Evaluation(
        recording, calibration, track, field, tuple(headings), reckoned, world, tuple(said)
    )
    return _with_caveats(found)


def _both(fields: Pair[Array], figures: Callable[[Array], T]) -> Pair[T]:
    return Pair(figures(fields.before), figures(fields.after))


def _up(
    track: EvaluationTrack,
    source: Tilt,
    references: Sequence[HeadingReference],
    said: list[str],
) -> tuple[Array | None, str]:
    try:
        up_b, found = up_directions(track, source)
    except EvaluationError as error:
        if source != "auto":
            raise
        if any(reference.up_b is None for reference in references) or not references:
            said.append(f"no heading of its own: {error}")
        return None, ""
    if found == "device" and source == "auto":
        said.append("no acceleration in the recording: roll and pitch are the device's own")
    return up_b, found


def _reckoned(
    track: EvaluationTrack, fields: Pair[Array], up_b: Array, fixes: Fixes, said: list[str]
) -> Reckoned | None:
    inside = dead_reckoning.within(track, fixes)
    if inside is None:
        said.append(f"{fixes.source}: too few fixes within the recording for dead reckoning")
        return None
    velocity = dead_reckoning.velocity_of(track, fixes)
    way_m = dead_reckoning.distance_m(track, velocity, inside)
    if way_m is None:
        said.append("hardly any way was travelled: no dead reckoning")
        return None
    gaps = track.time_s[list(track.starts[1:])] - track.time_s[[k - 1 for k in track.starts[1:]]]
    if np.any(gaps > _LONG_GAP_S):
        said.append(
            f"in the dead reckoning, as straight lines: "
            f"{counted(int(np.count_nonzero(gaps > _LONG_GAP_S)), 'gap')} of more than "
            f"{_LONG_GAP_S:g} s"
        )
    figures = _both(
        fields, lambda b: dead_reckoning.reckon(track, b, up_b, velocity, inside, way_m)
    )
    return Reckoned(velocity.source, fixes.source, way_m, inside, figures)


def _with_caveats(found: Evaluation) -> Evaluation:
    said = list(found.warnings)
    if not found.held_out:
        said.append(
            f"by its name the calibration was made from this very recording ({found.recording}): "
            "its figures are not held out and flatter it"
        )
    if found.world is None:
        said.append(
            "position and date are not both known (--position, --date): |H| is the mean of the "
            "corrected field, and the declination is part of the constant that is removed"
        )
    if not found.headings:
        said.append("there is no heading to compare with: only the field is judged")
    elif not any(judged.truth for judged in found.headings):
        said.append("the only heading to compare with is the device's own, which is no truth")
    return replace(found, warnings=tuple(dict.fromkeys(said)))


def _stem(name: str) -> str:
    """A recording's name without what says how it is stored."""
    return name.split(".", 1)[0]
