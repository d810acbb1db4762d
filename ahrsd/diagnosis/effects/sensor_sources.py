"""Sources on the vehicle with a logged time series: currents, temperature, joints, switches.

Each is a field in the sensor frame that adds to the reading: D = e_i f(covariate).

The times of a train of short pulses are not logged: its period, phase and pulse width are searched
for (`find_pulse_trains`).  Pulses of w seconds every P seconds are lines at all multiples of 1/P
up to about 1/w, each of them too weak to be seen alone.  The sum over the multiples gives the
period; the residual folded at that period gives phase and width.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import (
    Linear,
    Readings,
    Setting,
    readings_of,
    residual_gauss,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

_MG = 1e-3
_TACHOMETER_ERROR = 1e-3  # relative error of a shaft's speed
_PERIODS_S = (0.4, 6.0)
_HIGHEST_HZ = 12.0  # pulses of 40 ms and longer
_LONGEST_S = 0.25
_PADDING = 4
_PERIODS = 4  # number of the best periods by their lines that are folded
_REFINE_STEPS = 6  # steps to either side in the refinement of a period
_BINS, _FINE_BINS = 2, 16  # per sample: for all candidates, and for the refinement of the best
_FEWEST_PERIODS = 20  # periods in a recording


class MotorCurrentField(Linear):
    """M4: a field linear in a current."""

    identifier = "motor_current_field"
    code = "M4"
    family = "sensor"
    rides = True
    words = "the magnetic field of a motor, thruster or battery current"
    equation = "m += k I(t)"
    parameters = design_matrix.vector("field_per_ampere", "gauss/A", 1.0 * _MG, 50.0 * _MG)
    typical = design_matrix.along(1.0 * _MG)
    needs = ("current",)
    signature = "follows the current in the sensor frame, the same on every heading"
    confusers = (
        ("vibration_rectification", "it acts on the gyro: pulse the motor at rest"),
        (
            "current_derivative_field",
            "it occurs only at the edges: hold the current for some seconds",
        ),
        ("mag_bias_temperature", "heat follows the load slowly: pulse the motor, then pause"),
        ("speed_field", "change the load at the same speed"),
    )
    manoeuvre = "pulse the motor at rest on one heading, then on another"
    size = "0.1 to 5 mG/A; 50 to 500 mG in the hover of small drones"
    source = "Ampere; ArduPilot #116 and PR 6448, PX4 PR 14457, inav #4820 (dossier M4)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One per logged current."""
        return design_matrix.settings_per_covariate(readings, "current")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """I on each axis."""
        return Columns(mag=design_matrix.on_axes(design_matrix.covariate_series(readings, setting)))


class CurrentDerivativeField(Linear):
    """M5: a field linear in the derivative of a current."""

    identifier = "current_derivative_field"
    code = "M5"
    family = "sensor"
    rides = True
    words = "a field that follows the change of a current: loops and eddies in the frame"
    equation = "m += k dI/dt"
    parameters = design_matrix.vector(
        "field_per_ampere_per_second", "gauss s/A", 0.1 * _MG, 10.0 * _MG
    )
    typical = design_matrix.along(0.1 * _MG)
    needs = ("current",)
    signature = "spikes at the edges of the current, of opposite sign at opposite edges"
    confusers = (
        (
            "motor_current_field",
            "a current that is logged late looks like it: record edges of both signs",
        ),
    )
    manoeuvre = "step the motor up and down at rest"
    size = "1 to 10 % of the current's own field"
    source = "preprints 202401.1460 (dossier M5)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One per logged current."""
        return design_matrix.settings_per_covariate(readings, "current")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """dI/dt on each axis."""
        change = time_series.derivative(
            design_matrix.covariate_series(readings, setting), readings.time_s, readings.dt_s
        )
        return Columns(mag=design_matrix.on_axes(change))


