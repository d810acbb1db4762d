"""A recording as it is diagnosed: columns in their roles, one clock, and the facts counted in it.

Before any physics, `find_facts` finds what is wrong with the recording itself, by counting and
comparing only, without a calibration: repeated and doubled readings, limits, coarse steps, the
clock, units, and whether gyro and magnetometer use the same axes.  `correct_track` gives the track
without these faults.  A fact that makes a fit impossible is the whole answer.

Columns with gaps are used first (`diagnose_with_gaps`); that diagnosis counts only if one of its
effects depends on such a column.  Otherwise the recording is diagnosed without them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import unusable_reason
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.data_quality.axes_and_units import (
    axis_and_unit_errors,
    rank_frames,
    window_equations,
)
from ahrsd.diagnosis.data_quality.facts import (
    Fact,
    as_finding,
    is_finding,
    rounding,
    stopped_diagnosis,
)
from ahrsd.diagnosis.data_quality.range_and_resolution import find_clipping, find_quantisation
from ahrsd.diagnosis.data_quality.stuck import (
    dead_sensor_reason,
    find_repeated_readings,
    find_stuck_axes,
    find_stuck_gyro,
)
from ahrsd.diagnosis.data_quality.timestamps import (
    find_clock_faults,
    regular_stamps,
    without_clock_jumps,
)
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.track import NothingToFit, Spec, Track

#: diagnoses a track, given what is known of the sensor
Diagnose = Callable[[Track, Spec | None], Diagnosis]


@dataclass(frozen=True, slots=True, eq=False)
class PreparedRecording:
    """A recording before any fit.

    track: as it was recorded, without the jumps of its clock;  facts: found by counting
    notes: what a person should know about how it was read
    """

    track: Track
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]

    def stopped_diagnosis(self, recording: str, library: Mapping[str, Effect]) -> Diagnosis | None:
        """The diagnosis if a fact makes any fit meaningless; otherwise None."""
        stops = [fact for fact in self.facts if fact.stops]
        return stopped_diagnosis(recording, stops, library, self.notes) if stops else None

    def with_facts(self, more: Sequence[Fact]) -> PreparedRecording:
        """The same with facts that were found later: lost turns."""
        return replace(self, facts=(*self.facts, *more))

    def corrected_track(self) -> Track:
        """The track without the faults that its facts describe."""
        return correct_track(self.track, self.facts)

    def findings(self, library: Mapping[str, Effect]) -> tuple[Finding, ...]:
        """The facts that are findings."""
        return tuple(as_finding(fact, library) for fact in self.facts if is_finding(fact))

    @property
    def rounding(self) -> tuple[Term, ...]:
        """The quantisation steps of the readings as a term of the model, where they are coarse."""
        return rounding(self.facts)

    @property
    def minor_notes(self) -> tuple[str, ...]:
        """The other facts, which deserve a note only."""
        return tuple(fact.words for fact in self.facts if not is_finding(fact))


def prepare(track: Track) -> PreparedRecording:
    """A recording ready for a fit.  NothingToFit, with one line, if no fit is possible."""
    track, notes = roles.prepare_columns(track)
    track, jumped = without_clock_jumps(track)
    if why := unusable_reason(track) or dead_sensor_reason(track):
        raise NothingToFit(why)
    return PreparedRecording(track, find_facts(track), (*jumped, *notes))


def find_facts(track: Track) -> tuple[Fact, ...]:
    """All facts of a track, those that stop a fit first."""
    axis_errors = axis_and_unit_errors(track)
    limits = find_clipping(track)
    clipped = next((fact.bad for fact in limits if fact.bad is not None), None)
    repeated = find_repeated_readings(track, clipped) + find_stuck_gyro(track)
    known = [fact.bad for fact in repeated + limits if fact.bad is not None]
    repeated += find_stuck_axes(track, np.any([np.zeros(len(track), bool), *known], axis=0))
    others = repeated + limits + find_quantisation(track) + find_clock_faults(track)
    return tuple(sorted(axis_errors + others, key=lambda fact: not fact.stops))


def correct_track(track: Track, facts: Sequence[Fact]) -> Track:
    """The track without the faults: frames and units corrected, invalid readings nan.

    Jittering stamps are replaced by their regular clock, and the turn of lost samples is restored.
    Where that turn is unknown, a run ends.  The number and order of rows do not change.
    """
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    time_s, dt_s, unseen = track.time_s, track.dt_s, track.lost_turns
    for fact in facts:
        if fact.effect == "frame_error":
            gyro = gyro[:, fact.setting["axes"]] * np.array(fact.setting["signs"])
        elif fact.effect == "unit_error":
            factor = 1.0 / (1.0 + fact.parameters[0].value)
            if fact.setting["sensor"] == "gyro":
                gyro = gyro * factor
            else:
                mag = mag * factor
        elif fact.effect == "timestamp_jitter" and not fact.stops:
            time_s = regular_stamps(track)
            dt_s = np.where(np.isnan(dt_s), np.nan, np.diff(time_s, prepend=np.nan))
        if fact.turned is not None:
            known = np.isfinite(fact.turned)
            gyro[known] *= fact.turned[known, None]
            dt_s = np.where(known, dt_s, np.nan)
            unseen = fact.unseen if fact.unseen is not None else unseen
        if fact.bad is not None:
            mag[fact.bad] = np.nan
    runs = track.runs if dt_s is track.dt_s else tuple(time_series.gap_free_runs(dt_s))
    return replace(
        track,
        time_s=time_s,
        dt_s=dt_s,
        mag_b_gauss=mag,
        gyro_b_rad_s=gyro,
        runs=runs,
        lost_turns=unseen,
    )


def detectable_faults(track: Track) -> tuple[str, ...]:
    """The smallest faults that the checks would have found in this recording, one line each."""
    mag, gyro = noise_of_differences(track)
    step = track.step_s
    equations = window_equations(track)
    faults = [
        "a magnetometer stuck while the field turns by "
        f"{1e3 * priors.STUCK_TURNED_NOISE * mag:.2g} mG",
        f"readings in steps above {1e3 * priors.COARSE_STEPS * mag:.2g} mG "
        f"(noise {1e3 * mag:.2g} mG, {1e3 * gyro:.2g} mrad/s)",
        f"time stamps that jitter by {1e3 * priors.JITTER_SHARE * step:.2g} ms",
        f"1 sample in {1.0 / priors.MISSING_SHARE:.0f} missing",
    ]
    axes = "swapped, negated or left-handed axes, wrong units of the gyro"
    turned = (
        equations is not None
        and rank_frames(equations)
        and rank_frames(equations)[0].cost < priors.FRAME_EXPLAINED
    )
    if turned:
        faults.append(axes)
    line = f"would also have been seen: {'; '.join(faults)}"
    return (
        (line,)
        if turned
        else (line, f"would not have been seen, because the sensor hardly turned: {axes}")
    )


def diagnose_with_gaps(track: Track, spec: Spec | None, diagnose: Diagnose) -> Diagnosis:
    """The diagnosis, with columns that have gaps if one of its effects depends on them."""
    gappy = roles.find_columns_with_gaps(track)
    if gappy:
        filled = track.with_columns(
            {**track.covariates, **{k: one.values for k, one in gappy.items()}}
        )
        missing = np.zeros(len(track), dtype=bool)
        for one in gappy.values():
            missing |= one.missing
        answer = diagnose(_without_magnetometer(filled, missing), spec)
        used = [name for name in gappy if name in _cause_columns(answer)]
        if used:
            notes = tuple(gappy[name].words for name in used)
            return replace(answer, notes=(*notes, *answer.notes))
    return diagnose(track, spec)


def _cause_columns(answer: Diagnosis) -> tuple[str, ...]:
    """Columns on which the effects of a diagnosis depend."""
    names = (one.setting.get("covariate") for one in answer.findings)
    by_place = any(one.effect in ("field_gradient", "field_anomaly") for one in answer.findings)
    position = ("position_north_m", "position_east_m", "position_down_m") if by_place else ()
    return (*(name for name in names if isinstance(name, str)), *position)


def _without_magnetometer(track: Track, rows: NDArray[np.bool]) -> Track:
    """The track without the magnetometer's readings in these rows."""
    return replace(track, mag_b_gauss=np.where(rows[:, None], np.nan, track.mag_b_gauss))
