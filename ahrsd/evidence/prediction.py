"""Heading that one calibration would show where another is the truth, over all headings and tilts.

With the truth (C, b), attitude R_nb and field f_n the sensor reads m = C^-1 R_nb^T f_n + b. The
judged calibration makes a field of it; seen in n its horizontal direction is off by the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.samples import Array

HEADINGS = 36
_LEAST_TILT_DEG = 5.0  # no vehicle is level for ever: judge at least so far
_MOST_TILT_DEG = 60.0


@dataclass(frozen=True, slots=True)
class Envelope:
    """Where heading is predicted: a field (magnetic north-east-down) and half-ranges of tilt."""

    total_gauss: float
    inclination_rad: float
    roll_deg: float
    pitch_deg: float

    @property
    def field_n_gauss(self) -> Array:
        """(3,) the field in magnetic north, east, down."""
        level, down = np.cos(self.inclination_rad), np.sin(self.inclination_rad)
        return self.total_gauss * np.array([level, 0.0, down])

    def tilts_rad(self) -> Array:
        """(9, 2) roll and pitch: level, and the edges of what was driven (at least 5 degrees)."""
        roll, pitch = np.clip([self.roll_deg, self.pitch_deg], _LEAST_TILT_DEG, _MOST_TILT_DEG)
        grid = np.array([(r, p) for r in (-roll, 0, roll) for p in (-pitch, 0, pitch)])
        return np.asarray(np.radians(grid))


def heading_error_curve(
    judged: Affine,
    truth: Affine,
    field_n_gauss: Array,
    *,
    roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
    headings: int = HEADINGS,
) -> Array:
    """(headings,) heading shown by `judged` minus true heading in degrees, at 0, 10, 20, ... deg.

    `field_n_gauss` (3,) is in the units that `truth` produces.
    """
    R_nb = _attitudes(np.linspace(0, 2 * np.pi, headings, endpoint=False), roll_rad, pitch_rad)
    raw_b_gauss = truth.undo(np.einsum("kji,j->ki", R_nb, field_n_gauss))
    seen_n = np.einsum("kij,kj->ki", R_nb, judged.apply(raw_b_gauss))
    off = np.arctan2(seen_n[:, 1], seen_n[:, 0]) - np.arctan2(field_n_gauss[1], field_n_gauss[0])
    return np.asarray(-np.degrees(np.arctan2(np.sin(off), np.cos(off))))


def worst_difference_deg(judged: Affine, truth: Affine, envelope: Envelope) -> float:
    """Largest |heading difference| over all headings and the envelope's tilts; nan if unknown."""
    curves = [
        heading_error_curve(judged, truth, envelope.field_n_gauss, roll_rad=roll, pitch_rad=pitch)
        for roll, pitch in envelope.tilts_rad().tolist()
    ]
    return float(np.max(np.abs(curves)))


def _attitudes(heading_rad: Array, roll_rad: float, pitch_rad: float) -> Array:
    """(k, 3, 3) R_nb = Rz(heading) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp = np.cos(roll_rad), np.sin(roll_rad), np.cos(pitch_rad), np.sin(pitch_rad)
    tilt = np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
    c, s, zero, one = np.cos(heading_rad), np.sin(heading_rad), 0 * heading_rad, 1 + 0 * heading_rad
    turn = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    return np.asarray(turn @ tilt)