class SpeedField(Linear):
    """M6: a field by speed or shaft speed."""

    identifier = "speed_field"
    code = "M6"
    family = "sensor"
    rides = True
    words = "a field that follows speed or shaft speed"
    equation = "m += k f(v), f = v / 1 m/s, (v / 1 m/s)^2 or rpm / 1000"
    parameters = design_matrix.vector("field_per_unit_speed", "gauss", 0.5 * _MG, 200.0 * _MG)
    typical = design_matrix.along(1.0 * _MG)
    needs = ("speed|rpm",)
    signature = "a constant offset at constant speed, on every heading"
    confusers = (
        ("motor_current_field", "change the load at the same speed"),
        ("eddy_current", "drive straight at two speeds"),
    )
    manoeuvre = "the same straight leg at three speeds"
    size = "20 to 250 nT on underwater vehicles; 50 mG per m/s over a rover's drive motors"
    source = "Remote Sensing 15:4164 (dossier M6)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Each speed, linear and squared; each shaft in thousands of turns a minute."""
        speeds = [
            setting
            for power in (1, 2)
            for setting in design_matrix.settings_per_covariate(
                readings, "speed", power=power, unit=1.0
            )
        ]
        return (*design_matrix.settings_per_covariate(readings, "rpm", power=1, unit=1e3), *speeds)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """f(v) on each axis."""
        course = (design_matrix.covariate_series(readings, setting) / setting["unit"]) ** setting[
            "power"
        ]
        return Columns(mag=design_matrix.on_axes(course))


class SyncPulses(Linear):
    """M9: pulses of a transmitter."""

    identifier = "sync_pulses"
    code = "M9"
    family = "sensor"
    words = "pulses of a transmitter: sonar, DVL, radio"
    equation = "m += k in the samples that a pulse hits"
    parameters = design_matrix.vector("pulse", "gauss", 1.0 * _MG, 100.0 * _MG)
    typical = design_matrix.along(2.0 * _MG)
    signature = "outliers of one size in one direction, in step with the pings or with themselves"
    confusers = (
        ("switched_device", "pulses last a sample or two, a device stays on"),
        ("noise_burst", "log the ping times"),
    )
    manoeuvre = "switch the transmitter off for a minute"
    size = "0.2 to 5 mG"
    source = "dossier M9"
    quick = True

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """One per column of pulses, and the most likely regular train that is not logged."""
        track = context.track
        logged = design_matrix.settings_per_covariate(readings_of(context), "ping")
        return (*logged, *find_pulse_trains(residual_gauss(context), track.time_s, track.step_s))

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The columns of pulses; without any, 60 ms every two seconds."""
        start_s = float(readings.time_s[0])
        regular = {"start_s": start_s, "period_s": 2.0, "phase_s": 0.5, "width_s": 0.06}
        return design_matrix.settings_per_covariate(readings, "ping") or (regular,)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The pulses on each axis."""
        if "covariate" in setting:
            return Columns(
                mag=design_matrix.on_axes(design_matrix.covariate_series(readings, setting))
            )
        return Columns(mag=design_matrix.on_axes(pulse_train(readings.time_s, setting)[:, None]))


class MagBiasTemperature(Linear):
    """M10: an offset by temperature.  The setting keeps the hard iron's reference temperature."""

    identifier = "mag_bias_temperature"
    code = "M10"
    family = "sensor"
    rides = True
    words = "an offset of the magnetometer that follows temperature"
    equation = "m += k (T - T0)"
    parameters = design_matrix.vector("offset_per_degree", "gauss/K", 0.1 * _MG, 5.0 * _MG)
    typical = design_matrix.along(0.2 * _MG)
    needs = ("temperature",)
    signature = "follows the warm-up, not the heading"
    confusers = (
        ("hard_iron_drift", "a warm-up is nearly straight in time: heat soak, or a longer run"),
        ("mag_scale_temperature", "it turns with the heading: all headings at two temperatures"),
    )
    manoeuvre = "a heat soak: ten minutes at rest while it warms, then all headings again"
    size = "0.01 to 0.5 mG/K"
    source = "Sensors 19:1850 (2019), HMC5983 sheet (dossier M10)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One per logged temperature."""
        return design_matrix.settings_per_covariate(readings, "temperature")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """T - T0 on each axis."""
        return Columns(mag=design_matrix.on_axes(design_matrix.covariate_series(readings, setting)))


