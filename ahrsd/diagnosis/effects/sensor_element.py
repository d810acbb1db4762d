"""Effects of the magnetometer element: gain, non-linearity, range, steps, alternating fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import (
    Clipped,
    Effect,
    Linear,
    Parameter,
    Readings,
    Setting,
    residual_gauss,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

Rows = NDArray[np.intp]

_MG = 1e-3
_USUAL_GAUSS = 0.5  # of the earth's field: parameters of non-linear terms are errors at this field
_MAINS_HZ = (50.0, 60.0, 100.0, 120.0, 400.0)
_LINES = 2
#: fractions of the sample rate at which the device's own filters and updates leave lines
_SYNCHRONOUS = (1 / 6, 1 / 5, 1 / 4, 1 / 3, 2 / 5)
_LOWEST_HZ = 0.3  # below, a line is a slow change that other effects fit as well
#: share of the turn rate's power in a band at which the vehicle turns to and fro.  Hands that draw
#: eights, walkers and shakers have .2 to .4 at their rate and its double, simulated vehicles less
#: than .1 above half a Hz; what is faster is vibration, which may come with a source's own field
_BAND_HZ, _TURNS_SHARE, _TURNS_HZ = 0.2, 0.1, 3.0
_REPEATED_SHARE = (
    0.2  # share of repeated readings from which the magnetometer is slower than the output
)


class AcInterference(Linear):
    """M7 and M8.  The frequencies are lines of the residual's spectrum; `searched` counts them."""

    identifier = "ac_interference"
    code = "M7, M8"
    family = "sensor"
    words = "an alternating field: mains, or the harmonics of a motor controller, aliased"
    equation = "m += k_c cos(2 pi f_a t) + k_s sin(2 pi f_a t), f_a = |f - n f_s|"
    parameters = (
        *design_matrix.vector("cosine", "gauss", 1.0 * _MG, 50.0 * _MG),
        *design_matrix.vector("sine", "gauss", 1.0 * _MG, 50.0 * _MG),
    )
    typical = (*design_matrix.along(1.0 * _MG), *(0.5 * _MG * part for part in (0.48, 0.6, -0.64)))
    signature = "a line in the spectrum of the innovations"
    confusers = (
        ("rotor_field", "it moves with the shaft: change the rpm"),
        (
            "hard_iron_drift",
            "50 Hz sampled at 25 Hz beats slowly: record two seconds at another rate",
        ),
    )
    manoeuvre = "record two seconds at an output rate of which 50 and 60 Hz are no multiples"
    size = "0.1 to 20 mG near machinery"
    source = "Sonett 1968 on aliases in magnetometers; diydrones (dossier M7, M8)"
    quick = True

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The two strongest lines of the residual."""
        return spectral_lines(
            residual_gauss(context), context.track.gyro_b_rad_s, context.track.dt_s
        )

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The alias of 60 Hz at this rate, or a line in the middle of the band."""
        rate_hz = 1.0 / time_series.median_step(readings.dt_s)
        alias = alias_frequency(60.0, rate_hz)
        return ({"frequency_hz": alias if alias > _LOWEST_HZ else 0.31 * rate_hz},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """cos, then sin, on each axis."""
        phase = 2 * np.pi * setting["frequency_hz"] * readings.time_s
        return Columns(mag=design_matrix.on_axes(np.column_stack([np.cos(phase), np.sin(phase)])))


class MagScaleTemperature(Linear):
    """M11: gain by temperature: of A h, of A h + b (the reading), or of h."""

    identifier = "mag_scale_temperature"
    code = "M11"
    family = "sensor"
    words = "the magnetometer's sensitivity follows temperature"
    equation = "m_i += k_i (T - T0) x_i, x = A h, A h + b or h"
    parameters = design_matrix.vector("gain_per_degree", "1/K", 1e-3, 2e-2)
    typical = (1e-3, 0.8e-3, 1.2e-3)
    needs = ("temperature",)
    signature = "the field's size drifts with the warm-up and turns with the heading"
    confusers = (
        ("geomagnetic_drift", "all headings at two temperatures"),
        ("mag_bias_temperature", "all headings at two temperatures"),
    )
    manoeuvre = "all headings cold, then all headings warm"
    size = "0.03 to 0.3 %/K where it is not compensated"
    source = "HMC5883L sheet; EGUsphere 2023-588 (dossier M11)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Per thermometer, each form."""
        return tuple(
            setting
            for of in ("field", "reading", "outside")
            for setting in design_matrix.settings_per_covariate(readings, "temperature", of=of)
        )

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """(T - T0) times the quantity that the gain acts on, per axis."""
        gained = readings.mag_b_gauss
        if setting["of"] == "field":
            gained = readings.field_b @ readings.soft_iron.T
        elif setting["of"] == "outside":
            gained = readings.field_b
        gain = design_matrix.covariate_series(readings, setting) * gained
        return Columns(mag=np.asarray(gain[:, :, None] * np.eye(3)))


class MagCrossAxis(Linear):
    """M12.  Products of the axis with its neighbours (magnetoresistive), or those of the others."""

    identifier = "mag_cross_axis"
    code = "M12"
    family = "sensor"
    words = "the element's gain depends on the field across it"
    equation = (
        "m_i += (k_i1 m_i m_j + k_i2 m_i m_k) / (0.5 G)^2, or (k_i1 m_j m_k + k_i2 m_i^2) / .."
    )
    parameters = tuple(
        Parameter(f"product_{axis}_{n}", "gauss", 1.0 * _MG, 20.0 * _MG)
        for axis in "xyz"
        for n in (1, 2)
    )
    typical = (1.5 * _MG, -1.0 * _MG, 1.2 * _MG, 0.8 * _MG, -1.0 * _MG, 1.4 * _MG)
    signature = "a second harmonic of heading that no ellipsoid has"
    confusers = (
        ("mag_nonlinearity", "pitch to 45 degrees"),
        ("mag_gyro_misalignment", "pitch to 45 degrees"),
    )
    manoeuvre = "pitch and roll to 45 degrees on all headings"
    size = "0.1 to 1 % of the field"
    source = "EGUsphere 2023-588 (dossier M12)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Which products."""
        return ({"products": "own"}, {"products": "others"})

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """Two products per axis."""
        m = readings.mag_b_gauss / _USUAL_GAUSS
        out = np.zeros((len(m), 3, 6))
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            pairs = ((i, j), (i, k)) if setting["products"] == "own" else ((j, k), (i, i))
            for n, (first, second) in enumerate(pairs):
                out[:, i, 2 * i + n] = m[:, first] * m[:, second]
        return Columns(mag=out)


class MagNonlinearity(Linear):
    """M13: a cubic term."""

    identifier = "mag_nonlinearity"
    code = "M13"
    family = "sensor"
    words = "the element's gain depends on the field along it"
    equation = "m_i += k_i (m_i / 0.5 G)^3"
    parameters = design_matrix.vector("cubic", "gauss", 1.0 * _MG, 20.0 * _MG)
    typical = (1.5 * _MG, -1.0 * _MG, 1.2 * _MG)
    signature = "grows with the third power of the reading"
    confusers = (("mag_cross_axis", "pitch to 45 degrees"),)
    manoeuvre = "all attitudes"
    size = "below 0.1 % of full scale"
    source = "dossier M13"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The cube on its axis."""
        m = readings.mag_b_gauss / _USUAL_GAUSS
        return Columns(mag=np.asarray((m**3)[:, :, None] * np.eye(3)))


class MagSaturation(Clipped):
    """M14: the range limit of the magnetometer."""

    identifier = "mag_saturation"
    code = "M14"
    family = "sensor"
    words = "the field is beyond the magnetometer's range"
    equation = "m_i = clip(m_i, -limit, limit)"
    parameters = (Parameter("limit", "gauss", 1.0, 10.0),)
    quantity = "mag_b_gauss"
    typical = (0.4,)
    signature = "flat tops in the readings"
    confusers = (("hard_iron_step", "look at the histogram of the readings"),)
    manoeuvre = "move the sensor away from the magnet"
    size = "2.5 G range of the VN-100; a magnet at 1 cm"
    source = "BROAD trial 32 (dossier M14)"


class MagQuantisation(Effect):
    """M15: coarse steps.  They act as noise on the mean, so that there are no columns."""

    identifier = "mag_quantisation"
    code = "M15"
    family = "sensor"
    words = "the readings come in coarse steps"
    equation = "m_i = q round(m_i / q); variance + q^2/12"
    parameters = (Parameter("step", "gauss", 1.0 * _MG, 0.1),)
    typical = (1.5 * _MG,)
    kind = "variance"
    after_noise = True
    signature = "a comb in the histogram of the readings"
    confusers = (("noise_level", "look at the histogram of the readings"),)
    manoeuvre = "none needed"
    size = "0.1 to 1.5 mG"
    source = "dossier M15"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """None: there is nothing to regress the readings on."""
        return ()

    def columns(self, context: Context, setting: Setting) -> Columns:
        """None."""
        return Columns()

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Rounded readings; a step of 0 rounds nothing."""
        step = float(value[0])
        if step == 0.0:
            return readings
        return replace(readings, mag_b_gauss=np.round(readings.mag_b_gauss / step) * step)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """A step of a milligauss and a half."""
        return strength * np.array(self.typical), {}


class MagSampleHold(Effect):
    """M21.  The value 1 is a magnetometer whose last value is repeated until the next update."""

    identifier = "mag_sample_hold"
    code = "M21"
    family = "sensor"
    words = "the magnetometer is updated more slowly than the output"
    equation = "m_k += f (m of the last update - m_k), f = 1: repeated readings"
    parameters = (Parameter("held_part", "1", 1.0, 3.0),)
    typical = (1.0,)
    after_noise = True
    signature = "repeated readings; a lag like a sawtooth"
    confusers = (
        ("mag_time_lag", "its mean is a lag: count the repeated readings"),
        ("stuck_magnetometer", "a stuck sensor repeats for seconds"),
    )
    manoeuvre = "choose an output rate that the magnetometer reaches"
    size = "20 to 100 ms"
    source = "driver logs (dossier M21)"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The number of repeats, where readings repeat."""
        fresh = np.any(np.diff(context.track.mag_b_gauss, axis=0) != 0, axis=1)
        if len(fresh) < 10 or np.mean(fresh) > 1 - _REPEATED_SHARE:
            return ()
        hold = round(1 / max(float(np.mean(fresh)), 1e-3))
        updates = np.flatnonzero(fresh[: 20 * hold]) + 1
        phase = int(np.bincount(updates % hold, minlength=hold).argmax()) if len(updates) else 0
        return ({"hold_samples": hold, "phase": phase},) if hold > 1 else ()

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The field of the last update minus the present field."""
        held = context.smooth_b[_last_update_rows(context.track.dt_s, setting)]
        return Columns(mag=((held - context.smooth_b) @ context.model.soft_iron.T)[:, :, None])

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """Readings of the last update, noise included."""
        m = readings.mag_b_gauss
        part, held = float(value[0]), m[_last_update_rows(readings.dt_s, setting)]
        return replace(readings, mag_b_gauss=(1 - part) * m + part * held)  # equal bit by bit at 1

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Updated every fourth sample; a higher strength is a slower update."""
        hold = max(round(4 * strength), 2)
        return np.array([min(strength, 1.0)]), {"hold_samples": hold, "phase": 0}


def alias_frequency(frequency_hz: float, rate_hz: float) -> float:
    """The frequency at which a line appears at that sample rate."""
    return abs(frequency_hz - round(frequency_hz / rate_hz) * rate_hz)


def spectral_lines(residual: Array, gyro_b_rad_s: Array, dt_s: Array) -> tuple[Setting, ...]:
    """The strongest lines of (N, 3) in the longest gap-free run, and which mains they may be.

    Lines at simple fractions of the sample rate are left out: no source outside of the device
    keeps step with the samples.  So are frequencies at which the vehicle turns to and fro, because
    whatever the model lacks repeats at that rate.
    """
    run = max(time_series.gap_free_runs(dt_s), key=lambda r: int(r.stop - r.start))
    values, step_s = residual[run] - residual[run].mean(axis=0), time_series.median_step(dt_s[run])
    if len(values) < 64 or not np.any(values):
        return ()
    window = np.hanning(len(values))[:, None]
    power = np.sum(np.abs(np.fft.rfft(values * window, 4 * len(values), axis=0)) ** 2, axis=1)
    frequency = np.asarray(np.fft.rfftfreq(4 * len(values), step_s), dtype=np.float64)
    width = 2.0 / (len(values) * step_s)
    inside = (frequency > _LOWEST_HZ) & (frequency < 0.5 / step_s - width)
    power = np.where(inside, power, 0.0)
    background = _spectral_background(power)
    power = np.divide(power, background, out=np.zeros_like(power), where=background > 0.0)
    turns = np.nan_to_num(gyro_b_rad_s[run])
    turned = np.fft.rfft((turns - turns.mean(axis=0)) * window, 4 * len(values), axis=0)
    power[_oscillating_turns(frequency, np.sum(np.abs(turned) ** 2, axis=1))] = 0.0
    found: list[Setting] = []
    for _ in range(_LINES + len(_SYNCHRONOUS)):
        at = int(np.argmax(power))
        best = float(frequency[at] + time_series.parabola_peak_offset(power, at) * frequency[1])
        mains = [
            f for f in _MAINS_HZ if abs(alias_frequency(f, 1 / step_s) - best) < width + 5e-4 * f
        ]
        if mains or min(abs(best * step_s - part) for part in _SYNCHRONOUS) > width * step_s / 4:
            found.append({"frequency_hz": best, "searched": len(values) // 2, "mains_hz": mains})
        power = np.where(np.abs(frequency - best) < 2 * width, 0.0, power)
    return tuple(found[:_LINES])


def _oscillating_turns(frequency_hz: Array, power: Array) -> NDArray[np.bool]:
    """Frequencies where the vehicle turns to and fro: a tenth of the turn's power within 0.2 Hz.

    The power must also exceed three times that of white noise in the band.
    """
    total = np.r_[0.0, np.cumsum(power)]
    low = np.searchsorted(frequency_hz, frequency_hz - _BAND_HZ / 2)
    high = np.searchsorted(frequency_hz, frequency_hz + _BAND_HZ / 2)
    share = (total[high] - total[low]) / max(float(total[-1]), 1e-300)
    noise = _BAND_HZ / float(frequency_hz[-1])
    return np.asarray((share > max(_TURNS_SHARE, 3 * noise)) & (frequency_hz < _TURNS_HZ))


def _spectral_background(power: Array) -> Array:
    """The local level of the spectrum, so that coloured noise is no line."""
    pieces = max(len(power) // 256, 1)
    level = np.array([np.median(part) for part in np.array_split(power, pieces)])
    centres = (np.arange(pieces) + 0.5) * len(power) / pieces
    usual = np.interp(np.arange(len(power)), centres, level)
    return np.asarray(np.maximum(usual, float(power.max()) * 1e-12))


def _last_update_rows(dt_s: Array, setting: Setting) -> Rows:
    """Row of the last update for each row, counted within runs."""
    out = np.empty(len(dt_s), dtype=np.intp)
    for run in time_series.gap_free_runs(dt_s):
        row = np.arange(run.stop - run.start)
        back = (row - setting["phase"]) % setting["hold_samples"]
        out[run] = run.start + np.maximum(row - back, 0)
    return out
