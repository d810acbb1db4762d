"""Effects in a simulated experiment, and in an emulated device along its own motion.

What the sensor would have sent with them in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis.effects import profiles, request
from ahrsd.diagnosis.effects.effect import Effect, Readings
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.repaired_model.forward import simulated
from ahrsd.samples import Array
from ahrsd.simulation import Experiment
from drivers.vn100.emulator.physics import GRAVITY_M_S2, matrices, quaternions
from drivers.vn100.emulator.scenarios import Setup, hidden


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


# -- In an emulated device ------------------------------------------------------------------------


RATE_HZ = 100.0
PIECE_S = 300.0
WARM_UP_S = 120.0  # what an effect with a memory has seen before a piece begins
HORIZON_S = 3600.0  # made-up columns repeat after it; onsets and spans refer to it
_COLUMNS_HZ = 20.0


class EmulatedEffects:
    """What the effects add to the device's sensors, as a function of its time.

    Worked out at 100 Hz in pieces of five minutes, straight in between; before time 0 it is as at
    time 0.  The device sends no further columns, so an effect of a current is one that nobody
    logged; the temperature is the device's own.
    Raises ValueError in one line for an effect that is not additive or a request that cannot be.
    """

    def __init__(self, setup: Setup, wanted: Sequence[str]) -> None:
        _, self._truth, self._motion = hidden(setup)
        requests = [request.parse(text) for text in wanted]
        for one in requests:
            if one.effect.kind != "mean" or one.effect.after_noise:
                known = ", ".join(
                    e.identifier for e in EFFECTS.values() if e.kind == "mean" and not e.after_noise
                )
                raise ValueError(
                    f"{one.effect.identifier} cannot be emulated; there are {known}, and faults"
                )
        grid = np.arange(0.0, HORIZON_S, 1.0 / _COLUMNS_HZ)
        self._columns = profiles.columns_for([one.effect for one in requests], grid, setup.seed)
        whole = self._readings(np.arange(0.0, HORIZON_S, 1.0))
        self._terms = tuple(one.term(whole) for one in requests)
        self._pieces: dict[int, tuple[Array, Array, Array]] = {}

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Field (gauss) and rate (rad/s), (N, 3) each, that add at the instants (N,)."""
        asked = np.maximum(time_s, 0.0)
        mag, gyro = np.zeros((len(asked), 3)), np.zeros((len(asked), 3))
        number = (asked // PIECE_S).astype(int)
        for piece in np.unique(number).tolist():
            rows = number == piece
            known_s, of_mag, of_gyro = self._piece(piece)
            for axis in range(3):
                mag[rows, axis] = np.interp(asked[rows], known_s, of_mag[:, axis])
                gyro[rows, axis] = np.interp(asked[rows], known_s, of_gyro[:, axis])
        return mag, gyro

    def _piece(self, number: int) -> tuple[Array, Array, Array]:
        if number not in self._pieces:
            start = max(number * PIECE_S - WARM_UP_S, 0.0)
            rows = round(((number + 1) * PIECE_S - start) * RATE_HZ) + 1
            clean = self._readings(start + np.arange(rows) / RATE_HZ)
            made = simulated(clean, self._terms)
            self._pieces = {
                **{k: v for k, v in self._pieces.items() if k >= number - 1},
                number: (
                    clean.time_s,
                    made.mag_b_gauss - clean.mag_b_gauss,
                    made.gyro_b_rad_s - clean.gyro_b_rad_s,
                ),
            }
        return self._pieces[number]

    def _readings(self, time_s: Array) -> Readings:
        """The device's noise-free readings at instants (N,) of one step."""
        truth, step_s = self._truth, float(time_s[1] - time_s[0])
        R_nb = matrices(quaternions(self._motion.angles(time_s)))
        before = matrices(quaternions(self._motion.angles(time_s - step_s)))
        rate = so3.log(np.swapaxes(before, 1, 2) @ R_nb) / step_s
        field_b = np.einsum("nji,j->ni", R_nb, truth.field_n_gauss)
        return Readings(
            time_s=time_s,
            dt_s=np.concatenate([[np.nan], np.diff(time_s)]),
            mag_b_gauss=field_b @ truth.soft_iron.T + truth.hard_iron_gauss,
            gyro_b_rad_s=rate + truth.gyro_bias_rad_s,
            accel_b_m_s2=-GRAVITY_M_S2 * R_nb[:, 2, :],
            rate_b_rad_s=rate,
            field_b=field_b,
            R_nb=R_nb,
            soft_iron=truth.soft_iron,
            covariates=self._covariates(time_s),
        )

    def _covariates(self, time_s: Array) -> dict[str, Array]:
        grid = np.arange(0.0, HORIZON_S, 1.0 / _COLUMNS_HZ)
        lap_s = np.mod(time_s, HORIZON_S)
        out = {name: np.interp(lap_s, grid, values) for name, values in self._columns.items()}
        if "temperature_c" in out:
            warmth = 1 - np.exp(-time_s / 600.0)
            out["temperature_c"] = self._truth.temperature_c + self._truth.warming_c * warmth
        return out