class MovingIron(Linear):
    """M23: a field by the angle of a joint."""

    identifier = "moving_iron"
    code = "M23"
    family = "sensor"
    words = "iron that moves on the vehicle: rudder, manipulator, turret, steering wheel"
    equation = "m += k_c cos(psi) + k_s sin(psi)"
    parameters = (
        *design_matrix.vector("cosine", "gauss", 3.0 * _MG, 100.0 * _MG),
        *design_matrix.vector("sine", "gauss", 3.0 * _MG, 100.0 * _MG),
    )
    typical = (*design_matrix.along(2.0 * _MG), *(2.0 * _MG * part for part in (0.48, 0.6, -0.64)))
    needs = ("angle",)
    signature = "follows the joint's angle in the sensor frame"
    confusers = (
        ("motor_current_field", "the actuator's current: move the joint unloaded"),
        ("eddy_current", "a rudder moves with the turn: move it at rest"),
    )
    manoeuvre = "move the joint through its range at rest on one heading"
    size = "0.5 to 50 mG"
    source = "car compass patents (dossier M23)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One per angle."""
        return design_matrix.settings_per_covariate(readings, "angle")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """cos, then sin, on each axis."""
        angle = design_matrix.covariate_series(readings, setting)[:, 0]
        if setting["covariate"].endswith("_deg"):
            angle = np.radians(angle)
        return Columns(mag=design_matrix.on_axes(np.column_stack([np.cos(angle), np.sin(angle)])))


class SwitchedDevice(Linear):
    """M24: a field by a logged switch."""

    identifier = "switched_device"
    code = "M24"
    family = "sensor"
    rides = True
    words = "a device that is switched on and off: lamp, gripper, pump"
    equation = "m += k u(t), u = 0 or 1"
    parameters = design_matrix.vector("field", "gauss", 3.0 * _MG, 200.0 * _MG)
    typical = design_matrix.along(2.0 * _MG)
    needs = ("switch",)
    signature = "jumps to and fro between two values in one direction of the sensor frame"
    confusers = (
        ("hard_iron_step", "switch it several times"),
        ("motor_current_field", "switch it with the motors off"),
    )
    manoeuvre = "switch the device several times at rest"
    size = "0.2 to 20 mG"
    source = "US20030140510, accessory interference (dossier M24)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """One per switch."""
        return design_matrix.settings_per_covariate(readings, "switch")

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The switch on each axis."""
        return Columns(mag=design_matrix.on_axes(design_matrix.covariate_series(readings, setting)))


class RotorField(Linear):
    """M25.  The sampled phase of the shaft gives the alias at the right frequency."""

    identifier = "rotor_field"
    code = "M25"
    family = "sensor"
    words = "a magnetised rotor that turns with the shaft"
    equation = "m += k_c cos(n phi) + k_s sin(n phi), dphi/dt = 2 pi rpm / 60"
    parameters = (
        *design_matrix.vector("cosine", "gauss", 1.0 * _MG, 50.0 * _MG),
        *design_matrix.vector("sine", "gauss", 1.0 * _MG, 50.0 * _MG),
    )
    typical = (*design_matrix.along(1.0 * _MG), *(1.0 * _MG * part for part in (0.48, 0.6, -0.64)))
    needs = ("rpm",)
    signature = "a line at the alias of the shaft, two axes a quarter turn apart"
    confusers = (
        ("ac_interference", "it stays at one frequency and in one direction: change the rpm"),
    )
    manoeuvre = "run the shaft slowly up through its range"
    size = "0.1 to 10 mG"
    source = "dossier M25"
    quick = True

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """The shaft and its second harmonic, each at the nearby speed that fits best.

        A tachometer is right to a few parts in a thousand, and a tenth of a turn a minute is a
        whole turn in ten minutes.
        """
        readings, left = readings_of(context), residual_gauss(context)
        found = []
        for setting in self.choices(readings):
            phase = setting["harmonic"] * _shaft_phase(readings, setting["covariate"])
            off_hz, searched = _frequency_offset(left, phase, context.track.time_s)
            found.append({**setting, "off_hz": off_hz, "searched": searched})
        return tuple(found)

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The shaft and its second harmonic."""
        return tuple(
            setting
            for harmonic in (1, 2)
            for setting in design_matrix.settings_per_covariate(readings, "rpm", harmonic=harmonic)
        )

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """cos, then sin, of the shaft's phase on each axis."""
        phase = setting["harmonic"] * _shaft_phase(readings, setting["covariate"])
        phase += 2 * np.pi * setting.get("off_hz", 0.0) * (readings.time_s - readings.time_s[0])
        return Columns(mag=design_matrix.on_axes(np.column_stack([np.cos(phase), np.sin(phase)])))


