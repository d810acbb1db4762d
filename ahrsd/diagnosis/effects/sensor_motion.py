"""Effects of motion on the magnetometer: lag, filters, eddy currents, mount, misalignment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import (
    Effect,
    Linear,
    Parameter,
    Readings,
    Setting,
    readings_of,
    smooth_readings_of,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array


class EddyCurrent(Linear):
    """M17: a field linear in the field's rate of change."""

    identifier = "eddy_current"
    code = "M17"
    family = "sensor"
    words = "eddy currents in hull or housing"
    equation = "m += E dh/dt, dh/dt = h x w"
    parameters = design_matrix.matrix("eddy", "s", 0.01, 0.2)
    typical = (0.01, 0.002, 0.0, -0.003, 0.008, 0.001, 0.0, 0.002, 0.014)
    signature = "proportional to the turn's rate, changes sign with its direction"
    confusers = (
        (
            "mag_time_lag",
            "contains it (E = -tau A): reported as a lag if it is the same about all axes",
        ),
        ("hysteresis", "two rates of turn"),
        ("viscous_magnetisation", "stop after a turn and wait"),
    )
    manoeuvre = "turns about all three axes at two rates"
    size = "0.1 to 20 mG at 0.5 rad/s near plates of aluminium or titanium"
    source = "eddy block of Tolles and Lawson (dossier M17)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The field's derivative times a 3 x 3 matrix."""
        return Columns(mag=design_matrix.times_matrix(time_series.field_dot(readings)))


