"""Simulated experiments with their truth: the theses' scenarios, deterministic by seed.

`scenarios` makes the experiments WAM, MAM and LAM of [R] and [L]'s from a recorded gyro stream, and
what goes wrong on real streams; an `Experiment` is what a sensor would have sent and what is hidden
behind it, and is laid out in the columns of a table recording.
Pure: nothing here reads or writes a file.

[R] Rodriguez-Martinez, thesis, PUC Chile 2023; [L] Lichlyter, thesis, Mississippi State 2022.
"""

from ahrsd.simulation.scenarios import (
    MOTIONS,
    SCENARIOS,
    Experiment,
    Iron,
    ScenarioSettings,
    Truth,
    simulate,
)

__all__ = ["MOTIONS", "SCENARIOS", "Experiment", "Iron", "ScenarioSettings", "Truth", "simulate"]
