"""[R] chapter 6 as a simulated dive: calibrated on EXP1 or EXP2, judged by the survey of EXP2.

The dive's data are not public. What [R] prints is taken as it is: VN-100 at 80 Hz with 1 mG and
0.5 mrad/s, INS heading good to 0.05 deg and DVL at 25 Hz, field of 479 mG, soft iron and gyro bias
of Table 6.2 (EXP1, BFG) and the direction of its hard iron, full turns of heading with 5 deg of
roll and pitch, a survey of 1,395 m, stable in roll and pitch. The hard iron is as long as makes the
raw heading wrong by 6.33 deg (standard deviation) on the survey. What [R] does not print is
assumed; it stands in the constants below, each with where it is from.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.signal import lfilter
from seed_figures.chapter5 import OURS, Answering, Each, Said, published, unguarded
from seed_figures.turning import Turning, sensed

from ahrsd import so3
from ahrsd.calibration import Affine
from ahrsd.evaluation.heading import (
    DOPPLER,
    Fixes,
    HeadingReference,
    heading_figures,
    reckoning_figures,
    velocity_of,
)
from ahrsd.evaluation.track import EvaluationTrack
from ahrsd.heading import tilt_compensated_heading, wrapped
from ahrsd.montecarlo.accuracy import MethodAnswer
from ahrsd.samples import Array
from ahrsd.simulation import Experiment, Iron
from ahrsd.simulation.scenarios import generator
from ahrsd.world_field import world_field

# -- printed in [R] --------------------------------------------------------------------------------
RATE_HZ, INS_HZ = 80.0, 25.0
NOISE_GAUSS, NOISE_RAD_S = 1e-3, 0.5e-3
FIELD_GAUSS, WAY_M, RAW_DEG, INS_DEG = 0.479, 1395.0, 6.33, 0.05
SOFT_IRON = np.array([[1.007, 0.000, 0.011], [0.000, 1.030, 0.004], [0.011, 0.004, 0.964]])
HARD_IRON_MG = np.array([-7.509, 25.211, -0.732])
GYRO_BIAS_RAD_S = 1e-3 * np.array([0.175, -0.101, 0.490])
# -- assumed ---------------------------------------------------------------------------------------
PLACE = (36.7, -122.1, 0.0, 2014.95)  # Monterey Bay; the world model's direction of the field
EXP1_S, SHORT_S = 600.0, 60.0  # full and in the short form
LEGS, LEG_M = 12, 100.0  # north and south; the 11 ways across share what is left of 1,395 m
SPEED_M_S, TURN_RAD_S = 0.5, 0.1  # the vehicle turns on the spot at the ends of the legs
SURVEY_TILT_DEG, SURVEY_TILT_HZ = 0.5, (0.09, 0.13)  # of roll and pitch: "stable"
ACCEL_NOISE_M_S2 = 0.01  # VN-100's 0.14 mg/sqrt(Hz) over 40 Hz
DVL_NOISE_M_S, DVL_SCALE, DVL_BIAS_M_S = 0.003, 0.002, 0.001  # of a 600 kHz Workhorse's data sheet
INS_CORRELATION_S = 300.0  # its heading error is slow: first-order Gauss-Markov
FIXES_HZ = 1.0
SUBSTEPS = 2  # of a step of 12.5 ms
PARTS = (10, 25, 50, 75, 100)  # percent of EXP1, for the incremental graph

EXP1 = Turning("EXP1", (5.0, 5.0, 180.0), "rov", 0, RATE_HZ, NOISE_GAUSS, NOISE_RAD_S)


def field_n_gauss() -> Array:
    """479 mG in the direction of the world model."""
    found = world_field(*PLACE, model="igrf").field_n_gauss
    return np.asarray(FIELD_GAUSS * found / np.linalg.norm(found))


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Instants (N,), heading (N,) and speed (N,) along it of the lawn mower."""

    time_s: Array
    heading_rad: Array
    speed_m_s: Array

    @staticmethod
    def at(rate_hz: float) -> Survey:
        """Leg, turn, way across, turn, and so on; 1,395 m in all."""
        across_m = (WAY_M - LEGS * LEG_M) / (LEGS - 1)
        pieces, heading = [], 0.0  # duration, heading at its beginning and end, speed
        for leg in range(LEGS):
            pieces.append((LEG_M / SPEED_M_S, heading, heading, SPEED_M_S))
            if leg == LEGS - 1:
                break
            side = np.pi / 2 if leg % 2 == 0 else -np.pi / 2  # both ways across go east
            for way_m in (across_m, 0.0):
                pieces.append((np.pi / 2 / TURN_RAD_S, heading, heading + side, 0.0))
                heading += side
                if way_m:
                    pieces.append((way_m / SPEED_M_S, heading, heading, SPEED_M_S))
        ends = np.cumsum([p[0] for p in pieces])
        time_s = np.arange(int(ends[-1] * rate_hz)) / rate_hz
        k = np.minimum(np.searchsorted(ends, time_s, side="right"), len(pieces) - 1)
        length, begin, end, speed = np.array(pieces)[k].T
        share = np.clip((time_s - (ends[k] - length)) / length, 0.0, 1.0)
        smooth = share - np.sin(2 * np.pi * share) / (2 * np.pi)  # starts and ends at rest
        return Survey(time_s, begin + (end - begin) * smooth, speed)

    def angles(self, seed: int) -> Array:
        """Roll, pitch, heading (N, 3) in rad."""
        phase = generator(seed, 4).uniform(0, 2 * np.pi, 2)
        tilt = np.radians(SURVEY_TILT_DEG) * np.sin(
            2 * np.pi * np.outer(self.time_s, SURVEY_TILT_HZ) + phase
        )
        return np.column_stack([tilt, self.heading_rad])


