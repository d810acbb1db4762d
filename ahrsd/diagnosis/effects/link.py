"""Effects of clocks, links, firmware and operators, and of the sensors' noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import (
    Discrete,
    Effect,
    Linear,
    Parameter,
    Readings,
    Scatter,
    Setting,
    readings_of,
    rowwise_readings_of,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

_MG = 1e-3
_DEG = np.pi / 180
_CONVERGED_S = (20.0, 60.0, 180.0)  # time constants of a compensation on board


class ClockRate(Linear):
    """C1: the sample clock against the gyro's."""

    identifier = "clock_rate"
    code = "C1"
    family = "link"
    words = "the sample clock runs fast or slow against the gyro's"
    equation = "w += e w, the same on all axes"
    parameters = (Parameter("rate_error", "1", 2e-3, 0.1),)
    typical = (3e-3,)
    signature = "a gyro scale that is the same on all axes"
    confusers = (("gyro_scale", "compare with the host's time"),)
    manoeuvre = "full turns about each axis; compare device time with host time"
    size = "20 ppm for a crystal, 1 % for a resonator"
    source = "dossier C1"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms, from rates that lack the noise of their own row."""
        return self.terms(rowwise_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The rate."""
        return Columns(gyro=readings.rate_b_rad_s[:, :, None])


class TimestampJitter(Scatter):
    """C2: jitter of the time stamps, not of the samples."""

    identifier = "timestamp_jitter"
    code = "C2"
    family = "link"
    words = "the time stamps jitter: they are the host's, not the device's"
    equation = "variance of m += sigma_t^2 (A dh/dt)_i^2"
    parameters = (Parameter("jitter", "s", 5e-3, 0.1),)
    typical = (5e-3,)
    signature = "scatter that grows with the rate of turn"
    confusers = (
        ("noise_level", "rest, then turn"),
        ("dropped_samples", "look at the device's counter"),
    )
    manoeuvre = "rest, then turn briskly"
    size = "1 to 20 ms on a loaded host"
    source = "dossier C2"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Normal errors of the stamps, limited so that time increases."""
        draw = np.random.default_rng(setting["seed"]).standard_normal(len(readings.time_s))
        most = 0.45 * time_series.median_step(readings.dt_s)
        time_s = readings.time_s + np.clip(float(value[0]) * draw, -most, most)
        step = np.concatenate([[np.nan], np.diff(time_s)])
        return replace(
            readings, time_s=time_s, dt_s=np.where(np.isnan(readings.dt_s), np.nan, step)
        )

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Five milliseconds."""
        return strength * np.array(self.typical), {"seed": 1}


class NoiseBurst(Scatter):
    """N1: a higher noise level for some seconds."""

    identifier = "noise_burst"
    code = "N1"
    family = "link"
    words = "a burst of magnetic noise"
    equation = "variance of m += sigma^2 from t0 for L"
    parameters = (Parameter("burst", "gauss", 5 * _MG, 1.0),)
    typical = (8 * _MG,)
    signature = "for a while large scatter, in no particular direction"
    confusers = (
        ("field_anomaly", "pass the place again"),
        ("sync_pulses", "log the ping times"),
    )
    manoeuvre = "find out what was running then"
    size = "1 to 100 mG"
    source = "dossier N1"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Normal noise within the burst."""
        draw = np.random.default_rng(setting["seed"]).standard_normal(readings.mag_b_gauss.shape)
        noise = float(value[0]) * draw * _inside_interval(readings.time_s, setting)[:, None]
        return replace(readings, mag_b_gauss=readings.mag_b_gauss + noise)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """A tenth of the recording, in its middle."""
        length = round(0.1 * float(readings.time_s[-1] - readings.time_s[0]), 3)
        onset = design_matrix.middle_s(readings)
        return strength * np.array(self.typical), {"onset_s": onset, "length_s": length, "seed": 1}


class NoiseLevel(Scatter):
    """N1: a higher noise level from a time on."""

    identifier = "noise_level"
    code = "N1"
    family = "link"
    words = "the sensors are noisier than specified"
    equation = "variance of m += sigma_m^2, of w += sigma_w^2, from t0 on"
    parameters = (
        Parameter("mag", "gauss", 1 * _MG, 0.1),
        Parameter("gyro", "rad/s", 1e-3, 0.1),
    )
    typical = (2 * _MG, 2e-3)
    signature = "innovations larger than their bounds, white and without direction"
    confusers = (
        ("timestamp_jitter", "rest, then turn"),
        ("mag_quantisation", "look at the histogram of the readings"),
    )
    manoeuvre = "rest with everything off, then on"
    size = "two to five times the data sheet's"
    source = "dossier N1"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Normal noise on both sensors."""
        rng = np.random.default_rng(setting["seed"])
        on = design_matrix.after_onset(readings, setting)
        mag, gyro = (rng.standard_normal(readings.mag_b_gauss.shape) * on for _ in range(2))
        return replace(
            readings,
            mag_b_gauss=readings.mag_b_gauss + float(value[0]) * mag,
            gyro_b_rad_s=readings.gyro_b_rad_s + float(value[1]) * gyro,
        )

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """From the first sample on."""
        return strength * np.array(self.typical), {
            "onset_s": float(readings.time_s[0]),
            "seed": 1,
        }


