"""What the gyro makes of a rate: scale, axes, non-linearity, delay, integration, clipping."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects import shapes
from ahrsd.diagnosis.effects.base import (
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

#: by which the earth turns among the stars: no axis has more of it
SIDEREAL_RAD_S = 7.292e-5


class GyroScale(Linear):
    """G1."""

    identifier = "gyro_scale"
    code = "G1"
    family = "gyro"
    words = "the gyro's scale factor is off"
    equation = "w_i += s_i w_i"
    parameters = shapes.vector("scale_error", "1", 0.005, 0.2)
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
        """Nothing to choose."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """Of rates without their own row's noise."""
        return self.terms(rowwise_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The rate on each axis."""
        return Columns(gyro=np.asarray(readings.rate_b_rad_s[:, :, None] * np.eye(3)))


class GyroNonorthogonality(Linear):
    """G2; the antisymmetric part is the misalignment."""

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
        """Nothing to choose."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """Of rates without their own row's noise."""
        return self.terms(rowwise_readings_of(context), setting)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The off-diagonal symmetric matrices on the rate."""
        return Columns(gyro=shapes.times_symmetric(readings.rate_b_rad_s)[:, :, 3:])


class GyroNonlinearity(Linear):
    """G9, per axis or by the size of the rate."""

    identifier = "gyro_nonlinearity"
    code = "G9"
    family = "gyro"
    words = "the gyro's scale depends on the rate"
    equation = "w_i += k_i |w_i| w_i, or k_i |w| w_i"
    parameters = shapes.vector("per_rate", "s/rad", 0.005, 0.2)
    typical = (0.005, -0.004, 0.006)
    signature = "only at high rates"
    confusers = (("gyro_scale", "turn at two rates"),)
    manoeuvre = "full turns about each axis at two rates"
    size = "below 0.1 % of full scale"
    source = "dossier G9"
    ordinary = 6.9

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The rate of the axis, or the size of the whole rate."""
        return ({"form": "axis"}, {"form": "size"})

    def columns(self, context: Context, setting: Setting) -> Columns:
        """Of rates without their own row's noise."""
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
    """G4."""

    identifier = "gyro_g_sensitivity"
    code = "G4"
    family = "gyro"
    words = "the gyro feels acceleration and tilt"
    equation = "w += G a, a: specific force in g"
    parameters = shapes.matrix("per_g", "rad/s/g", 5e-4, 0.05)
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
        """Nothing to choose, where there is an accelerometer."""
        return ({},) if shapes.has_accel(readings) else ()

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """A matrix on the specific force."""
        return Columns(gyro=shapes.times_matrix(shapes.specific_force_g(readings)))


class EarthRotation(Linear):
    """G12.  Three numbers: the attitude may be known but for a turn of the world."""

    identifier = "earth_rotation"
    code = "G12"
    family = "gyro"
    words = "the turning of the earth, which the gyro reads and the field does not show"
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
        """Nothing to choose."""
        return ({},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The world's axes in the sensor frame."""
        return Columns(gyro=np.swapaxes(readings.R_nb, 1, 2))


class GyroIntegration(Linear):
    """G13.  1 is a gyro that reports the rate at the sample in place of the step's mean."""

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
        """Nothing to choose."""
        return ({},)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """From the step's mean to the instant."""
        change = time_series.instant_rate(readings) - readings.rate_b_rad_s
        return Columns(gyro=change[:, :, None])


class GyroTimeLag(Effect):
    """G15.  Exact for rates that are constant within each step."""

    identifier = "gyro_time_lag"
    code = "G15"
    family = "gyro"
    of_whole = True
    words = "the gyro is late, by its latency or its filter"
    equation = "w(t) = true mean rate at t - tau"
    parameters = (Parameter("lag", "s", 0.01, 0.3),)
    typical = (0.01,)
    signature = "the mirror image of a late magnetometer"
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
        """Nothing to choose."""
        return ({},)

    def columns(self, context: Context, setting: Setting) -> Columns:
        """-dw/dt."""
        r = readings_of(context)
        return Columns(gyro=-time_series.derivative(r.rate_b_rad_s, r.time_s, r.dt_s)[:, :, None])

    def simulate(self, readings: Readings, value: Array, setting: Setting) -> Readings:
        """What the gyro would have read `value` seconds ago in place of the present."""
        lag_s = float(value[0])
        others = readings.gyro_b_rad_s - readings.rate_b_rad_s
        others = time_series.earlier(others, readings.time_s, readings.dt_s, lag_s)
        return replace(readings, gyro_b_rad_s=time_series.delayed_rate(readings, lag_s) + others)

    def example(self, readings: Readings, strength: float) -> tuple[Array, Setting]:
        """Ten milliseconds."""
        return strength * np.array(self.typical), {}


class GyroSaturation(Clipped):
    """G10."""

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
