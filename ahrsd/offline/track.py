"""Samples of a recording as a track for the diagnosis, and faults of the recording.

Impossible readings are left out, impossible units or axes are reported, and the terms of a repaired
model are subtracted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ahrsd.diagnosis.columns.roles import prepare_columns
from ahrsd.diagnosis.data_quality.axes_and_units import axis_and_unit_errors, window_equations
from ahrsd.diagnosis.data_quality.facts import is_finding
from ahrsd.diagnosis.data_quality.preparation import find_facts
from ahrsd.diagnosis.data_quality.stuck import dead_axis_notes, without_impossible_readings
from ahrsd.diagnosis.data_quality.timestamps import without_clock_jumps
from ahrsd.diagnosis.effects.design_matrix import GRAVITY_M_S2
from ahrsd.diagnosis.repaired_model.forward import remove_terms
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel
from ahrsd.diagnosis.track import Track
from ahrsd.errors import AhrsdError
from ahrsd.events import Event, SamplesSeen
from ahrsd.printable import counted
from ahrsd.samples import Array, SampleBlock

_FEW_MISSING = 0.02  # share of rows with missing acceleration that is interpolated
_ACCEL_UNITS = (("g", GRAVITY_M_S2), ("mg", 1e-3 * GRAVITY_M_S2))


def track_of(blocks: list[SampleBlock]) -> Track:
    """Blocks in order as one track; only covariates that every block has are kept."""
    names = set.intersection(*(set(block.covariates) for block in blocks)) if blocks else set()

    def join(pick: Callable[[SampleBlock], Array]) -> Array:
        return np.concatenate([pick(block) for block in blocks])

    dt_s = join(lambda b: b.dt_s).copy()
    row = 0
    for block in blocks:
        if block.gap_before:
            dt_s[row] = np.nan
        row += len(block)
    dt_s[:1] = np.nan
    starts = [*np.flatnonzero(np.isnan(dt_s)).tolist(), len(dt_s)]
    accel = join(lambda b: b.accel_b_m_s2)
    with_accel = bool(np.isfinite(accel).any())
    return Track(
        time_s=join(lambda b: b.time_s),
        dt_s=dt_s,
        mag_b_gauss=join(lambda b: b.raw_b_gauss),
        gyro_b_rad_s=join(lambda b: b.gyro_b_rad_s),
        accel_b_m_s2=accel if with_accel else None,
        covariates={
            name: np.concatenate([block.covariates[name] for block in blocks])
            for name in sorted(names)
        },
        runs=tuple(slice(a, b) for a, b in pairwise(starts)),
    )


def check_track(track: Track) -> tuple[Track, list[str]]:
    """The track without impossible readings, and one line on each kind."""
    track, jump_notes = without_clock_jumps(track)
    track, notes = without_impossible_readings(track)
    accel, accel_notes = _usable_acceleration(track)
    return replace(track, accel_b_m_s2=accel), [
        *jump_notes,
        *notes,
        *dead_axis_notes(track),
        *accel_notes,
    ]


def _usable_acceleration(track: Track) -> tuple[Array | None, list[str]]:
    """(N, 3) m/s^2 with short gaps filled, None if unusable; and one line on what was done."""
    accel = track.accel_b_m_s2
    if accel is None:
        return None, []
    known = np.isfinite(accel).all(axis=1)
    missing = int(np.count_nonzero(~known))
    if missing == len(track):
        return None, []
    if missing > _FEW_MISSING * len(track):
        return None, [f"the acceleration was left out: {missing} of {len(track)} rows have none"]
    notes = [f"no acceleration in {counted(missing, 'row')}: filled"] if missing else []
    if missing:
        time_s = track.time_s
        accel = np.column_stack([np.interp(time_s, time_s[known], a[known]) for a in accel.T])
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    for unit, factor in _ACCEL_UNITS:
        if 0.7 * GRAVITY_M_S2 < size * factor < 1.4 * GRAVITY_M_S2:
            return accel * factor, [*notes, f"the acceleration was in {unit}: taken as m/s^2"]
    return accel, notes


def find_faults(blocks: list[SampleBlock]) -> tuple[list[str], list[str]]:
    """In words: impossible units, axes, signs and times; and other anomalies.

    A clock that jumps at the start of a run (a restart of the device) is no fault.
    """
    facts = find_facts(without_clock_jumps(track_of(blocks))[0]) if blocks else ()
    wrong = [fact.words for fact in facts if fact.stops]
    return wrong, [fact.words for fact in facts if not fact.stops and is_finding(fact)]


def axis_disagreements(track: Track) -> list[str] | None:
    """Where the axes of field, gyro and gravity disagree; None: too little turning to decide, and
    no other fault."""
    found = [fact.words for fact in axis_and_unit_errors(track)]
    return found if found or window_equations(track) else None


def without_terms(
    path: Path, seen: list[Event], model: RepairedModel
) -> tuple[list[Event], tuple[str, ...]]:
    """The events with the model's terms subtracted from the samples; and the terms that remain.

    AhrsdError if a term needs a column that the recording does not have.
    """
    blocks = [event.block for event in seen if isinstance(event, SamplesSeen)]
    if not blocks:
        return seen, ()
    track, refused = prepare_columns(check_track(track_of(blocks))[0])
    try:
        track, left = remove_terms(track, model.calibration, model.terms)
    except ValueError as error:
        raise AhrsdError("; ".join([f"{path}: {error}", *refused])) from None
    rows = iter(np.cumsum([0, *map(len, blocks)]).tolist())
    begin, events = next(rows), []
    for event in seen:
        if isinstance(event, SamplesSeen):
            part, begin = slice(begin, end := next(rows)), end
            event = replace(
                event,
                block=replace(
                    event.block,
                    raw_b_gauss=track.mag_b_gauss[part],
                    gyro_b_rad_s=track.gyro_b_rad_s[part],
                ),
            )
        events.append(event)
    return events, left
