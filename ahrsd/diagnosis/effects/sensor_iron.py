"""Iron on the vehicle that changes: steps, drifts, soft iron, hysteresis, magnetic viscosity."""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import Linear, Readings, Setting
from ahrsd.diagnosis.model import Columns

_MG = 1e-3
#: time constants of an exponential drift, as of a vehicle that warms up
SETTLING_S = (30.0, 60.0, 120.0, 240.0)


class HardIronStep(Linear):
    """M1: a step of the hard iron."""

    identifier = "hard_iron_step"
    code = "M1"
    family = "sensor"
    words = "the hard iron jumped: a payload was moved, a magnet put on or taken off, a shock"
    equation = "m += k from t0 on"
    parameters = design_matrix.vector("step", "gauss", 10.0 * _MG, 1000.0 * _MG)
    typical = design_matrix.along(5.0 * _MG)
    signature = "one jump in the sensor frame, the same on every heading"
    confusers = (
        ("soft_iron_step", "its size turns with the heading: all headings before and after"),
        ("field_step", "it stays put in the world: turn once after the jump"),
        ("hard_iron_drift", "near an end of the recording: record longer on both sides"),
        ("switched_device", "several switchings"),
    )
    manoeuvre = "all headings before and after"
    size = "1 to 300 mG"
    source = "BROAD trials 32 to 36; retentive error (dossier M1)"
    ordinary = 1.9
    recurs = True
    jumps = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """A coarse grid of onset times."""
        return design_matrix.onset_settings(readings)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """A unit step at the onset, on each axis."""
        return Columns(mag=design_matrix.on_axes(design_matrix.after_onset(readings, setting)))


class HardIronDrift(Linear):
    """M2: linear, logarithmic or exponential in time; the parameter is the total change."""

    identifier = "hard_iron_drift"
    code = "M2"
    family = "sensor"
    words = "the hard iron drifts slowly"
    equation = (
        "m += k s, s = t / T, or ln(1 + t/t1) / ln(1 + T/t1), or "
        "(1 - exp(-t/t1)) / (1 - exp(-T/t1)); T: length of the recording"
    )
    parameters = design_matrix.vector("change", "gauss", 1.0 * _MG, 50.0 * _MG)
    typical = design_matrix.along(2.0 * _MG)
    signature = "a steady trend in the sensor frame"
    confusers = (
        ("mag_bias_temperature", "a warm-up is nearly straight in time: heat soak, or run longer"),
        ("geomagnetic_drift", "it stays put in the world: turn through all headings throughout"),
        ("hard_iron_step", "near an end of the recording"),
    )
    manoeuvre = "a longer recording with all headings throughout"
    size = "0.1 to 5 mG/h; more after a shock"
    source = "retentive error of ship's compasses (dossier M2)"
    ordinary = 12.0

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Linear; logarithmic; exponential, with time constants a factor of two apart."""
        over = design_matrix.span_setting(readings)
        return (
            {**over, "shape": "line"},
            {**over, "shape": "log", "relaxation_s": 10.0},
            *({**over, "shape": "settling", "time_constant_s": tau} for tau in SETTLING_S),
        )

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The drift from 0 to 1 on each axis."""
        part = design_matrix.elapsed_fraction(readings, setting)
        if setting["shape"] == "log":
            ratio = setting["span_s"] / setting["relaxation_s"]
            part = np.log1p(np.maximum(part, 0.0) * ratio) / np.log1p(ratio)
        elif setting["shape"] == "settling":
            ratio = setting["span_s"] / setting["time_constant_s"]
            part = np.expm1(-np.maximum(part, 0.0) * ratio) / np.expm1(-ratio)
        return Columns(mag=design_matrix.on_axes(part))


