"""Effects in a simulated experiment: what the sensor would have sent with them in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.effects.base import Effect, Readings
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.forward import simulated
from ahrsd.diagnosis.values import Term
from ahrsd.samples import Array
from ahrsd.simulation import Experiment


def readings_of(experiment: Experiment, covariates: Mapping[str, Array]) -> Readings:
    """The experiment's truth and its noise-free readings."""
    truth, samples = experiment.truth, experiment.samples
    return Readings(
        time_s=samples.time_s,
        dt_s=samples.dt_s,
        mag_b_gauss=experiment.field_b @ truth.soft_iron.T + truth.hard_iron_gauss,
        gyro_b_rad_s=experiment.rate_b_rad_s + truth.gyro_bias_rad_s,
        accel_b_m_s2=samples.accel_b_m_s2,
        rate_b_rad_s=experiment.rate_b_rad_s,
        field_b=experiment.field_b,
        R_nb=experiment.R_nb,
        soft_iron=truth.soft_iron,
        covariates=dict(covariates),
    )


def injected(
    experiment: Experiment,
    readings: Readings,
    terms: Sequence[Term],
    library: Mapping[str, Effect] = EFFECTS,
) -> Experiment:
    """The experiment with the terms in its samples, between its truth and its own noise.

    readings: its noise-free readings with the covariates; those become the samples' covariates.
    """
    samples = experiment.samples
    early = [t for t in terms if not library[t.identifier].after_noise]
    late = [t for t in terms if library[t.identifier].after_noise]
    made = simulated(readings, early, library=library)
    noisy = replace(
        made,
        mag_b_gauss=made.mag_b_gauss + (samples.raw_b_gauss - readings.mag_b_gauss),
        gyro_b_rad_s=made.gyro_b_rad_s + (samples.gyro_b_rad_s - readings.gyro_b_rad_s),
    )
    done = simulated(noisy, late, library=library)
    return Experiment(
        name=" with ".join([experiment.name, *(term.identifier for term in terms)]),
        samples=replace(
            samples,
            time_s=done.time_s,
            dt_s=done.dt_s,
            host_s=done.time_s,
            raw_b_gauss=done.mag_b_gauss,
            gyro_b_rad_s=done.gyro_b_rad_s,
            accel_b_m_s2=done.accel_b_m_s2,
            covariates=done.covariates,
        ),
        truth=experiment.truth,
        R_nb=done.R_nb,
        field_b=done.field_b,
        rate_b_rad_s=done.rate_b_rad_s,
    )


def terms_json(
    terms: Sequence[Term], library: Mapping[str, Effect] = EFFECTS
) -> list[dict[str, object]]:
    """The terms for the truth beside a recording: value, unit and setting of each."""
    return [
        {
            "effect": term.identifier,
            "setting": term.setting,
            "parameters": [
                {"name": p.name, "value": float(value), "unit": p.unit}
                for p, value in zip(
                    library[term.identifier].parameters, np.atleast_1d(term.value), strict=True
                )
            ],
        }
        for term in terms
    ]
