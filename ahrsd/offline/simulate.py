"""Simulated recordings: effects in an experiment, a repaired model along a measured motion, and
their files."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path

from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.repaired_model import forward, injection
from ahrsd.diagnosis.repaired_model.injection import inject_terms, readings_of, terms_json
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel
from ahrsd.diagnosis.track import Track
from ahrsd.errors import AhrsdError
from ahrsd.recording.table import TABLE_SUFFIXES, is_table, write_table
from ahrsd.samples import Array
from ahrsd.simulation import Experiment, scenarios

STREAM_SUFFIXES = (".vnraw", ".vnraw.gz")


def add_effects(
    experiment: Experiment, wanted: Sequence[str], seed: int
) -> tuple[Experiment, list[dict[str, object]]]:
    """The experiment with the requested effects and the covariates they need, and the terms for the
    truth. AhrsdError, one line, for an invalid request."""
    try:
        requests = [injection.parse_request(text) for text in wanted]
        effects = [one.effect for one in requests]
        columns = injection.columns_for(effects, experiment.samples.time_s, seed)
        readings = readings_of(experiment, columns)
        terms = [one.term(readings) for one in requests]
        for term in terms:
            _check_onset(term, readings.time_s)
    except ValueError as error:
        raise AhrsdError(f"--effect: {error}") from None
    return inject_terms(experiment, readings, terms), terms_json(terms)


def _check_onset(term: Term, time_s: Array) -> None:
    """ValueError where the effect would begin before or after all samples."""
    onset_s, last_s = term.setting.get("onset_s"), float(time_s[-1])
    if isinstance(onset_s, int | float) and not time_s[0] <= onset_s <= last_s:
        raise ValueError(
            f"{term.identifier}: onset_s is {onset_s:g}, the recording ends at {last_s:.6g} s"
        )


def simulate_along_motion(
    model: RepairedModel, recording: Path, read: Track, seed: int
) -> tuple[dict[str, Array], list[str]]:
    """Columns of a table: readings of the repaired model along the motion of a recording.

    `read` is the recording's own track. AhrsdError if a term needs a column that is missing.
    """
    track, refused = roles.prepare_columns(read)
    try:
        context = forward.context_along(track, model.calibration, model.terms)
        truth = forward.noise_free_readings(context)
        made = forward.simulate_readings(truth, model.terms, model.noise, seed)
    except ValueError as error:
        raise AhrsdError(f"{recording}: {error}") from None
    done = forward.track_from_readings(made, track)
    written = {"time_s": done.time_s}
    sensors = [("mag", "gauss", done.mag_b_gauss), ("gyro", "rad_s", done.gyro_b_rad_s)]
    if done.accel_b_m_s2 is not None:
        sensors.append(("accel", "m_s2", done.accel_b_m_s2))
    for name, unit, values in sensors:
        written |= {f"{name}_{axis}_{unit}": values[:, i] for i, axis in enumerate("xyz")}
    return written | done.covariates, [*refused]


def write_experiment(path: Path, experiment: Experiment) -> None:
    """Write a table, or a byte stream of VNYMR sentences, by the file's suffix; else AhrsdError."""
    further = experiment.samples.covariates
    if is_table(path):
        write_columns(path, {**scenarios.columns(experiment), **further})
        return
    if not path.name.endswith(STREAM_SUFFIXES):
        known = ", ".join((*TABLE_SUFFIXES, *STREAM_SUFFIXES))
        raise AhrsdError(f"{path}: unknown kind of file; the name must end in one of {known}")
    if further:
        raise AhrsdError(
            f"{path}: a byte stream has no place for {', '.join(further)}; write a table"
        )
    content = b"".join(scenarios.sentences(experiment))
    try:
        path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error


def write_columns(path: Path, columns: Mapping[str, Array]) -> None:
    """Write a table. AhrsdError if that fails."""
    try:
        write_table(path, columns)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