class SoftIronStep(Linear):
    """M3: a step of the soft iron."""

    identifier = "soft_iron_step"
    code = "M3"
    family = "sensor"
    words = "the soft iron changed: steel was added, removed or moved"
    equation = "m += dA h from t0 on, dA symmetric"
    parameters = design_matrix.symmetric("change", "1", 0.01, 0.3)
    typical = (0.01, -0.006, 0.004, 0.005, -0.004, 0.006)
    signature = "a jump whose size and direction turn with the heading"
    confusers = (
        ("hard_iron_step", "turn through all headings before and after"),
        ("field_step", "pitch and roll before and after"),
    )
    manoeuvre = "all headings and some pitch before and after"
    size = "0.5 to 5 %"
    source = "dossier M3"
    ordinary = 7.4
    recurs = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """A coarse grid of onset times."""
        return design_matrix.onset_settings(readings)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The symmetric matrices on the field, from the onset on."""
        on = design_matrix.after_onset(readings, setting)[:, :, None]
        return Columns(mag=design_matrix.times_symmetric(readings.field_b) * on)


class Hysteresis(Linear):
    """M16: the output of a play operator lags the field by up to its radius."""

    identifier = "hysteresis"
    code = "M16"
    family = "sensor"
    words = "hysteresis of iron near the sensor"
    equation = "m_i += k_i (play_r[(A h)_i] - (A h)_i) / r"
    # bound: three times the largest known.  In a spin the field along the axis varies only by the
    # filter's own noise, of which a width of thirty explains a part of the innovations
    parameters = design_matrix.vector("width", "gauss", 2.0 * _MG, 10.0 * _MG)
    typical = design_matrix.along(2.0 * _MG)
    signature = "the error depends on the direction of turning, not on its rate"
    confusers = (
        ("eddy_current", "change the turn's rate: eddies scale with it, hysteresis does not"),
        ("mag_time_lag", "change the turn's rate"),
        ("viscous_magnetisation", "stop after a turn and wait"),
    )
    manoeuvre = "full turns to the left and to the right, slowly and quickly"
    size = "0.1 to 3 mG"
    source = "play operator (Preisach); Bowditch on retentive error (dossier M16)"
    ordinary = 1.4
    remembers = 1.0  # one end of the slot

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Radii from the noise of a few readings to more than half of the field's usual range."""
        return tuple({"radius_gauss": radius} for radius in (0.0015, 0.006, 0.02, 0.06, 0.15))

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The lag of the play operator relative to its radius, -1 to 1, per axis."""
        induced, radius = readings.field_b @ readings.soft_iron.T, setting["radius_gauss"]
        gap = (time_series.play_operator(induced, radius, setting.get("memory")) - induced) / radius
        return Columns(mag=np.asarray(gap[:, :, None] * np.eye(3)))


class ViscousMagnetisation(Linear):
    """M18: magnetisation that follows the field with a first-order lag."""

    identifier = "viscous_magnetisation"
    code = "M18"
    family = "sensor"
    words = "iron whose magnetisation follows a turn only slowly"
    equation = "m += dA (LP_tau[h] - h), dA symmetric, LP_tau: first-order low-pass"
    parameters = design_matrix.symmetric("lagging_part", "1", 0.005, 0.1)
    typical = (0.006, 0.004, -0.003, 0.003, 0.002, -0.003)
    signature = "an offset that relaxes for 10 to 120 s after a turn"
    confusers = (
        ("eddy_current", "stop after a turn and wait"),
        ("hysteresis", "it does not relax: stop and wait"),
        ("hard_iron_drift", "several turns with pauses"),
    )
    manoeuvre = "quick quarter turns with two minutes of rest between them"
    size = "0.1 to 5 mG"
    source = "Gaussin error (dossier M18)"
    ordinary = 13.0
    remembers = 0.5  # gauss: the field along another axis

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Time constants a factor of three and a half apart."""
        return tuple({"time_constant_s": tau} for tau in (5.0, 18.0, 60.0))

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The symmetric matrices on the lagging part."""
        tau, memory = setting["time_constant_s"], setting.get("memory")
        slow = time_series.low_pass(readings.field_b, readings.dt_s, tau, memory)
        return Columns(mag=design_matrix.times_symmetric(slow - readings.field_b))