class DroppedSamples(Discrete):
    """C3: lost samples."""

    identifier = "dropped_samples"
    code = "C3"
    family = "link"
    words = "samples are missing, and with them the rotation during their steps"
    equation = "rows left out; the gyro's mean of the last step is used for the longer one"
    parameters = (Parameter("part", "1", 0.02, 0.9),)
    typical = (0.02,)
    after_noise = True
    signature = "single spikes of about w dt times the field"
    confusers = (("timestamp_jitter", "look at the device's counter"),)
    manoeuvre = "a slower output, a faster port"
    size = "0.1 to 5 % on a full link"
    source = "dossier C3"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The remaining rows; the first is always kept."""
        draw = np.random.default_rng(setting["seed"]).random(len(readings.time_s))
        draw[0] = 1.0
        return time_series.select_rows(readings, draw >= float(value[0]))

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Two in a hundred."""
        return np.minimum(strength * np.array(self.typical), 0.5), {"seed": 1}


class StuckMagnetometer(Discrete):
    """C3: one reading is repeated."""

    identifier = "stuck_magnetometer"
    code = "C3"
    family = "link"
    words = "the magnetometer repeats one reading"
    equation = "m_k = m of t0, from t0 for L"
    parameters = (Parameter("length", "s", 5.0, 1e6),)
    typical = (5.0,)
    after_noise = True
    signature = "equal readings, bit by bit"
    confusers = (("mag_sample_hold", "a slow update repeats only a few samples, but all the time"),)
    manoeuvre = "switch the sensor off and on"
    size = "from one second to the rest of the recording"
    source = "dossier C3"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The reading at the onset, repeated."""
        length = float(value[0])
        stuck = _inside_interval(readings.time_s, {**setting, "length_s": length}) > 0
        if not stuck.any():
            return readings
        mag = readings.mag_b_gauss.copy()
        mag[stuck] = mag[int(np.argmax(stuck))]
        return replace(readings, mag_b_gauss=mag)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Five seconds in the middle."""
        return strength * np.array(self.typical), {"onset_s": design_matrix.middle_s(readings)}


class FrameError(Discrete):
    """H1: one of the 48 signed permutations, between the gyro's axes and the magnetometer's."""

    identifier = "frame_error"
    code = "H1"
    family = "link"
    words = "axes are swapped, a sign is wrong, or a frame is left-handed"
    equation = "w_i = s_i w_(p(i))"
    parameters = (Parameter("present", "1", 1.0, 2.0),)
    typical = (1.0,)
    after_noise = True
    signature = "nothing fits at any time"
    confusers = (("unit_error", "try both: one of 48 frames, one of a few factors"),)
    manoeuvre = "turn about one axis at a time"
    size = "present or not"
    source = "dossier H1"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The gyro's axes permuted, then signed, where the value is not 0."""
        if not value[0]:
            return readings
        gyro = readings.gyro_b_rad_s[:, setting["axes"]] * np.array(setting["signs"])
        return replace(readings, gyro_b_rad_s=gyro)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """y and z are swapped, x has the wrong sign."""
        return np.array([float(bool(strength))]), {"axes": [0, 2, 1], "signs": [-1, 1, 1]}


