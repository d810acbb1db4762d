"""What the true rates of a simulated experiment predict of its field: the check of a trajectory."""

from __future__ import annotations

import numpy as np

from ahrsd import so3
from ahrsd.samples import Array
from ahrsd.simulation.scenarios import Experiment


def predicted_directions(experiment: Experiment) -> Array:
    """Field directions (N, 3) that the true rates predict from the row before; row 0 is its own.

    They equal the true directions up to the coning within one step: the check of a trajectory.
    """
    u = experiment.field_b / np.linalg.norm(experiment.field_b, axis=1, keepdims=True)
    dt_s = np.diff(experiment.samples.time_s)
    back = so3.exp(-experiment.rate_b_rad_s[1:] * dt_s[:, None])
    return np.vstack([u[:1], np.einsum("nij,nj->ni", back, u[:-1])])
