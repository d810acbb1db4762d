"""Every effect: what makes it, its published detection limit, and what it needs.

`limit` is section 5.1's where the dossier has one (the strength between "seen in half" and "seen in
all" of its trials at 0.5 mrad/s, wide motion); a guess on the careful side for the others, marked.
A motion that shows an effect less has a larger limit: see `ideal` and `cases.limit_of`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from blind_trials.world import in_world, on_gyro, on_link, on_sensor, outside
from blind_trials.world.motion import DEG

MG = 1e-3


@dataclass(frozen=True)
class Effect:
    """One row.  name: the contract's identifier, or None where no library has it."""

    key: str
    make: Callable
    limit: float
    unit: str
    group: str | None = None  # of covariates that it needs
    name: str | None = ""  # "" is the key
    most: float = float("inf")  # physically largest strength
    scaled: bool = True  # whether `ideal` can say how visible it is
    alike: tuple[str, ...] = ()  # other identifiers for the very same signal

    @property
    def identifier(self):
        """The contract's identifier, None for what no library has."""
        return self.key if self.name == "" else self.name


_LAGS = ("mag_time_lag", "gyro_time_lag", "gyro_integration", "mag_low_pass")

_ROWS = (
    # on the sensor
    Effect("hard_iron_step", on_sensor.hard_iron_step, 0.5 * MG, "gauss"),
    Effect("hard_iron_drift", on_sensor.hard_iron_drift, 1 * MG, "gauss"),  # guess
    Effect("soft_iron_step", on_sensor.soft_iron_step, 0.003, "1"),  # guess
    Effect("motor_current_field", on_sensor.motor_current_field, 0.3 * MG, "gauss", "motor"),
    Effect("yaw_current_field", on_sensor.yaw_current_field, 0.5 * MG, "gauss", "motor",
           name="motor_current_field"),
    Effect("current_derivative_field", on_sensor.current_derivative_field, 2 * MG, "gauss",
           "motor"),  # guess
    Effect("speed_field", on_sensor.speed_field, 0.5 * MG, "gauss", "speed"),  # guess
    Effect("ac_interference", on_sensor.ac_interference, 0.4 * MG, "gauss",
           alike=("rotor_field",)),  # guess
    Effect("sync_pulses", on_sensor.sync_pulses, 2 * MG, "gauss"),  # guess
    Effect("mag_bias_temperature", on_sensor.mag_bias_temperature, 0.05 * MG, "gauss/degC",
           "temperature"),
    Effect("mag_scale_temperature", on_sensor.mag_scale_temperature, 3e-4, "1/degC",
           "temperature"),  # guess
    Effect("mag_cross_axis", on_sensor.mag_cross_axis, 1 * MG, "gauss"),  # guess
    Effect("mag_nonlinearity", on_sensor.mag_nonlinearity, 1 * MG, "gauss",
           alike=("mag_cross_axis",)),  # guess
    Effect("mag_saturation", on_sensor.mag_saturation, 0.01, "1", scaled=False, most=0.2),  # guess
    Effect("mag_quantisation", on_sensor.mag_quantisation, 4 * MG, "gauss", scaled=False),  # guess
    Effect("hysteresis", on_sensor.hysteresis, 0.5 * MG, "gauss"),
    Effect("eddy_current", on_sensor.eddy_current, 3e-3, "s"),  # guess
    Effect("viscous_magnetisation", on_sensor.viscous_magnetisation, 0.005, "1"),  # guess
    Effect("mag_time_lag", on_sensor.mag_time_lag, 2e-3, "s", alike=_LAGS, most=0.1),
    Effect("mag_low_pass", on_sensor.mag_low_pass, 5e-3, "s", alike=_LAGS, most=0.1),  # guess
    Effect("mag_sample_hold", on_sensor.mag_sample_hold, 0.08, "s", scaled=False,
           most=0.25),  # guess
    Effect("flexible_mount", on_sensor.flexible_mount, 0.1 * DEG, "rad/g"),  # guess
    Effect("moving_iron", on_sensor.moving_iron, 0.5 * MG, "gauss", "joint"),  # guess
    Effect("switched_device", on_sensor.switched_device, 0.5 * MG, "gauss", "switch"),  # guess
    Effect("rotor_field", on_sensor.rotor_field, 0.5 * MG, "gauss", "pump",
           alike=("ac_interference",)),  # guess
    # in the world
    Effect("field_gradient", in_world.field_gradient, 0.05 * MG, "gauss/m", "position"),
    Effect("field_anomaly", in_world.field_anomaly, 3 * MG, "gauss", "position"),  # guess
    Effect("geomagnetic_drift", in_world.geomagnetic_drift, 1 * MG, "gauss"),  # guess
    Effect("altitude_field", in_world.altitude_field, 0.2 * MG, "gauss/m", "position"),  # guess
    Effect("field_step", in_world.field_step, 1 * MG, "gauss"),  # guess
    # gyro
    Effect("gyro_scale", on_gyro.gyro_scale, 0.002, "1", alike=("clock_rate",)),
    Effect("gyro_nonorthogonality", on_gyro.gyro_nonorthogonality, 0.002, "rad"),  # guess
    Effect("mag_gyro_misalignment", on_sensor.mag_gyro_misalignment, 0.05 * DEG, "rad"),
    Effect("gyro_g_sensitivity", on_gyro.gyro_g_sensitivity, 0.05 * DEG / 9.81, "rad/s/(m/s^2)"),
    Effect("vibration_rectification", on_gyro.vibration_rectification, 0.02 * DEG, "rad/s",
           "motor"),  # guess
    Effect("gyro_bias_temperature", on_gyro.gyro_bias_temperature, 0.002 * DEG, "rad/s/degC",
           "temperature"),
    Effect("gyro_bias_drift", on_gyro.gyro_bias_drift, 0.02 * DEG, "rad/s"),  # guess
    Effect("gyro_bias_step", on_gyro.gyro_bias_step, 0.01 * DEG, "rad/s"),  # guess
    Effect("gyro_nonlinearity", on_gyro.gyro_nonlinearity, 0.005, "s/rad"),  # guess
    Effect("gyro_saturation", on_gyro.gyro_saturation, 0.01, "1", scaled=False, most=0.2),  # guess
    Effect("earth_rotation", on_gyro.earth_rotation, on_gyro.EARTH_RAD_S, "rad/s",
           most=on_gyro.EARTH_RAD_S),
    Effect("gyro_integration", on_gyro.gyro_integration, 1.0, "1", alike=_LAGS, most=1.0),
    Effect("gyro_startup", on_gyro.gyro_startup, 0.02 * DEG, "rad/s"),  # guess
    Effect("gyro_time_lag", on_gyro.gyro_time_lag, 2e-3, "s", alike=_LAGS, most=0.1),
    # link and people
    Effect("clock_rate", on_link.clock_rate, 0.002, "1", alike=("gyro_scale",)),
    Effect("timestamp_jitter", on_link.timestamp_jitter, 2e-3, "s", scaled=False, most=0.012),
    Effect("dropped_samples", on_link.dropped_samples, 0.004, "1", scaled=False, most=0.05),
    Effect("stuck_magnetometer", on_sensor.stuck_magnetometer, 1.0, "s", scaled=False),
    Effect("noise_burst", on_sensor.noise_burst, 2.0, "1", scaled=False),
    Effect("noise_level", on_sensor.noise_level, 1.3, "1", scaled=False),
    Effect("frame_error", on_link.frame_error, 1.0, "1", scaled=False, most=1.0),
    Effect("unit_error", on_link.unit_error, 1.0, "1", scaled=False, most=1.0),
    Effect("onboard_calibration_active", on_sensor.onboard_calibration_active, 0.03, "1",
           most=1.0),  # guess
    # in no library; limits are guesses
    Effect("turret", outside.turret, 0.3 * MG, "gauss", name=None),
    Effect("bursts", outside.bursts, 3 * MG, "gauss", name=None),
    Effect("passing_object", outside.passing_object, 2 * MG, "gauss", name=None),
    Effect("bent_mount", outside.bent_mount, 0.15 * DEG, "rad", name=None),
    Effect("two_states", outside.two_states, 0.4 * MG, "gauss", name=None),
    Effect("asymmetric_scale", outside.asymmetric_scale, 0.002, "1", name=None),
    Effect("unlogged_switch", outside.unlogged_switch, 0.5 * MG, "gauss", name=None),
    Effect("gyro_bump", outside.gyro_bump, 0.015 * DEG, "rad/s", name=None),
)  # fmt: skip