class UnitError(Discrete):
    """H2: a wrong unit of the gyro."""

    identifier = "unit_error"
    code = "H2"
    family = "link"
    words = "a unit is wrong: degrees for radians"
    equation = "w *= 1 + e"
    parameters = (Parameter("factor_less_one", "1", 57.0, 100.0),)
    typical = (1 / _DEG - 1,)
    after_noise = True
    signature = "nothing fits at any time"
    confusers = (
        ("frame_error", "try both: one of 48 frames, one of a few factors"),
        ("gyro_scale", "a scale is off by percents, a unit by 57.3"),
    )
    manoeuvre = "one full turn"
    size = "57.3, or 1/57.3"
    source = "dossier H2"

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The gyro times the factor."""
        return replace(readings, gyro_b_rad_s=readings.gyro_b_rad_s * (1 + float(value[0])))

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Degrees for radians, at any strength."""
        return float(bool(strength)) * np.array(self.typical), {}


class OnboardCalibrationActive(Effect):
    """F1: the reading moves from raw to the device's own correction (1 + gain) C (m - b).

    gain: the corrected reading has the size of the device's reference field, not of the raw one.
    """

    identifier = "onboard_calibration_active"
    code = "F1"
    family = "link"
    words = "the device's own hard and soft iron compensation is running and applied"
    equation = (
        "m += s(t) (k (h - m) + g h), h = A^-1 (m - b), s ~ 1 - exp(-(t - t0)/tau), 1 at the end"
    )
    # a compensation removes hard iron: less than a hundredth of it, or an increase, is a drift
    parameters = (Parameter("part", "1", 1.0, 2.0, least=0.01), Parameter("gain", "1", 0.1, 0.5))
    typical = (0.8, 0.0)
    frame = "sensor"
    signature = "hard and soft iron creep or jump without an external cause"
    confusers = (
        ("hard_iron_drift", "read register 44"),
        ("soft_iron_step", "read register 44"),
    )
    manoeuvre = "read registers 44 and 47; switch the compensation off"
    size = "the whole of the hard iron within a minute"
    source = "VN-100 registers 44 and 47 (dossier F1)"
    ordinary = 3.5

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """From the first sample on, slowly or quickly, or from a later time."""
        readings = readings_of(context)
        first = float(readings.time_s[0])
        return tuple(
            {**onset, "time_constant_s": tau}
            for onset in ({"onset_s": first}, *design_matrix.onset_settings(readings)[::2])
            for tau in _CONVERGED_S
        )

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The corrected reading minus the raw one, and the corrected reading."""
        readings = readings_of(context)
        corrected = _fully_corrected(readings)
        both = np.stack([corrected - readings.mag_b_gauss, corrected], axis=2)
        return Columns(mag=_convergence(readings, setting)[:, None, None] * both)

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """A convergence with a time constant, as of a filter that sees more and more attitudes."""
        part, gain = value
        corrected = _fully_corrected(readings)
        change = part * (corrected - readings.mag_b_gauss) + gain * corrected
        change *= _convergence(readings, setting)[:, None]
        return replace(readings, mag_b_gauss=readings.mag_b_gauss + change)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """From a quarter of the recording on, within a minute."""
        first, last = float(readings.time_s[0]), float(readings.time_s[-1])
        onset = round(first + 0.25 * (last - first), 3)
        value = np.minimum(strength * np.array(self.typical), 1.0)
        return value, {"onset_s": onset, "time_constant_s": 60.0}


def _convergence(readings: Readings, setting: Setting) -> Array:
    """Progress of a filter that began at the onset, 1 at the last sample, (N,)."""
    since = np.maximum(readings.time_s - setting["onset_s"], 0.0) / setting["time_constant_s"]
    return np.asarray(np.expm1(-since) / min(np.expm1(-since[-1]), -1e-6))


def _fully_corrected(readings: Readings) -> Array:
    """(N, 3) gauss, the readings with all of hard and soft iron corrected."""
    induced = readings.field_b @ readings.soft_iron.T
    hard_iron = np.mean(readings.mag_b_gauss - induced, axis=0)
    return np.linalg.solve(readings.soft_iron, (readings.mag_b_gauss - hard_iron).T).T


def _inside_interval(time_s: Array, setting: Setting) -> Array:
    """1 from the onset for the setting's length, else 0, (N,)."""
    inside = (time_s >= setting["onset_s"]) & (time_s < setting["onset_s"] + setting["length_s"])
    return np.where(inside, 1.0, 0.0)
