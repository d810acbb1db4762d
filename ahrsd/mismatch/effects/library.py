"""The library: every effect by its identifier, in the order of the contract."""

from __future__ import annotations

from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.effects.gyro import (
    EarthRotation,
    GyroGSensitivity,
    GyroIntegration,
    GyroNonlinearity,
    GyroNonorthogonality,
    GyroScale,
    GyroTimeLag,
)
from ahrsd.mismatch.effects.gyro_bias import (
    GyroBiasDrift,
    GyroBiasStep,
    GyroBiasTemperature,
    GyroStartup,
    VibrationRectification,
)
from ahrsd.mismatch.effects.sensor_iron import (
    HardIronDrift,
    HardIronStep,
    Hysteresis,
    SoftIronStep,
    ViscousMagnetisation,
)
from ahrsd.mismatch.effects.sensor_motion import (
    EddyCurrent,
    FlexibleMount,
    MagGyroMisalignment,
    MagLowPass,
    MagTimeLag,
)
from ahrsd.mismatch.effects.sensor_sources import (
    CurrentDerivativeField,
    MagBiasTemperature,
    MotorCurrentField,
    MovingIron,
    RotorField,
    SpeedField,
    SwitchedDevice,
    SyncPulses,
)

_ALL: tuple[Effect, ...] = (
    HardIronStep(),
    HardIronDrift(),
    SoftIronStep(),
    MotorCurrentField(),
    CurrentDerivativeField(),
    SpeedField(),
    SyncPulses(),
    MagBiasTemperature(),
    Hysteresis(),
    EddyCurrent(),
    ViscousMagnetisation(),
    MagTimeLag(),
    MagLowPass(),
    FlexibleMount(),
    MovingIron(),
    SwitchedDevice(),
    RotorField(),
    GyroScale(),
    GyroNonorthogonality(),
    MagGyroMisalignment(),
    GyroGSensitivity(),
    VibrationRectification(),
    GyroBiasTemperature(),
    GyroBiasDrift(),
    GyroBiasStep(),
    GyroNonlinearity(),
    EarthRotation(),
    GyroIntegration(),
    GyroStartup(),
    GyroTimeLag(),
)
#: The effects by identifier.
EFFECTS: dict[str, Effect] = {effect.identifier: effect for effect in _ALL}