def iron_of(scale: float) -> Iron:
    """The vehicle's, with `scale` times the printed hard iron."""
    b = scale * HARD_IRON_MG / 1e3
    return Iron(SOFT_IRON, b, GYRO_BIAS_RAD_S, field_n_gauss(), offset_behind_iron=True)


def raw_error_deg(scale: float) -> float:
    """Standard deviation of the raw heading's error on the survey, level and without noise."""
    survey, iron = Survey.at(1.0), iron_of(scale)
    R_nb = so3.from_yaw_pitch_roll(survey.heading_rad, *np.zeros((2, len(survey.time_s))))
    field_b = np.einsum("nji,j->ni", R_nb, iron.field_n_gauss)
    up = np.tile([0.0, 0.0, -1.0], (len(R_nb), 1))
    read = field_b @ iron.soft_iron.T + iron.hard_iron_gauss
    error = wrapped(tilt_compensated_heading(read, up) - tilt_compensated_heading(field_b, up))
    return float(np.degrees(np.std(error)))


def hard_iron_scale() -> float:
    """Times the printed hard iron, so that the raw heading is wrong by 6.33 deg."""
    return float(brentq(lambda s: raw_error_deg(s) - RAW_DEG, 0.5, 3.0))


def with_accelerometer_noise(experiment: Experiment, seed: int) -> Experiment:
    """The same with the accelerometer's noise."""
    samples = experiment.samples
    noise = ACCEL_NOISE_M_S2 * generator(seed, 5).standard_normal((len(samples), 3))
    samples = replace(samples, accel_b_m_s2=samples.accel_b_m_s2 + noise)
    return replace(experiment, samples=samples)


