"""Simulated experiments with their truth: the theses' scenarios, deterministic by seed.

`truth` says what is hidden, `motion` how the sensor turns, `scenarios` makes experiments WAM, MAM
and LAM of [R], `recorded` [L]'s experiment from a recorded gyro stream, `disturbance` adds what
goes wrong on real streams, `tabular` lays an experiment out in the columns of a table recording.
Pure: nothing here reads or writes a file.

[R] Rodriguez-Martinez, thesis, PUC Chile 2023; [L] Lichlyter, thesis, Mississippi State 2022.
"""

from ahrsd.simulation.experiment import Experiment
from ahrsd.simulation.motion import MOTIONS, SCENARIOS
from ahrsd.simulation.scenarios import ScenarioSettings, simulate
from ahrsd.simulation.truth import Iron, Truth

__all__ = ["MOTIONS", "SCENARIOS", "Experiment", "Iron", "ScenarioSettings", "Truth", "simulate"]