EFFECTS = {row.key: row for row in _ROWS}

#: group of covariates -> its columns, as a logger names them
GROUPS = {
    "motor": ("motor_current_a", "yaw_motor_current_a", "motor_rpm"),
    "speed": ("speed_m_s",),
    "temperature": ("temperature_c",),
    "position": ("position_north_m", "position_east_m", "position_down_m"),
    "joint": ("rudder_angle_rad",),
    "switch": ("lamp_on",),
    "pump": ("pump_rpm",),
}

#: another name that is right where the covariate is withheld: the effect seen without its cause
PARENTS = {
    "mag_bias_temperature": ("hard_iron_drift",),
    "gyro_bias_temperature": ("gyro_bias_drift", "gyro_startup"),
    "unlogged_switch": ("switched_device",),
    "passing_object": ("field_anomaly",),
    "gyro_bump": ("gyro_bias_drift",),
}

#: frames in which the very same signal may be told, beside the effect's own
FRAMES = {
    "mag_gyro_misalignment": ("gyro",),
    "mag_time_lag": ("gyro",),
    "mag_low_pass": ("gyro",),
    "gyro_time_lag": ("sensor",),
    "gyro_integration": ("sensor",),
    "bent_mount": ("gyro",),
    "clock_rate": ("gyro",),
    "frame_error": ("gyro", "sensor"),
    "unit_error": ("gyro",),
    "gyro_scale": ("link",),
    "noise_burst": ("link", "noise"),
    "noise_level": ("link", "noise"),
    "stuck_magnetometer": ("link",),
    "mag_sample_hold": ("link",),
    "timestamp_jitter": ("noise",),
    "mag_quantisation": ("link", "noise"),
}
