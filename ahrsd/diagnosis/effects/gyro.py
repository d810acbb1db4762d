"""Effects of the gyro: of the rate, and of the bias.

Of the rate: scale, axes, non-linearity, delay, integration, clipping.  Of the bias: temperature,
time, steps, vibration, start-up.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import (
    Clipped,
    Effect,
    Linear,
    Parameter,
    Readings,
    Setting,
    readings_of,
    rowwise_readings_of,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

#: the earth's rotation rate, the largest that an axis can have of it
SIDEREAL_RAD_S = 7.292e-5
_WALK_MODES = 4


class GyroScale(Linear):
    """G1: scale error per axis."""

    identifier = "gyro_scale"
    code = "G1"
    family = "gyro"
    words = "the gyro's scale factor is off"
    equation = "w_i += s_i w_i"
    parameters = design_matrix.vector("scale_error", "1", 0.005, 0.2)
    typical = (0.005, -0.004, 0.006)
    signature = "grows with the net rotation about an axis"
    confusers = (
        ("gyro_nonlinearity", "turn at two rates"),
        ("clock_rate", "the same on all axes: compare with the host's time"),
    )
    manoeuvre = "full turns about each axis"
    size = "0.05 to 1 %"
    source = "Kalibr, OpenVINS (dossier G1)"
    ordinary = 20.0

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms, from rates that lack the noise of their own row."""
        return self.terms(rowwise_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The rate on each axis."""
        return Columns(gyro=np.asarray(readings.rate_b_rad_s[:, :, None] * np.eye(3)))


class GyroNonorthogonality(Linear):
    """G2: the symmetric part of the gyro's matrix; the antisymmetric part is the misalignment."""

    identifier = "gyro_nonorthogonality"
    code = "G2"
    family = "gyro"
    words = "the gyro's axes are not at right angles"
    equation = "w += S w, S symmetric with zero diagonal"
    parameters = tuple(Parameter(f"shear_{e}", "rad", 0.003, 0.1) for e in ("xy", "xz", "yz"))
    typical = (0.003, -0.002, 0.003)
    signature = "a turn about one axis shows on another"
    confusers = (
        ("flexible_mount", "accelerate without turning"),
        ("mag_gyro_misalignment", "turn about all three axes"),
    )
    manoeuvre = "full turns about each axis"
    size = "0.05 to 0.5 %"
    source = "Kalibr, OpenVINS (dossier G2)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms, from rates that lack the noise of their own row."""
        return self.terms(rowwise_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The off-diagonal symmetric matrices on the rate."""
        return Columns(gyro=design_matrix.times_symmetric(readings.rate_b_rad_s)[:, :, 3:])


class GyroNonlinearity(Linear):
    """G9: a scale that depends on the rate of the axis, or on the magnitude of the rate."""

    identifier = "gyro_nonlinearity"
    code = "G9"
    family = "gyro"
    words = "the gyro's scale depends on the rate"
    equation = "w_i += k_i |w_i| w_i, or k_i |w| w_i"
    parameters = design_matrix.vector("per_rate", "s/rad", 0.005, 0.2)
    typical = (0.005, -0.004, 0.006)
    signature = "only at high rates"
    confusers = (("gyro_scale", "turn at two rates"),)
    manoeuvre = "full turns about each axis at two rates"
    size = "below 0.1 % of full scale"
    source = "dossier G9"
    ordinary = 6.9

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """By the rate of the axis, or by the magnitude of the rate."""
        return ({"form": "axis"}, {"form": "size"})

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms, from rates that lack the noise of their own row."""
        return self.terms(rowwise_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """|w| w on each axis."""
        rate = readings.rate_b_rad_s
        if setting["form"] == "axis":
            size = np.abs(rate)
        else:
            size = np.linalg.norm(rate, axis=1, keepdims=True)
        return Columns(gyro=np.asarray((size * rate)[:, :, None] * np.eye(3)))


class GyroGSensitivity(Linear):
    """G4: a bias linear in the specific force."""

    identifier = "gyro_g_sensitivity"
    code = "G4"
    family = "gyro"
    words = "the gyro's bias depends on acceleration and tilt"
    equation = "w += G a, a: specific force in g"
    parameters = design_matrix.matrix("per_g", "rad/s/g", 5e-4, 0.05)
    typical = (6e-4, 2e-4, 0.0, -3e-4, 4e-4, 1e-4, 0.0, 2e-4, -5e-4)
    needs = ("accel",)
    signature = "a gyro bias that follows the tilt"
    confusers = (
        ("mag_time_lag", "on small motion: brisk reversals in heading"),
        ("flexible_mount", "accelerate without turning"),
        ("vibration_rectification", "tilt at rest"),
    )
    manoeuvre = "rest in six attitudes, or pitch and roll far"
    size = "0.003 to 0.1 deg/s/g"
    source = "OpenVINS TRO 2023 (dossier G4)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting where there is an accelerometer."""
        return ({},) if design_matrix.has_accel(readings) else ()

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The specific force times a 3 x 3 matrix."""
        return Columns(gyro=design_matrix.times_matrix(design_matrix.specific_force_g(readings)))


class EarthRotation(Linear):
    """G12: a rate constant in the world; three parameters, as north may be unknown."""

    identifier = "earth_rotation"
    code = "G12"
    family = "gyro"
    words = "the earth's rotation, which the gyro measures and the field does not show"
    equation = "w += R^T omega_E"
    parameters = tuple(
        Parameter(f"rate_{e}", "rad/s", 5e-5, SIDEREAL_RAD_S) for e in ("north", "east", "down")
    )
    typical = (4.7e-5, 0.0, -5.6e-5)
    signature = "a gyro bias that is constant in the world"
    confusers = (
        ("gyro_g_sensitivity", "turn through all headings at one tilt"),
        ("field_gradient", "stay in one place"),
    )
    manoeuvre = "turn through all headings"
    size = "73 urad/s"
    source = "the sidereal day (dossier G12)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The world's axes in the sensor frame."""
        return Columns(gyro=np.swapaxes(readings.R_nb, 1, 2))


class GyroIntegration(Linear):
    """G13.  The value 1 is a gyro that reports the rate at the sample, not the mean of the step."""

    identifier = "gyro_integration"
    code = "G13"
    family = "gyro"
    words = "the gyro value is not the mean over the step"
    equation = "w_k += f (w_(k+1) - w_k) / 2, f = 1: the rate at the instant of the sample"
    parameters = (Parameter("half_steps", "1", 1.0, 4.0),)
    typical = (1.0,)
    signature = "scales with the step's length; half a sample of lag"
    confusers = (
        ("mag_time_lag", "a lag does not change with the output rate: record at two rates"),
        ("gyro_time_lag", "a lag does not change with the output rate: record at two rates"),
    )
    manoeuvre = "record at two output rates, or use the device's delta-theta output"
    size = "1e-5 to 1e-3 rad/s"
    source = "VN-100 delta-theta output (dossier G13)"
    delay = 1.0
    of_step = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The rate at the sample minus the step's mean."""
        change = time_series.instant_rate(readings) - readings.rate_b_rad_s
        return Columns(gyro=change[:, :, None])


class GyroTimeLag(Effect):
    """G15: a delay of the gyro.  Exact for rates that are constant within each step."""

    identifier = "gyro_time_lag"
    code = "G15"
    family = "gyro"
    of_whole = True
    words = "the gyro is delayed by its latency or its filter"
    equation = "w(t) = true mean rate at t - tau"
    parameters = (Parameter("lag", "s", 0.01, 0.3),)
    typical = (0.01,)
    signature = "the mirror image of a delayed magnetometer"
    confusers = (
        ("mag_time_lag", "only the difference of the two can be seen"),
        ("gyro_integration", "record at two output rates"),
    )
    manoeuvre = "none: a clock outside of the device is needed"
    size = "1 to 20 ms"
    source = "dossier G15"
    delay = -1.0
    plain = True

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """-dw/dt."""
        r = readings_of(context)
        return Columns(gyro=-time_series.derivative(r.rate_b_rad_s, r.time_s, r.dt_s)[:, :, None])

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The gyro's reading of `value` seconds ago."""
        lag_s = float(value[0])
        others = readings.gyro_b_rad_s - readings.rate_b_rad_s
        others = time_series.delayed_values(others, readings.time_s, readings.dt_s, lag_s)
        return replace(readings, gyro_b_rad_s=time_series.delayed_rate(readings, lag_s) + others)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Ten milliseconds."""
        return strength * np.array(self.typical), {}


class GyroSaturation(Clipped):
    """G10: the range limit of the gyro."""

    identifier = "gyro_saturation"
    code = "G10"
    family = "gyro"
    words = "the rate is beyond the gyro's range"
    equation = "w_i = clip(w_i, -limit, limit)"
    parameters = (Parameter("limit", "rad/s", 10.0, 100.0),)
    quantity = "gyro_b_rad_s"
    typical = (0.3,)
    signature = "flat tops in the rates"
    confusers = (("gyro_nonlinearity", "look at the histogram of the rates"),)
    manoeuvre = "turn more slowly"
    size = "2000 deg/s range of the VN-100"
    source = "dossier G10"


class GyroBiasTemperature(Linear):
    """G6: a bias linear in temperature."""

    identifier = "gyro_bias_temperature"
    code = "G6"
    family = "gyro"
    words = "the gyro bias follows temperature"
    equation = "w += k (T - T0)"
    parameters = design_matrix.vector("bias_per_degree", "rad/s/K", 2e-4, 5e-3)
    typical = design_matrix.along(2e-4)
    needs = ("temperature",)
    signature = "follows the warm-up curve"
    confusers = (
        ("gyro_bias_drift", "heat it a second time, or log longer"),
        ("gyro_startup", "switch on again while it is warm"),
    )
    manoeuvre = "at rest while it warms and cools"
    size = "0.001 to 0.05 deg/s/K"
    source = "dossier G6; the recording F00379"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One per logged temperature."""
        return design_matrix.settings_per_covariate(readings, "temperature")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """T - T0 on each axis."""
        return Columns(
            gyro=design_matrix.on_axes(design_matrix.covariate_series(readings, setting))
        )


class GyroBiasDrift(Linear):
    """G7: the largest modes of a random walk (Karhunen-Loeve), 95 % of its variance."""

    identifier = "gyro_bias_drift"
    code = "G7"
    family = "gyro"
    words = "the gyro bias drifts slowly"
    equation = "w += sum_j k_j sin((j - 1/2) pi t/T), j = 1 to 4: a random walk's largest modes"
    parameters = tuple(
        Parameter(f"mode_{j}_{axis}", "rad/s", 4e-4 / (2 * j - 1), 0.02)
        for j in range(1, _WALK_MODES + 1)
        for axis in "xyz"
    )
    typical = tuple(
        size * part
        for size, parts in (
            (4e-4, design_matrix.DIRECTION),
            (-1.3e-4, (0.48, 0.6, -0.64)),
            (0.8e-4, (-0.64, 0.48, 0.6)),
            (0.5e-4, design_matrix.DIRECTION),
        )
        for part in parts
    )
    signature = "a gyro error that varies slowly"
    confusers = (
        ("gyro_bias_temperature", "log the temperature; heat it a second time"),
        ("gyro_startup", "switch on again and compare the first minutes"),
        ("gyro_bias_step", "record longer on both sides"),
    )
    manoeuvre = "an hour at rest, for its Allan deviation"
    size = "5 to 10 deg/h"
    source = "IEEE 952 (from memory; dossier G7)"
    course = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The recording's own length."""
        return (design_matrix.span_setting(readings),)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The modes on each axis."""
        order = np.arange(1, _WALK_MODES + 1) - 0.5
        return Columns(
            gyro=design_matrix.on_axes(
                np.sin(np.pi * order * design_matrix.elapsed_fraction(readings, setting))
            )
        )


class GyroBiasStep(Linear):
    """G8: a step of the bias."""

    identifier = "gyro_bias_step"
    code = "G8"
    family = "gyro"
    words = "the gyro bias jumped: a shock, or a new zero set on board"
    equation = "w += k from t0 on"
    parameters = design_matrix.vector("step", "rad/s", 1e-3, 0.05)
    typical = design_matrix.along(1e-3)
    signature = "one jump of the gyro error"
    confusers = (
        ("gyro_bias_drift", "near an end of the recording: record longer"),
        ("vibration_rectification", "log acceleration or current"),
    )
    manoeuvre = "rest before and after"
    size = "0.005 to 0.2 deg/s"
    source = "the device's command to set the gyro bias (dossier G8)"
    recurs = True
    jumps = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """A coarse grid of onset times."""
        return design_matrix.onset_settings(readings)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """A unit step at the onset, on each axis."""
        return Columns(gyro=design_matrix.on_axes(design_matrix.after_onset(readings, setting)))


class GyroStartup(Linear):
    """G14: a decay after power-on, which is taken to be the first sample."""

    identifier = "gyro_startup"
    code = "G14"
    family = "gyro"
    words = "the gyro bias settles after power-on"
    equation = "w += k exp(-t / tau)"
    parameters = design_matrix.vector("at_start", "rad/s", 1e-3, 0.02)
    typical = design_matrix.along(1e-3)
    signature = "the gyro error dies away in the first minutes"
    confusers = (
        ("gyro_bias_temperature", "switch on again while it is warm"),
        ("gyro_bias_drift", "switch on again and compare the first minutes"),
    )
    manoeuvre = "switch off for a second and on again while warm"
    size = "0.01 to 0.1 deg/s"
    source = "dossier G14"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Time constants a factor of three apart."""
        start = {"start_s": float(readings.time_s[0])}
        return tuple({**start, "time_constant_s": tau} for tau in (20.0, 60.0, 180.0))

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The exponential decay on each axis."""
        elapsed = (readings.time_s - setting["start_s"]) / setting["time_constant_s"]
        return Columns(gyro=design_matrix.on_axes(np.exp(-elapsed)[:, None]))


class VibrationRectification(Linear):
    """G5: a bias by vibration power, normalised to its mean, so that the parameter is a rate."""

    identifier = "vibration_rectification"
    code = "G5"
    family = "gyro"
    words = "vibration shifts the gyro bias"
    equation = "w += k v(t), v: variance of the acceleration, I^2, or rpm^2, over its mean"
    parameters = design_matrix.vector("bias_at_mean", "rad/s", 5e-4, 0.02)
    typical = design_matrix.along(5e-4)
    needs = ("accel|current|rpm",)
    signature = "the gyro bias jumps with the motors"
    confusers = (
        ("motor_current_field", "it acts on the magnetometer: pulse the motor at rest"),
        ("gyro_g_sensitivity", "tilt at rest with the motors off"),
        ("gyro_bias_step", "switch the motor several times"),
    )
    manoeuvre = "run the motor at rest in steps"
    size = "0.001 to 0.1 deg/s"
    source = "diydrones on aliasing (dossier G5)"
    ordinary = 0.6

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Variance of the acceleration over a second; square of each current and shaft speed."""
        found: list[Setting] = []
        if (
            design_matrix.has_accel(readings)
            and float(np.mean(_vibration_power(readings, 1.0))) > 0.0
        ):
            mean = float(np.mean(_vibration_power(readings, 1.0)))
            found.append({"covariate": "accel", "window_s": 1.0, "mean": mean})
        for role in ("current", "rpm"):
            for name in roles.usable_columns(readings.covariates, role):
                mean = float(np.mean(readings.covariates[name] ** 2))
                found.append({"covariate": name, "mean": mean})
        return tuple(found)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The normalised vibration power on each axis."""
        if setting["covariate"] == "accel":
            vibration = _vibration_power(readings, setting["window_s"])
        else:
            vibration = readings.covariates[setting["covariate"]] ** 2
        return Columns(gyro=design_matrix.on_axes(np.asarray(vibration / setting["mean"])[:, None]))


def _vibration_power(readings: Readings, window_s: float) -> Array:
    """Variance (N,) in g^2 of the specific force about its mean over the window, all axes."""
    rows = max(round(window_s / time_series.median_step(readings.dt_s)), 3)
    total = np.zeros(len(readings.time_s))
    for axis in readings.accel_b_m_s2.T / design_matrix.GRAVITY_M_S2:
        slow = time_series.moving_mean(axis, readings.dt_s, rows)
        total += time_series.moving_mean((axis - slow) ** 2, readings.dt_s, rows)
    return total
