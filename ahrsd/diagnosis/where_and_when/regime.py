"""Residual field by condition: heading, tilt, rate and every logged column.

Each quantity is cut into bins of equally many samples, and a constant field in sensor axes per bin
is one group of columns.  A residual that follows the heading but not the time is a wrong form of
the calibration; one that follows a logged column points to that column.

A field on the vehicle may also be a function of the heading (`heading_columns`), in harmonics that
no single effect of the library has.  A turret that keeps its direction, a crane or a boom that
swings back turn against the vehicle, and their iron turns with the heading, once or several times.
In time such a field comes and goes with every turn, within seconds, and has no constant direction,
so that it counts as coloured noise.  By heading it repeats itself.  The calibration takes the part
that a soft iron explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

BINS = {"heading_deg": 12}
OTHER_BINS = 6
#: most harmonics of heading; the amplitude of each falls with its number
HARMONICS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Regime:
    """One binned quantity: its (bins + 1,) edges and the bin (N,) of every sample, -1 for none."""

    quantity: str
    edges: Array
    index: NDArray[np.intp]

    @property
    def group(self) -> str:
        """Its key in a group of columns."""
        return f"regime {self.quantity}"

    def words(self, inside: NDArray[np.bool]) -> str:
        """The selected bins as text: `heading_deg 200 to 260`."""
        padded = np.concatenate([[False], inside, [False]]).astype(int)
        starts, ends = np.flatnonzero(np.diff(padded) == 1), np.flatnonzero(np.diff(padded) == -1)
        parts = [
            f"{self.edges[a]:.3g} to {self.edges[b]:.3g}" for a, b in zip(starts, ends, strict=True)
        ]
        return f"{label(self.quantity)} {', '.join(parts)}" if parts else ""


def regimes(context: Context) -> tuple[Regime, ...]:
    """Attitude (where the world frame is level), rate, and logged columns that vary."""
    R = context.R_nb
    quantities = {"rate_rad_s": np.linalg.norm(context.rate_b_rad_s, axis=1)}
    quantities["heading_deg"] = np.degrees(context.heading_rad) % 360.0
    if context.world_levelled:
        quantities["pitch_deg"] = np.degrees(-np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0)))
        quantities["roll_deg"] = np.degrees(np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    found = [_bin_quantity(name, values) for name, values in quantities.items()]
    for name, values in context.track.covariates.items():
        if np.isfinite(values).mean() > 0.5:
            found.append(_bin_quantity(name, values))
    return tuple(regime for regime in found if regime is not None)


def regime_columns(regime: Regime) -> Columns:
    """3 columns per bin, bin-major: a field in sensor axes."""
    bins = len(regime.edges) - 1
    out = np.zeros((len(regime.index), 3, bins, 3))
    inside = np.flatnonzero(regime.index >= 0)
    out[inside, :, regime.index[inside], :] = np.eye(3)
    return Columns(mag=out.reshape(len(regime.index), 3, -1))


def _bin_quantity(name: str, values: Array) -> Regime | None:
    known = np.isfinite(values)
    span = float(np.ptp(values[known])) if known.any() else 0.0
    if span <= priors.REGIME_RANGE.get(name, 0.0):
        return None
    count = BINS.get(name, OTHER_BINS)
    edges = np.unique(np.quantile(values[known], np.linspace(0.0, 1.0, count + 1)))
    if len(edges) < 3:
        return None
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return Regime(name, edges, np.where(known, index, -1))


def heading_columns(context: Context) -> Columns:
    """A field in sensor axes by harmonics of heading: 3 columns a harmonic, scaled to the prior."""
    order = np.arange(1, HARMONICS + 1)
    phase = context.heading_rad[:, None] * order
    waves = np.concatenate([np.cos(phase) / order, np.sin(phase) / order], axis=1)
    axes = np.eye(3)
    return Columns(mag=np.einsum("nj,ki->nkji", waves, axes).reshape(len(phase), 3, -1))
