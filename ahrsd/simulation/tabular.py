"""An experiment laid out as a recording: the contract's table columns, or VNYMR sentences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

import numpy as np

from ahrsd.samples import Array
from ahrsd.simulation.experiment import Experiment
from ahrsd.simulation.scenarios import ScenarioSettings, quaternion
from drivers.vn100.sentences import encode_sentence


def columns(experiment: Experiment) -> dict[str, Array]:
    """Columns by name: samples, then the true attitude ref_q{w,x,y,z}, sensor to world."""
    s = experiment.samples
    out = {"time_s": s.time_s}
    for name, unit, vectors in (
        ("mag", "gauss", s.raw_b_gauss),
        ("gyro", "rad_s", s.gyro_b_rad_s),
        ("accel", "m_s2", s.accel_b_m_s2),
    ):
        out |= {f"{name}_{axis}_{unit}": vectors[:, i] for i, axis in enumerate("xyz")}
    q = quaternion(experiment.R_nb)
    return out | {f"ref_q{part}": q[:, i] for i, part in enumerate("wxyz")}


def sentences(experiment: Experiment) -> Iterator[bytes]:
    """One VNYMR sentence per sample, as a device with factory registers prints it.

    Yaw, pitch and roll are the truth. The text rounds the field to 0.1 mG and carries no time.
    """
    R, s = experiment.R_nb, experiment.samples
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    pitch = -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(R[:, 2, 1], R[:, 2, 2])
    rows = np.column_stack([yaw, pitch, roll, s.raw_b_gauss, s.accel_b_m_s2, s.gyro_b_rad_s])
    for row in rows.tolist():
        yield encode_sentence("VNYMR", row)


def truth_json(experiment: Experiment, made_from: dict[str, object]) -> dict[str, object]:
    """FILE.truth.json: the hidden values, and what makes the same file again."""
    return {
        "schema": "ahrsd.truth/1",
        "name": experiment.name,
        "convention": "m = A h + b + noise with det A = 1; w_read = w + w_b + noise",
        **experiment.truth.json(),
        "made_from": made_from,
    }


def settings_json(settings: ScenarioSettings) -> dict[str, object]:
    """The settings by name, the sensor in the theses' terms."""
    iron = settings.iron
    return {
        "scenario": settings.scenario,
        "motion": settings.motion,
        "seed": settings.seed,
        "samples": settings.samples,
        "rate_hz": settings.rate_hz,
        "soft_iron": iron.soft_iron.tolist(),
        "pseudo_hard_iron_gauss": iron.pseudo_hard_iron_gauss.tolist(),
        "hard_iron_is": "m_b" if iron.offset_behind_iron else "A m_b",
        "field_n_gauss": iron.field_n_gauss.tolist(),
        "disturbances": asdict(settings.disturbances),
    }