class Dive:
    """Both experiments of one seed, the INS and the DVL, and what judges a calibration."""

    def __init__(self, seed: int, scale: float, exp1_s: float = EXP1_S) -> None:
        iron = iron_of(scale)
        time_s = np.arange(int(exp1_s * RATE_HZ * SUBSTEPS)) / (RATE_HZ * SUBSTEPS)
        self.exp1 = sensed(EXP1, iron, EXP1.angles(seed, time_s), SUBSTEPS, seed)
        survey = Survey.at(RATE_HZ * SUBSTEPS)
        self.exp2 = sensed(EXP1, iron, survey.angles(seed), SUBSTEPS, seed + 10_000)
        self.exp2 = with_accelerometer_noise(self.exp2, seed)
        self._judge(Survey.at(INS_HZ), seed)

    def _judge(self, survey: Survey, seed: int) -> None:
        samples, rng = self.exp2.samples, generator(seed, 6)
        count = len(survey.time_s)
        roll, pitch, heading = survey.angles(seed).T
        level = so3.from_yaw_pitch_roll(np.zeros(count), pitch, roll)
        v_b = np.einsum("nji,nj->ni", level, np.outer(survey.speed_m_s, [1.0, 0.0, 0.0]))
        scale = 1 + DVL_SCALE * rng.standard_normal()
        dvl = scale * v_b + DVL_BIAS_M_S * rng.standard_normal(3)
        dvl = dvl + DVL_NOISE_M_S * rng.standard_normal((count, 3))
        keep = np.exp(-1.0 / (INS_HZ * INS_CORRELATION_S))
        drift = rng.standard_normal(count) * np.sqrt(1 - keep**2)
        drift[0] = rng.standard_normal()
        self.ins_rad = heading + np.radians(INS_DEG) * lfilter([1.0], [1.0, -keep], drift)
        at = survey.time_s + samples.time_s[0]  # samples are numbered from one step on
        self.track = EvaluationTrack(
            time_s=at,
            raw_b_gauss=interpolated(at, samples.time_s, samples.raw_b_gauss),
            before_b_gauss=interpolated(at, samples.time_s, samples.raw_b_gauss),
            gyro_b_rad_s=interpolated(at, samples.time_s, samples.gyro_b_rad_s),
            accel_b_m_s2=interpolated(at, samples.time_s, samples.accel_b_m_s2),
            covariates=dict(zip(DOPPLER, dvl.T, strict=True)),
        )
        north = np.tile([1.0, 0.0, 0.0], (count, 1))
        R_ins = so3.from_yaw_pitch_roll(self.ins_rad, pitch, roll)
        self.ins_field_b = np.einsum("nji,nj->ni", R_ins, north)
        self.ins_up_b = -R_ins[:, 2, :]
        v_true = survey.speed_m_s * np.exp(1j * heading)
        v_ins = np.einsum("nij,nj->ni", R_ins, dvl)[:, :2] @ np.array([1.0, 1j])
        self.true_fixes = self._fixes(v_true, "truth")
        self.ins_fixes = self._fixes(v_ins, "INS with DVL")

    def _fixes(self, velocity: Array, source: str) -> Fixes:
        time_s = self.track.time_s
        dt_s = np.diff(time_s)
        way = np.concatenate([[0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * dt_s)])
        rows = slice(None, None, int(INS_HZ / FIXES_HZ))
        return Fixes(time_s[rows], way.real[rows], way.imag[rows], source)

    def figures(self, field_b: Array, up_b: Array) -> Said:
        """Heading and dead reckoning of a corrected field, on the INS' instants."""
        reference = HeadingReference("INS", True, self.track.time_s, self.ins_rad)
        heading = heading_figures(self.track.time_s, field_b, up_b, reference)
        out: Said = {"heading_deg": heading.rms_deg, "offset_deg": heading.offset_deg}
        velocity = velocity_of(self.track, self.true_fixes)
        for name, fixes in (("ins", self.ins_fixes), ("true", self.true_fixes)):
            found = reckoning_figures(self.track, field_b, up_b, velocity, fixes, WAY_M)
            out[f"worst_{name}_percent"] = 100 * found.worst_m / WAY_M
            out[f"final_{name}_percent"] = found.final_percent
        return out

    def of(self, soft_iron: Array, hard_iron_gauss: Array) -> Said:
        """The same of a calibration."""
        C = np.asarray(np.linalg.inv(soft_iron), dtype=np.float64)
        field_b = Affine(C, hard_iron_gauss).apply(self.track.raw_b_gauss)
        return self.figures(field_b, self.track.accel_b_m_s2)

    @property
    def without_method(self) -> dict[str, Said]:
        """Raw, with the true parameters, and by the INS' own heading: the floor."""
        truth = self.exp2.truth
        return {
            "raw": self.of(np.eye(3), np.zeros(3)),
            "true parameters": self.of(truth.soft_iron, truth.hard_iron_gauss),
            "INS heading": self.figures(self.ins_field_b, self.ins_up_b),
        }


