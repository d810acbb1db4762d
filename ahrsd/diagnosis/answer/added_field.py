"""Size of a field that is added to the readings, in gauss and in degrees of heading.

The part that a different calibration would absorb is not counted: on a car that hardly tilts, that
is nearly all of a field by attitude.  Also here: by how much one calibration in place of another
turns a heading.
"""

from __future__ import annotations

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.model import Context, NullModel
from ahrsd.samples import Array


def calibration_basis(context: Context) -> Array:
    """(3 N, 9) orthonormal basis of what soft and hard iron can add to the readings."""
    x, y, z = context.field_b.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    soft = [
        (x, zero, zero), (zero, y, zero), (zero, zero, z), (y, x, zero), (z, zero, x), (zero, z, y)
    ]  # fmt: skip
    hard = [(one, zero, zero), (zero, one, zero), (zero, zero, one)]
    columns = np.stack([np.column_stack(part).ravel() for part in (*soft, *hard)], axis=1)
    return np.asarray(np.linalg.svd(columns, full_matrices=False)[0])


def project_out_calibration(added: Array, basis: Array) -> Array:
    """(N, 3) the part that no soft and hard iron would absorb; basis: `calibration_basis`."""
    flat = added.ravel()
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(added.shape))


def rms_about_mean(added: Array) -> float:
    """Root mean square length of (N, 3) about its mean."""
    return float(np.sqrt(np.sum(np.var(added, axis=0))))


def heading_deviation_deg(added: Array, context: Context) -> float:
    """Standard deviation of a level vehicle's heading due to a field (N, 3) added to the readings.

    From the component across the horizontal field; where no down direction is known, for a field
    of random direction and usual inclination.
    """
    read = context.field_b @ context.model.soft_iron.T
    if not context.world_levelled:
        size = float(np.median(np.linalg.norm(read, axis=1)))
        return float(np.degrees(rms_about_mean(added) / np.sqrt(3.0) / (priors.LEVEL_SHARE * size)))
    outside, in_world = (_rotate(context.R_nb, vectors) for vectors in (read, added))
    north, east, _ = mean = outside.mean(axis=0)
    level = float(np.hypot(north, east))
    least = max(level, priors.LEVEL_LEAST_SHARE * float(np.linalg.norm(mean)))
    across = in_world[:, :2] @ np.array([-east, north]) / max(level, 1e-300)
    return float(np.degrees(np.std(across) / least))


def _rotate(rotations: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("nij,nj->ni", rotations, vectors))


def heading_error_deg(before: NullModel, after: NullModel, field_b: Array) -> float:
    """Largest heading error of a level vehicle if one calibration is used in place of another.

    Both correct the readings of the repaired sensor; field_b (N, 3) gives the field's size, and
    the inclination is taken as 60 degrees.
    """
    size = float(np.median(np.linalg.norm(field_b, axis=1)))
    heading = np.radians(np.arange(0.0, 360.0, 5.0))
    level = np.column_stack([0.5 * np.cos(heading), -0.5 * np.sin(heading), np.full(72, 0.866)])
    reading = size * level @ after.soft_iron.T + after.hard_iron_gauss
    seen = (reading - before.hard_iron_gauss) @ np.linalg.inv(before.soft_iron).T
    error = np.arctan2(-seen[:, 1], seen[:, 0]) - heading
    wrapped = (error + np.pi) % (2 * np.pi) - np.pi
    return float(np.degrees(np.max(np.abs(wrapped))))