def _shaft_phase(readings: Readings, name: str) -> Array:
    """Integral of the shaft's rate by the trapezoidal rule, rad (N,)."""
    rate = readings.covariates[name] * 2 * np.pi / 60.0
    step = np.diff(readings.time_s) * (rate[1:] + rate[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(step)])


def _frequency_offset(residual: Array, phase: Array, time_s: Array) -> tuple[float, int]:
    """Offset in Hz of a line in (N, 3) from the phase (N,), and the number of offsets tried."""
    since, cycles = time_s - time_s[0], (phase[-1] - phase[0]) / (2 * np.pi)
    reach = max(1, int(np.ceil(2 * _TACHOMETER_ERROR * cycles)))
    off_hz = np.arange(-reach, reach + 1) / (2 * max(since[-1], 1e-9))
    turned = residual * np.exp(-1j * phase)[:, None]
    starts = np.arange(0, len(since), max(1, len(since) // (16 * (reach + 1))))
    sums, middle = np.add.reduceat(turned, starts), since[starts]
    power = np.sum(np.abs(np.exp(-2j * np.pi * np.outer(off_hz, middle)) @ sums) ** 2, axis=1)
    best = int(np.argmax(power))
    return float(off_hz[best]) + time_series.parabola_peak_offset(power, best) * float(
        off_hz[1] - off_hz[0]
    ), reach + 1


def find_pulse_trains(residual: Array, time_s: Array, step_s: float) -> tuple[Setting, ...]:
    """The most likely train of pulses in (N, 3); empty where the recording is too short for one."""
    start_s, span_s = float(time_s[0]), float(time_s[-1] - time_s[0])
    longest_s = min(_PERIODS_S[1], span_s / _FEWEST_PERIODS)
    if longest_s < 2 * _PERIODS_S[0] or len(time_s) < 256:
        return ()
    time_s = time_s - start_s
    fast = _high_pass(residual, round(0.5 / step_s))
    periods, tried = _candidate_periods(fast, step_s, span_s, longest_s)
    best = max(
        (_best_folded_window(fast, time_s, period_s, step_s, _BINS) for period_s in periods),
        key=lambda found: found[0],
    )
    for reach in (1.0, 1.0 / _REFINE_STEPS):
        shift = reach * best[1] ** 2 / (_PADDING * span_s * _HIGHEST_HZ) / _REFINE_STEPS
        near = best[1] + shift * np.arange(-_REFINE_STEPS, _REFINE_STEPS + 1)
        folded = (_best_folded_window(fast, time_s, float(p), step_s, _FINE_BINS) for p in near)
        best = max(folded, key=lambda found: found[0])
    _, period_s, phase_s, width_s = best
    return (
        {
            "start_s": start_s,
            "period_s": round(period_s, 7),
            "phase_s": round(phase_s, 5),
            "width_s": round(width_s, 5),
            "searched": tried * round(_FINE_BINS * period_s / step_s),
        },
    )


def pulse_train(time_s: Array, setting: Setting) -> Array:
    """1 in the samples that a pulse hits, else 0, (N,)."""
    since = (time_s - setting["start_s"] - setting["phase_s"]) % setting["period_s"]
    return np.where(since < setting["width_s"], 1.0, 0.0)


def _high_pass(residual: Array, width: int) -> Array:
    """(N, 3) less its moving mean over `width` samples."""
    total = np.vstack([np.zeros(3), np.cumsum(residual - residual.mean(axis=0), axis=0)])
    rows = np.arange(len(residual))
    first, last = np.maximum(rows - width // 2, 0), np.minimum(rows + width // 2 + 1, len(rows))
    return np.asarray(
        residual - residual.mean(axis=0) - (total[last] - total[first]) / (last - first)[:, None]
    )


def _candidate_periods(
    fast: Array, step_s: float, span_s: float, longest_s: float
) -> tuple[Array, int]:
    """The periods whose multiples hold most power, and the number of periods tried."""
    count = len(fast)
    power = np.sum(np.abs(np.fft.rfft(fast, _PADDING * count, axis=0)) ** 2, axis=1)
    spacing_hz = 1.0 / (_PADDING * count * step_s)
    top_hz = min(_HIGHEST_HZ, 0.45 / step_s)
    pieces = np.array_split(power, max(len(power) // 512, 1))
    usual = np.repeat([max(float(np.median(part)), 1e-300) for part in pieces], [*map(len, pieces)])
    power = np.minimum(power / usual, 50.0)  # a single line is no train, however strong
    base_hz = np.arange(1.0 / longest_s, 1.0 / _PERIODS_S[0], 1.0 / (_PADDING * span_s * top_hz))
    score, lines = np.zeros(len(base_hz)), np.floor(top_hz / base_hz)
    for multiple in range(1, int(lines.max()) + 1):
        at = np.rint(multiple * base_hz / spacing_hz).astype(np.intp)
        inside = multiple <= lines
        score[inside] += power[at[inside]]
    score = (score - lines * power.mean()) / np.sqrt(np.maximum(lines, 1.0))
    found = []
    for _ in range(_PERIODS):
        best = int(np.argmax(score))
        found.append(1.0 / base_hz[best])
        score[np.abs(base_hz - base_hz[best]) < 2.0 / span_s] = -np.inf
    return np.array(found), len(base_hz)


def _best_folded_window(
    fast: Array, time_s: Array, period_s: float, step_s: float, fine: int
) -> tuple[float, float, float, float]:
    """The window of most power in the folded residual: (power, period, its phase, its width).

    fine: bins per sample.  A pulse is at least a sample long, or it would fit a few outliers only
    """
    bins = max(8, round(fine * period_s / step_s))
    at = np.minimum((time_s % period_s / period_s * bins).astype(np.intp), bins - 1)
    count = np.bincount(at, minlength=bins).astype(float)
    sums = np.stack([np.bincount(at, weights=axis, minlength=bins) for axis in fast.T])
    # two periods, so that a window may extend over the period's end
    many = np.concatenate([[0.0], np.cumsum(np.tile(count, 2))])
    much = np.concatenate([np.zeros((3, 1)), np.cumsum(np.tile(sums, 2), axis=1)], axis=1)
    best = (-1.0, period_s, 0.0, 0.0)
    for width in range(fine, max(fine + 1, round(_LONGEST_S * bins / period_s)) + 1):
        ends = slice(width, width + bins)
        hit = np.maximum(many[ends] - many[:bins], 1.0)
        squares = much[:, ends] - much[:, :bins]
        squares *= squares  # in place: this takes most of the time of a search at the recorded rate
        power = (squares[0] + squares[1] + squares[2]) / hit
        k = int(np.argmax(power))
        if power[k] > best[0]:
            wide = period_s / bins
            best = (float(power[k]), period_s, float(k * wide), float(width * wide))
    return best
