"""How a gyro's bias moves: temperature, time, steps, vibration, start-up."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects import shapes
from ahrsd.diagnosis.effects.base import Linear, Parameter, Readings, Setting
from ahrsd.diagnosis.model import Columns
from ahrsd.samples import Array

_WALK_MODES = 4


class GyroBiasTemperature(Linear):
    """G6."""

    identifier = "gyro_bias_temperature"
    code = "G6"
    family = "gyro"
    words = "the gyro bias follows temperature"
    equation = "w += k (T - T0)"
    parameters = shapes.vector("bias_per_degree", "rad/s/K", 2e-4, 5e-3)
    typical = shapes.along(2e-4)
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
        """One per thermometer."""
        return shapes.per_covariate(readings, "temperature")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """T - T0 on each axis."""
        return Columns(gyro=shapes.on_axes(shapes.course_of(readings, setting)))


class GyroBiasDrift(Linear):
    """G7: the largest modes of a random walk (Karhunen-Loeve), 95 % of its variance."""

    identifier = "gyro_bias_drift"
    code = "G7"
    family = "gyro"
    words = "the gyro bias wanders"
    equation = "w += sum_j k_j sin((j - 1/2) pi t/T), j = 1 to 4: a random walk's largest modes"
    parameters = tuple(
        Parameter(f"mode_{j}_{axis}", "rad/s", 4e-4 / (2 * j - 1), 0.02)
        for j in range(1, _WALK_MODES + 1)
        for axis in "xyz"
    )
    typical = tuple(
        size * part
        for size, parts in (
            (4e-4, shapes.DIRECTION),
            (-1.3e-4, (0.48, 0.6, -0.64)),
            (0.8e-4, (-0.64, 0.48, 0.6)),
            (0.5e-4, shapes.DIRECTION),
        )
        for part in parts
    )
    signature = "a slow course of the gyro error"
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
        return (shapes.span(readings),)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The modes on each axis."""
        order = np.arange(1, _WALK_MODES + 1) - 0.5
        return Columns(
            gyro=shapes.on_axes(np.sin(np.pi * order * shapes.elapsed(readings, setting)))
        )


class GyroBiasStep(Linear):
    """G8."""

    identifier = "gyro_bias_step"
    code = "G8"
    family = "gyro"
    words = "the gyro bias jumped: a shock, or a new zero set on board"
    equation = "w += k from t0 on"
    parameters = shapes.vector("step", "rad/s", 1e-3, 0.05)
    typical = shapes.along(1e-3)
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
        """A coarse grid of times."""
        return shapes.onsets(readings)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """1 from the onset on, on each axis."""
        return Columns(gyro=shapes.on_axes(shapes.since(readings, setting)))


class GyroStartup(Linear):
    """G14; the recording's first sample counts as the start where nothing says better."""

    identifier = "gyro_startup"
    code = "G14"
    family = "gyro"
    words = "the gyro bias settles after power-on"
    equation = "w += k exp(-t / tau)"
    parameters = shapes.vector("at_start", "rad/s", 1e-3, 0.02)
    typical = shapes.along(1e-3)
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
        """The decay on each axis."""
        passed = (readings.time_s - setting["start_s"]) / setting["time_constant_s"]
        return Columns(gyro=shapes.on_axes(np.exp(-passed)[:, None]))


class VibrationRectification(Linear):
    """G5.  The course is normalised to its own mean size, so that the parameter is a rate."""

    identifier = "vibration_rectification"
    code = "G5"
    family = "gyro"
    words = "vibration shifts the gyro bias"
    equation = "w += k v(t), v: variance of the acceleration, I^2, or rpm^2, over its mean"
    parameters = shapes.vector("bias_at_mean", "rad/s", 5e-4, 0.02)
    typical = shapes.along(5e-4)
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
        """The acceleration's variance over a second, each current and each shaft squared."""
        found: list[Setting] = []
        if shapes.has_accel(readings) and float(np.mean(_shaking(readings, 1.0))) > 0.0:
            mean = float(np.mean(_shaking(readings, 1.0)))
            found.append({"covariate": "accel", "window_s": 1.0, "mean": mean})
        for role in ("current", "rpm"):
            for name in roles.named(readings.covariates, role):
                mean = float(np.mean(readings.covariates[name] ** 2))
                found.append({"covariate": name, "mean": mean})
        return tuple(found)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The vibration's course on each axis."""
        if setting["covariate"] == "accel":
            course = _shaking(readings, setting["window_s"])
        else:
            course = readings.covariates[setting["covariate"]] ** 2
        return Columns(gyro=shapes.on_axes(np.asarray(course / setting["mean"])[:, None]))


def _shaking(readings: Readings, window_s: float) -> Array:
    """Variance (N,) in g^2 of the specific force about its mean over the window, all axes."""
    rows = max(round(window_s / time_series.median_step(readings.dt_s)), 3)
    total = np.zeros(len(readings.time_s))
    for axis in readings.accel_b_m_s2.T / shapes.GRAVITY_M_S2:
        slow = time_series.moving_mean(axis, readings.dt_s, rows)
        total += time_series.moving_mean((axis - slow) ** 2, readings.dt_s, rows)
    return total
