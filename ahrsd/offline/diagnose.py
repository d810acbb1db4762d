"""From a recording to a diagnosis: load it, align it with the user's simulation, run the engine.

A table may have any units or axes here: wrong ones are a possible diagnosis.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.calibration_fit.noise_fit import check_spec_noise
from ahrsd.diagnosis.external_simulation import align, remove_common_findings
from ahrsd.diagnosis.inference.diagnose import diagnose_logged
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel, from_text
from ahrsd.diagnosis.track import Spec, Track
from ahrsd.errors import AhrsdError, RecordingError
from ahrsd.events import Event, SamplesSeen
from ahrsd.offline.track import check_track, track_of
from ahrsd.printable import printable
from ahrsd.recording.column_names import NO_MAP, ColumnMap
from ahrsd.recording.limits import TABLE_ROWS, on_one_thread
from ahrsd.recording.opening import open_recording

SHORTEST_S = 20.0  # a shorter recording does not even determine the calibration
FEWEST_ROWS = 100
RATE_AGREES = (
    0.05  # relative, of spec and time stamps: clock errors are smaller, unit errors larger
)
#: entries of a spec: smallest and largest plausible value, unit
_SPEC_KEYS = {
    "sigma_mag_gauss": (1e-7, 0.3, "gauss per sample"),
    "sigma_gyro_rad_s": (1e-7, 1.0, "rad/s per sample"),
    "rate_hz": (0.1, 1e4, "Hz"),
    "field_gauss": (0.01, 10.0, "gauss"),
}


def load_track(
    path: Path,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
    *,
    spec: Spec | None = None,
    columns: ColumnMap = NO_MAP,
) -> tuple[Track, list[str]]:
    """The recording as one track, and notes on how it was read.

    rate_hz: of a byte stream without time stamps; takes precedence over the spec. columns: names
    and units of a table. Raises RecordingError if there is nothing to diagnose.
    """
    recording = open_recording(path, rate_hz, check_units=False, columns=columns)
    spec_hz = None if spec is None else spec.rate_hz
    if (table := recording.table) is not None:
        recorded, notes = track_of(list(table.blocks(len(table.rows)))), list(recording.notes)
    else:
        recorded, notes = _replayed_track(path, rate_hz or spec_hz, progress)
    track, more_notes = check_track(recorded)
    if len(track) < FEWEST_ROWS or track.duration_s < SHORTEST_S:
        raise RecordingError(
            path,
            f"is too short to diagnose (samples: {len(track)}, {track.duration_s:.1f} s)",
            f"record at least {SHORTEST_S:.0f} s and {FEWEST_ROWS} samples, better some minutes",
        )
    return track, [*notes, *more_notes, *_rate_notes(track, spec_hz)]


def _rate_notes(track: Track, spec_hz: float | None) -> list[str]:
    """One line if the time stamps and the spec's rate disagree, else nothing."""
    rate_hz = 1.0 / float(np.nanmedian(track.dt_s))
    if spec_hz is None or abs(rate_hz / spec_hz - 1.0) < RATE_AGREES:
        return []
    return [
        f"the spec says {spec_hz:g} Hz, the time stamps {rate_hz:.4g} Hz: the stamps are used; "
        "check that they are in seconds"
    ]


def _replayed_track(
    path: Path, rate_hz: float | None, progress: Callable[[int], None] | None
) -> tuple[Track, list[str]]:
    # the daemon's whole pipeline, which a table does not need
    from ahrsd.config.config import Config
    from ahrsd.offline.replay import replay

    seen: list[Event] = []
    done = replay(
        path,
        Config(),
        rate_hz=rate_hz,
        listeners=[seen.append],
        progress=progress,
        most_samples=TABLE_ROWS,
    )
    blocks = [event.block for event in seen if isinstance(event, SamplesSeen)]
    return track_of(blocks), [*done.warnings, *done.core.stream.warnings]


def load_spec(path: Path) -> tuple[Spec, list[str]]:
    """The user's data of the sensor (JSON), and one line on each entry that was not used.

    Raises AhrsdError, one line, if it cannot be read.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise AhrsdError(f"{path}: is not JSON: {error}") from None
    if not isinstance(body, dict):
        raise AhrsdError(f"{path}: must be an object with some of {', '.join(_SPEC_KEYS)}")
    notes = [_unknown_key(path, key) for key in body if key not in _SPEC_KEYS]
    values: dict[str, float] = {}
    for key, (least, most, unit) in _SPEC_KEYS.items():
        value = body.get(key)
        if value is None:
            continue
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0.0 < value < math.inf:
            raise AhrsdError(f"{path}: {key} = {value!r}: must be a positive number")
        if least <= value <= most:
            values[key] = float(value)
        else:
            words = f"{path.name}: {key} = {value:g} was left out"
            notes.append(f"{words}: a sensor has {least:g} to {most:g} {unit}")
    return Spec(**values), notes


def _unknown_key(path: Path, key: str) -> str:
    near = difflib.get_close_matches(key, _SPEC_KEYS, n=1, cutoff=0.3)
    hint = f"is {near[0]} meant?" if near else f"it may have {', '.join(_SPEC_KEYS)}"
    return f"{path.name}: {key} is no entry of a spec and was left out; {hint}"


def load_model(path: Path) -> RepairedModel:
    """Read the file of a repaired model. AhrsdError, one line, if that fails."""
    try:
        return from_text(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    except ValueError as error:
        raise AhrsdError(f"{path}: {error}") from None


@on_one_thread
def diagnose_recording(
    real: Path,
    *,
    simulation: Path | None = None,
    spec: Path | None = None,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
    columns: ColumnMap = NO_MAP,
) -> Diagnosis:
    """Diagnose how `real` and its simulation differ. Raises RecordingError, AhrsdError.

    columns: names and units of `real`, if it is a table of another program
    """
    known, unused = (Spec(), []) if spec is None else load_spec(spec)
    track, notes = load_track(real, rate_hz, progress, spec=known, columns=columns)
    known, noise_notes = check_spec_noise(track, known)
    notes = [*unused, *notes, *noise_notes]
    if simulation is None:
        found = _diagnose_track(real, track, known)
        return replace(found, notes=(*notes, *found.notes))
    simulated, simulation_notes = load_track(simulation, rate_hz, spec=known)
    notes += [f"of the simulation: {note}" for note in simulation_notes]
    try:
        overlap = align(track, simulated)
    except ValueError as error:
        raise RecordingError(simulation, str(error), "bring a simulation of this motion") from None
    found = _diagnose_track(real, overlap.real, known)
    own = _diagnose_track(simulation, overlap.simulated, Spec())
    difference = remove_common_findings(found, own, overlap.other_axes)
    return replace(difference, notes=(*notes, *overlap.notes, *difference.notes))


def _diagnose_track(path: Path, track: Track, spec: Spec) -> Diagnosis:
    simulated = Path(f"{path}.truth.json").exists()  # as `ahrsd simulate` leaves it
    try:
        name = printable(path.name, 200)
        return diagnose_logged(track, spec, recording=name, simulated=simulated)
    except np.linalg.LinAlgError:
        raise RecordingError(
            path,
            "the fit did not converge: no calibration comes near these readings",
            "diagnose parts of it, and look at gyro and magnetometer where a part cannot be",
        ) from None
    except ValueError as error:
        raise RecordingError(path, str(error), "record again, with the vehicle turning") from None
