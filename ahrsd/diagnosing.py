"""From a recording to a diagnosis: load, align with the user's simulation, ask the engine.

A table may have any units or axes here: that they are wrong is one of the possible answers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ahrsd.errors import AhrsdError, RecordingError
from ahrsd.events import Event, SamplesSeen
from ahrsd.mismatch.aligned import align, differing
from ahrsd.mismatch.diagnosis import Diagnosis
from ahrsd.mismatch.engine import diagnose
from ahrsd.mismatch.model_file import RepairedModel, from_text
from ahrsd.mismatch.track import Spec, Track
from ahrsd.recording.opening import Kind, open_recording
from ahrsd.recording.table import read_table
from ahrsd.samples import Array, SampleBlock

SHORTEST_S = 20.0  # below this not even the calibration can be told from anything else
FEWEST_ROWS = 100
RATE_AGREES = 0.05  # of a spec and the stamps' median step: clocks are closer, units are not
_SPEC_KEYS = ("sigma_mag_gauss", "sigma_gyro_rad_s", "rate_hz", "field_gauss")


def load_track(
    path: Path,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    spec: Spec | None = None,
) -> tuple[Track, list[str]]:
    """The recording as one track, and what a person should know of how it was read.

    rate_hz: for a byte stream without a time of its own, before that of the spec
    Raises RecordingError where there is nothing to diagnose.
    """
    recording = open_recording(path, rate_hz, check_units=False)
    said_hz = None if spec is None else spec.rate_hz
    if recording.kind is Kind.TABLE:
        table = recording.table or read_table(path, check_units=False)
        blocks, notes = list(table.blocks(len(table.rows))), list(recording.notes)
    else:
        blocks, notes = _streamed(path, rate_hz or said_hz, progress)
    track = track_of(blocks)
    if len(track) < FEWEST_ROWS or track.duration_s < SHORTEST_S:
        raise RecordingError(
            path,
            f"is too short to diagnose: {len(track)} samples in {track.duration_s:.1f} s",
            f"record at least {SHORTEST_S:.0f} s and {FEWEST_ROWS} samples, better some minutes",
        )
    return track, [*notes, *_of_its_rate(track, said_hz)]


def _of_its_rate(track: Track, said_hz: float | None) -> list[str]:
    """One line where the time stamps and the spec's rate say different things."""
    rate_hz = 1.0 / float(np.nanmedian(track.dt_s))
    if said_hz is None or abs(rate_hz / said_hz - 1.0) < RATE_AGREES:
        return []
    return [
        f"the spec says {said_hz:g} Hz, the time stamps {rate_hz:.4g} Hz: the stamps are used; "
        "check that they are in seconds"
    ]


def _streamed(
    path: Path, rate_hz: float | None, progress: Callable[[int], None] | None
) -> tuple[list[SampleBlock], list[str]]:
    # the daemon's whole pipeline, which a table does not need
    from ahrsd.config import Config
    from ahrsd.replay import replay

    seen: list[Event] = []
    done = replay(path, Config(), rate_hz=rate_hz, listeners=[seen.append], progress=progress)
    blocks = [event.block for event in seen if isinstance(event, SamplesSeen)]
    return blocks, [*done.warnings, *done.core.stream.warnings]


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
    return Track(
        time_s=join(lambda b: b.time_s),
        dt_s=dt_s,
        mag_b_gauss=join(lambda b: b.raw_b_gauss),
        gyro_b_rad_s=join(lambda b: b.gyro_b_rad_s),
        accel_b_m_s2=accel if np.isfinite(accel).all() else None,
        covariates={
            name: np.concatenate([block.covariates[name] for block in blocks])
            for name in sorted(names)
        },
        runs=tuple(slice(a, b) for a, b in pairwise(starts)),
    )


def load_spec(path: Path) -> Spec:
    """What the user knows of the sensor (JSON).  Raises AhrsdError, one line."""
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise AhrsdError(f"{path}: is not JSON: {error}") from None
    if not isinstance(body, dict):
        raise AhrsdError(f"{path}: must be an object with some of {', '.join(_SPEC_KEYS)}")
    values: dict[str, float] = {}
    for key in _SPEC_KEYS:
        value = body.get(key)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0.0:
            raise AhrsdError(f"{path}: {key} = {value!r}: must be a positive number")
        values[key] = float(value)
    return Spec(**values)


def load_model(path: Path) -> RepairedModel:
    """A repaired model's file.  AhrsdError in one line where it cannot be read or is none."""
    try:
        return from_text(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    except ValueError as error:
        raise AhrsdError(f"{path}: {error}") from None


def diagnose_recording(
    real: Path,
    *,
    simulation: Path | None = None,
    spec: Path | None = None,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> Diagnosis:
    """Where REAL and its simulation differ.  Raises RecordingError, AhrsdError."""
    known = Spec() if spec is None else load_spec(spec)
    track, notes = load_track(real, rate_hz, progress, spec=known)
    if simulation is None:
        found = _answered(real, track, known)
        return replace(found, notes=(*notes, *found.notes))
    simulated, _ = load_track(simulation, rate_hz, spec=known)
    try:
        overlap = align(track, simulated)
    except ValueError as error:
        raise RecordingError(simulation, str(error), "bring a simulation of this motion") from None
    found = _answered(real, overlap.real, known)
    own = _answered(simulation, overlap.simulated, Spec())
    left = differing(found, own)
    return replace(left, notes=(*notes, *overlap.notes, *left.notes))


def _answered(path: Path, track: Track, spec: Spec) -> Diagnosis:
    try:
        return diagnose(track, spec, recording=path.name)
    except ValueError as error:
        raise RecordingError(path, str(error), "record again, with the vehicle turning") from None
