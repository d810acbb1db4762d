"""A recording as it is diagnosed: columns in their roles, one clock, and what was counted in it.

Before any physics: what is wrong with the recording itself (`facts_of`), by counting and comparing
only, no calibration: repeated and doubled readings, limits, coarse steps, the clock, units, and
whether gyro and magnetometer mean the same axes.  It is told before any fit, and `put_right` gives
the track as it would be without it; what stops a fit is an answer.

What a column with holes can still say is asked first (`with_holes`); it counts only if an effect is
named by it.  Else the answer is the one that the recording gives without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.calibration_fit.null_fit import unusable
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.data_quality.axes_and_units import as_recorded, ranked, windows
from ahrsd.diagnosis.data_quality.facts import Fact, matters, of_fact, stopped
from ahrsd.diagnosis.data_quality.range_and_resolution import clipping, quantisation
from ahrsd.diagnosis.data_quality.stuck import dead, repeats, stuck_axes, stuck_gyro
from ahrsd.diagnosis.data_quality.timestamps import regular, stamps, without_jumps
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.track import NothingToFit, Spec, Track

#: a diagnosis of a track and what is known of the sensor
Ask = Callable[[Track, Spec | None], Diagnosis]


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A recording before any fit.

    track: as it was recorded, but for the clock's jumps;  facts: found by counting
    notes: what a person should know of how it was read
    """

    track: Track
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]

    def stopped(self, recording: str, library: Mapping[str, Effect]) -> Diagnosis | None:
        """The answer where nothing that is fitted would mean anything; else None."""
        stops = [fact for fact in self.facts if fact.stops]
        return stopped(recording, stops, library, self.notes) if stops else None

    def with_facts(self, more: Sequence[Fact]) -> Prepared:
        """The same with what was counted later: turns that were lost."""
        return replace(self, facts=(*self.facts, *more))

    def put_right(self) -> Track:
        """The track without what its facts say is wrong."""
        return put_right(self.track, self.facts)

    def told(self, library: Mapping[str, Effect]) -> tuple[Finding, ...]:
        """The facts that are findings."""
        return tuple(of_fact(fact, library) for fact in self.facts if matters(fact))

    @property
    def lesser(self) -> tuple[str, ...]:
        """The others, which are worth a note."""
        return tuple(fact.words for fact in self.facts if not matters(fact))


def prepared(track: Track) -> Prepared:
    """A recording ready to be fitted.  NothingToFit, one line, where nothing can be."""
    track, notes = roles.prepared(track)
    track, jumped = without_jumps(track)
    if why := unusable(track) or dead(track):
        raise NothingToFit(why)
    return Prepared(track, facts_of(track), (*jumped, *notes))


def facts_of(track: Track) -> tuple[Fact, ...]:
    """Everything that is found, what stops first."""
    wrong = as_recorded(track)
    limits = clipping(track)
    clipped = next((fact.bad for fact in limits if fact.bad is not None), None)
    again = repeats(track, clipped) + stuck_gyro(track)
    known = [fact.bad for fact in again + limits if fact.bad is not None]
    again += stuck_axes(track, np.any([np.zeros(len(track), bool), *known], axis=0))
    rest = again + limits + quantisation(track) + stamps(track)
    return tuple(sorted(wrong + rest, key=lambda fact: not fact.stops))


def put_right(track: Track, facts: Sequence[Fact]) -> Track:
    """The track without what the facts say: frames and units undone, false readings nan.

    Jittering stamps are put on their regular clock, the turn of lost samples is put back, and
    where the turn is not known a run ends.  Rows stay as they are in number and order.
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
            time_s = regular(track)
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


def would_have_shown(track: Track) -> tuple[str, ...]:
    """What the checks would have shown here, one line each."""
    mag, gyro = noise_of_differences(track)
    step = track.step_s
    found = windows(track)
    shown = [
        "a magnetometer stuck while the field turns by "
        f"{1e3 * priors.STUCK_TURNED_NOISE * mag:.2g} mG",
        f"readings in steps above {1e3 * priors.COARSE_STEPS * mag:.2g} mG "
        f"(noise {1e3 * mag:.2g} mG, {1e3 * gyro:.2g} mrad/s)",
        f"time stamps that jitter by {1e3 * priors.JITTER_SHARE * step:.2g} ms",
        f"1 sample in {1.0 / priors.MISSING_SHARE:.0f} missing",
    ]
    axes = "swapped, negated or left-handed axes, wrong units of the gyro"
    turned = found is not None and ranked(found) and ranked(found)[0].cost < priors.FRAME_EXPLAINED
    if turned:
        shown.append(axes)
    said = f"would also have been seen: {'; '.join(shown)}"
    return (said,) if turned else (said, f"would not have been seen, it hardly turned: {axes}")


def with_holes(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """An answer, with columns that have holes where an effect is named by one."""
    holed = roles.holed(track)
    if holed:
        filled = track.with_columns(
            {**track.covariates, **{k: one.values for k, one in holed.items()}}
        )
        missing = np.zeros(len(track), dtype=bool)
        for one in holed.values():
            missing |= one.missing
        found = ask(_blind(filled, missing), spec)
        used = [name for name in holed if name in _causes(found)]
        if used:
            notes = tuple(holed[name].words for name in used)
            return replace(found, notes=(*notes, *found.notes))
    return ask(track, spec)


def _causes(found: Diagnosis) -> tuple[str, ...]:
    """Columns by which effects are named."""
    names = (one.setting.get("covariate") for one in found.findings)
    by_place = any(one.effect in ("field_gradient", "field_anomaly") for one in found.findings)
    position = ("position_north_m", "position_east_m", "position_down_m") if by_place else ()
    return (*(name for name in names if isinstance(name, str)), *position)


def _blind(track: Track, rows: NDArray[np.bool]) -> Track:
    """The track without the magnetometer's readings of these rows."""
    return replace(track, mag_b_gauss=np.where(rows[:, None], np.nan, track.mag_b_gauss))
