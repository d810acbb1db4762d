"""Methods beside each other on one recording: a row each, and the halves it is judged on.

Held out: the recording is cut into ten pieces in time; what was fitted on the even ones corrects
the odd ones and the other way round. The spread of both together, std |h| / mean |h| ([R] 4.4), is
what the calibration is worth on readings that it has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.baselines.data import corrected
from ahrsd.samples import Array, SampleBlock

PIECES = 10
Halves = tuple[list[SampleBlock], list[SampleBlock]]


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonRow:
    """What one method says.

    Without an answer hard_iron_gauss is None and `reason` says why; with one, `reason` is a remark
    or empty. spread, held_out: std over mean of the corrected field, on everything and held out;
    None where there is no answer. converged: whether the method itself calls it determined.
    """

    method: str
    soft_iron: Array | None
    hard_iron_gauss: Array | None
    gyro_bias_rad_s: Array | None
    converged: bool
    reason: str
    spread: float | None = None
    held_out: float | None = None


def halves(blocks: Sequence[SampleBlock]) -> Halves:
    """Even and odd pieces of the samples; each piece begins after a gap, nothing is bridged."""
    count = sum(len(block) for block in blocks)
    edges = np.linspace(0, count, PIECES + 1).astype(int)
    parts: Halves = ([], [])
    row = 0
    for block in blocks:
        ends = [e - row for e in edges if row < e < row + len(block)]
        begins = [0, *ends]
        for a, b in zip(begins, [*ends, len(block)], strict=True):
            piece = int(np.searchsorted(edges, row + a, side="right")) - 1
            new = row + a in edges
            parts[piece % 2].append(
                _cut(block, slice(a, b), gap=new or (a == 0 and block.gap_before))
            )
        row += len(block)
    return parts


def _cut(block: SampleBlock, rows: slice, *, gap: bool) -> SampleBlock:
    part = block.part(rows, gap_before=gap)
    if not (gap and len(part)):
        return part
    dt_s = part.dt_s.copy()
    dt_s[0] = np.nan
    return replace(part, dt_s=dt_s)


def spread_of(
    sets: Sequence[Sequence[SampleBlock]], answers: Sequence[tuple[Array | None, Array]]
) -> float:
    """Spread of |h| over all of the sets, each corrected by its own (A or None, b).

    The scale of a soft iron is a gauge, so each set is divided by its own mean first.
    """
    sizes = []
    for blocks, (soft_iron, hard_iron) in zip(sets, answers, strict=True):
        raw = np.vstack([block.raw_b_gauss for block in blocks])
        size = np.linalg.norm(corrected(raw, soft_iron, hard_iron), axis=1)
        sizes.append(size / size.mean())
    return float(np.std(np.concatenate(sizes)))