def interpolated(at: Array, time_s: Array, values: Array) -> Array:
    """Each column of (N, 3) at the instants (M,)."""
    return np.column_stack([np.interp(at, time_s, column) for column in values.T])


METHODS: dict[str, Answering] = {
    "LS": published("magical-ls"),
    "BFG": published("magical-bfg"),
    "Ellipsoid fit": published("ellipsoid"),
    "MagFactor3": published("magfactor3"),
    "ours": OURS,
    "NLS": published("magical-nls"),
    "TWOSTEP": published("twostep"),
    "IFG": published("magical-ifg"),
}


#: calibrated on the survey the least-squares methods and graphs are refused by our own check of the
#: motion, which [R]'s do not have: they are asked without it too
ON_EXP2 = METHODS | {
    f"{name}, unchecked": unguarded(f"magical-{name.lower()}")
    for name in ("LS", "NLS", "BFG", "IFG")
}
#: minutes each on 250,000 samples: only where so many runs are asked for
SLOW_ON_EXP2, MANY = ("TWOSTEP", "NLS, unchecked", "IFG, unchecked"), 40


def scored(answering: Answering, experiment: Experiment, dive: Dive) -> Said:
    """Parameters and figures of one answer, or the failure in words; CPU seconds."""
    begun_s = time.process_time()
    try:
        found = answering(experiment)
    except (ValueError, ArithmeticError, RuntimeError) as error:  # GTSAM throws RuntimeError
        return {"failure": str(error).split("\n")[0], "cpu_s": time.process_time() - begun_s}
    out: Said = {"failure": None, "cpu_s": time.process_time() - begun_s}
    return out | told(found) | dive.of(_unit(found), _hard_iron(found))


def _unit(found: MethodAnswer) -> Array:
    A = np.eye(3) if found.soft_iron is None else found.soft_iron
    return np.asarray(A / np.cbrt(np.linalg.det(A)))


def _hard_iron(found: MethodAnswer) -> Array:
    assert found.hard_iron_gauss is not None
    return found.hard_iron_gauss


def told(found: MethodAnswer) -> Said:
    """The parameters, det A = 1, mG and mrad/s."""
    bias = found.gyro_bias_rad_s
    return {
        "a": _unit(found)[np.triu_indices(3)].tolist(),
        "m_b": (1e3 * _hard_iron(found)).tolist(),
        "w_b": None if bias is None else (1e3 * bias).tolist(),
    }


def on_exp1(seed: int, scale: float, exp1_s: float) -> Said:
    """All methods calibrated on EXP1, and the incremental graph on parts of it."""
    dive = Dive(seed, scale, exp1_s)
    out: Said = {"seed": seed, "without": dive.without_method}
    out["exp1"] = {name: scored(method, dive.exp1, dive) for name, method in METHODS.items()}
    parts = []
    for percent in PARTS[:-1]:
        first = dive.exp1.first(len(dive.exp1) * percent // 100)
        parts.append(scored(METHODS["IFG"], first, dive).get("heading_deg"))
    out["parts"] = [*parts, out["exp1"]["IFG"].get("heading_deg")]
    return out


def on_survey(seed: int, scale: float, name: str) -> Said:
    """A method calibrated on EXP2 itself."""
    dive = Dive(seed, scale, 10.0)
    return scored(ON_EXP2[name], dive.exp2, dive)


def everything(runs: int, each: Each) -> Said:
    """The dive over seeds; in short form one seed, a shorter EXP1 and no calibration on EXP2."""
    full, scale = runs > 1, hard_iron_scale()
    tasks = [(seed, scale, EXP1_S if full else SHORT_S) for seed in range(max(1, runs // 10))]
    found = each("[R] chapter 6, EXP1", on_exp1, tasks)
    names = [name for name in ON_EXP2 if full and (runs >= MANY or name not in SLOW_ON_EXP2)]
    survey = each("[R] chapter 6, EXP2", on_survey, [(0, scale, name) for name in names])
    exp2 = [dict(zip(names, survey, strict=True))] if full else []
    return {"hard_iron_scale": scale, "runs": found, "exp2": exp2}
