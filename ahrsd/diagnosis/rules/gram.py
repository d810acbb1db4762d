"""Gram matrices (`innovation_filter/gram.py`) of whitened columns, block by block.

Columns in groups [nuisance | named terms | candidates | agnostic bases]; a later stretch of the
recording is one more block.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from ahrsd.diagnosis.innovation_filter.gram import Gram, slices
from ahrsd.samples import Array


def gram(
    columns: Mapping[str, Array], innovation: Array, time_s: Array, edges: Sequence[int]
) -> Gram:
    """Block sums of whitened columns (N, 3, p) and innovation (N, 3); blocks between `edges`."""
    count = len(innovation)
    stacked = np.concatenate(
        [*(np.asarray(x) for x in columns.values()), innovation[:, :, None]], axis=2
    ).reshape(count * 3, -1)
    width = stacked.shape[1]
    blocks = np.empty((len(edges) - 1, width, width))
    for k, (start, end) in enumerate(itertools.pairwise(edges)):
        part = stacked[3 * start : 3 * end]
        blocks[k] = part.T @ part
    spans = [(time_s[a], time_s[b - 1]) for a, b in itertools.pairwise(edges)]
    total = np.einsum("bii->i", blocks)[:-1]
    return Gram(
        slices([(name, x.shape[2]) for name, x in columns.items()]),
        blocks,
        3.0 * np.diff(np.asarray(edges, float)),
        np.array(spans, float),
        total,
    )


def block_edges(time_s: Array, length_s: float) -> list[int]:
    """Row numbers that cut a recording into blocks of about `length_s`; a rest joins the last.

    Never more blocks than rows, however far the clock went.
    """
    count = min(max(1, round(float(time_s[-1] - time_s[0]) / length_s)), len(time_s))
    cuts = time_s[0] + (time_s[-1] - time_s[0]) * np.arange(1, count) / count
    inner = np.searchsorted(time_s, cuts)
    return sorted({0, *inner.tolist(), len(time_s)})
