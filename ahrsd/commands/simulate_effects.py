"""What `ahrsd simulate` does beyond its scenarios: effects in them, and repaired models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ahrsd.commands.evaluate_sources import read_track
from ahrsd.config import Config
from ahrsd.errors import AhrsdError, RecordingError
from ahrsd.mismatch import forward, roles
from ahrsd.mismatch.effects import profiles, request
from ahrsd.mismatch.effects.series import runs
from ahrsd.mismatch.injection import injected, readings_of, terms_json
from ahrsd.mismatch.model_file import RepairedModel, from_text
from ahrsd.mismatch.track import Track
from ahrsd.samples import Array
from ahrsd.simulation import Experiment


def with_effects(
    experiment: Experiment, wanted: Sequence[str], seed: int
) -> tuple[Experiment, list[dict[str, object]]]:
    """The experiment with the wanted effects and the covariates they need, and the terms for the
    truth.  AhrsdError in one line for a request that cannot be."""
    try:
        requests = [request.parse(text) for text in wanted]
        effects = [one.effect for one in requests]
        columns = profiles.columns_for(effects, experiment.samples.time_s, seed)
        readings = readings_of(experiment, columns)
        terms = [one.term(readings) for one in requests]
    except ValueError as error:
        raise AhrsdError(f"--effect: {error}") from None
    return injected(experiment, readings, terms), terms_json(terms)


def read_model(path: Path) -> RepairedModel:
    """A model file.  AhrsdError in one line where it cannot be read or is none."""
    try:
        return from_text(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}; check the path") from error
    except ValueError as error:
        raise AhrsdError(f"{path}: {error}") from None


def read_mismatch_track(path: Path, rate_hz: float | None = None) -> tuple[Track, list[str]]:
    """A recording as a track with usable covariates, and what a person should know.

    RecordingError where the recording cannot be opened or is too short.
    """
    read, notes = read_track(path, Config(), rate_hz)
    time_s = read.time_s
    if len(time_s) < 2:
        raise RecordingError(path, "has a single sample", "record longer")
    dt_s = time_s.copy()
    dt_s[1:] = time_s[1:] - time_s[:-1]
    dt_s[list(read.starts)] = float("nan")
    accel = read.accel_b_m_s2 if read.has_accel else None
    whole = Track(
        time_s,
        dt_s,
        read.raw_b_gauss,
        read.gyro_b_rad_s,
        accel,
        dict(read.covariates),
        tuple(runs(dt_s)),
    )
    track, refused = roles.prepared(whole)
    return track, [*notes, *refused]


def along(model: RepairedModel, recording: Path, seed: int) -> tuple[dict[str, Array], list[str]]:
    """A table's columns: what the repaired model reads along the motion of a recording.

    AhrsdError where a term of the model needs a column that the recording has not.
    """
    track, notes = read_mismatch_track(recording)
    try:
        context = forward.context_along(track, model.calibration, model.terms)
        truth = forward.truth_along(context)
        made = forward.simulated(truth, model.terms, model.noise, seed)
    except ValueError as error:
        raise AhrsdError(f"{recording}: {error}") from None
    done = forward.track_of(made, track)
    columns = {"time_s": done.time_s}
    sensors = [("mag", "gauss", done.mag_b_gauss), ("gyro", "rad_s", done.gyro_b_rad_s)]
    if done.accel_b_m_s2 is not None:
        sensors.append(("accel", "m_s2", done.accel_b_m_s2))
    for name, unit, values in sensors:
        columns |= {f"{name}_{axis}_{unit}": values[:, i] for i, axis in enumerate("xyz")}
    return columns | done.covariates, notes