class MagTimeLag(Effect):
    """M19: a delay of the magnetometer.  Exact: the true field is turned back along the steps.

    All else that the magnetometer reads is delayed by interpolation.
    """

    identifier = "mag_time_lag"
    code = "M19"
    family = "sensor"
    of_whole = True
    words = "the magnetometer is delayed against the gyro"
    equation = "m(t) = A h(t - tau) + b"
    parameters = (Parameter("lag", "s", 0.02, 0.3),)
    typical = (0.02,)
    signature = "acts like a gyro error of tau dw/dt: seen only in angular acceleration"
    confusers = (
        ("gyro_time_lag", "only the difference of the two can be seen"),
        ("gyro_integration", "half a sample: use the device's delta-theta output"),
        ("eddy_current", "turn about all axes: a lag is the same about all axes"),
        ("mag_low_pass", "two rates of turn"),
        ("gyro_g_sensitivity", "on small motion: brisk reversals in heading"),
    )
    manoeuvre = "brisk reversals in heading"
    size = "1 to 60 ms; EKF3 corrects 60 ms"
    source = "ArduPilot #15899 (dossier M19)"
    delay = 1.0
    plain = True

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """-A dh/dt."""
        readings = readings_of(context)
        change = time_series.field_dot(readings) @ readings.soft_iron.T
        return Columns(mag=-change[:, :, None])

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The magnetometer's reading of `value` seconds ago."""
        lag_s = float(value[0])
        delay_s = np.full(len(readings.time_s), lag_s)
        field = time_series.delayed_field(readings, delay_s) @ readings.soft_iron.T
        others = readings.mag_b_gauss - readings.field_b @ readings.soft_iron.T
        others = time_series.delayed_values(others, readings.time_s, readings.dt_s, lag_s)
        return replace(readings, mag_b_gauss=field + others)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Twenty milliseconds."""
        return strength * np.array(self.typical), {}


class MagLowPass(Linear):
    """M20.  Linear in its parameter; exactly the filter where the delay equals the setting."""

    identifier = "mag_low_pass"
    code = "M20"
    family = "sensor"
    of_whole = True
    words = "the magnetometer is smoothed by a low-pass"
    equation = "m += (tau / tau0) A (LP_tau0[h] - h); tau = tau0 is the filter itself"
    parameters = (Parameter("time_constant", "s", 0.03, 0.3),)
    typical = (0.03,)
    signature = "a lag, and a loss of field in fast turns"
    confusers = (
        ("mag_time_lag", "two rates of turn: the loss grows with the square of the rate"),
        ("gyro_time_lag", "two rates of turn"),
        ("mag_sample_hold", "look for repeated readings"),
    )
    manoeuvre = "shake the heading at several rates"
    size = "5 to 50 ms"
    source = "studies of telephones' magnetometer filters (dossier M20)"
    delay = 1.0
    filters = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Time constants a factor of three apart."""
        return tuple({"time_constant_s": tau} for tau in (0.03, 0.1, 0.3))

    def columns(self, context: Context, setting: Setting) -> Columns:
        """The terms, from the smoothed field."""
        return self.terms(smooth_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """What the filter removes, per second of its time constant."""
        tau0 = setting["time_constant_s"]
        field_b, time_s, dt_s = readings.field_b, readings.time_s, readings.dt_s
        change = time_series.low_pass_cubic(field_b, time_s, dt_s, tau0) - field_b
        others = readings.mag_b_gauss - field_b @ readings.soft_iron.T
        change = change @ readings.soft_iron.T + time_series.low_pass(others, dt_s, tau0) - others
        return Columns(mag=np.asarray(change / tau0)[:, :, None])

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """The exact filter, of `strength` times 30 ms."""
        value = strength * np.array(self.typical)
        return value, {"time_constant_s": float(max(value[0], 1e-6))}


class FlexibleMount(Effect):
    """M22.  Exact: a rotation by C (a - a0).

    A mount is straight without a load, or under the mean load under which it was aligned.  The two
    differ by a constant rotation, which looks like a gyro misalignment if the model has no a0.
    """

    identifier = "flexible_mount"
    code = "M22"
    family = "sensor"
    words = "the magnetometer's mount bends under its weight and acceleration"
    equation = "m = A Exp(C (a - a0)) h + b, a: specific force in g, a0: where it is straight"
    parameters = design_matrix.matrix("bend", "rad/g", 0.01, 0.2)
    typical = (0.0, 0.008, 0.002, -0.009, 0.0, 0.001, 0.002, -0.003, 0.0)
    needs = ("accel",)
    signature = "the error follows tilt and thrust"
    confusers = (
        ("mag_gyro_misalignment", "level, the weight is constant: pitch and roll far"),
        ("gyro_g_sensitivity", "accelerate without turning"),
        ("gyro_nonorthogonality", "accelerate without turning"),
    )
    manoeuvre = "pitch and roll to 45 degrees, upside down if it can be"
    size = "0.1 to 2 degrees"
    source = "dossier M22"
    ordinary_part = "bending"
    # C = c I turns about the specific force, which at rest is the vertical: Exp(c g_b) R^T h is
    # R^T (Exp(c g_n) h): another constant field in the world, which is unknown anyway
    unseen = (tuple(np.eye(3).ravel() / np.sqrt(3.0)),)

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """Straight without a load or under the mean load, where there is an accelerometer."""
        if context.track.accel_b_m_s2 is None:
            return ()
        mean_g = np.mean(design_matrix.specific_force_g(readings_of(context)), axis=0)
        mean = [round(float(one), 4) for one in mean_g]
        return {}, {"straight_g": mean}

    def columns(self, context: Context, setting: Setting) -> Columns:
        """A ((C (a - a0)) x h)."""
        readings = readings_of(context)
        force = _load_g(readings, setting)
        turn = readings.soft_iron @ design_matrix.cross_columns(readings.field_b)  # (N, 3, 3)
        return Columns(mag=np.einsum("nka,nb->nkab", turn, force).reshape(len(force), 3, 9))

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The field as measured on the bent mount."""
        bend = _load_g(readings, setting) @ value.reshape(3, 3).T
        return replace_field(readings, np.einsum("nij,nj->ni", so3.exp(bend), readings.field_b))

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """About half a degree per g."""
        if not design_matrix.has_accel(readings):
            raise ValueError(f"{self.identifier} needs an accelerometer")
        return strength * np.array(self.typical), {}


def _load_g(readings: Readings, setting: Setting) -> Array:
    """(N, 3) specific force less that under which the mount is straight, g."""
    straight_g = np.array(setting.get("straight_g", np.zeros(3)), dtype=np.float64)
    return np.asarray(design_matrix.specific_force_g(readings) - straight_g)


class MagGyroMisalignment(Effect):
    """G3.  Exact: the magnetometer's field is rotated by phi."""

    identifier = "mag_gyro_misalignment"
    code = "G3"
    family = "gyro"
    turns_sensors = True
    words = "magnetometer and gyro are not aligned"
    equation = "m = A Exp(phi) h + b; the same as a soft iron that is not symmetric"
    parameters = design_matrix.vector("angle", "rad", 0.01, 0.35)
    typical = design_matrix.along(0.02)
    signature = "an error that depends on the attitude; a symmetric soft iron cannot represent it"
    confusers = (
        ("flexible_mount", "pitch and roll far, upside down if it can be"),
        ("mag_cross_axis", "pitch to 45 degrees"),
        ("gyro_nonorthogonality", "turn about all three axes"),
    )
    manoeuvre = "turns about all three axes"
    size = "0.05 degrees within a device, up to 3 where the sensors are mounted apart"
    source = "Kok and Schon 2016, arXiv 1612.01044 (dossier G3)"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """One empty setting: no non-linear choice."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """A (phi x h)."""
        return Columns(mag=context.model.soft_iron @ design_matrix.cross_columns(context.field_b))

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """The field rotated by Exp(phi)."""
        return replace_field(readings, readings.field_b @ so3.exp(value).T)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """About a degree."""
        return strength * np.array(self.typical), {}


def replace_field(readings: Readings, field_b: Array) -> Readings:
    """The readings with another field at the sensor; all else in them is kept."""
    change = (field_b - readings.field_b) @ readings.soft_iron.T
    return replace(readings, mag_b_gauss=readings.mag_b_gauss + change)
