"""One source with one direction, in stretches of a few seconds.

A current that nobody logged goes on and off within seconds: to coefficients of twenty seconds it is
noise, and it counts as the noise's colour.  But it always points the same way.  Noise, white or
coloured, has no direction: the scores of short stretches, each made white by its own information,
are alike on all axes.  Mauchly's test of sphericity says how unlikely theirs are (Anderson,
Multivariate Statistical Analysis, 10.7), in the sensor's axes and in the world's.

One direction noise does have: the filter remembers the field's size for good and its direction for
seconds, so slow noise stays along the field.  Where that hardly turns in a frame, in the world
never, a source along it is none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ahrsd.mismatch.locate import (
    FRAMES,
    Frame,
    Located,
    Segments,
    frame_columns,
    group_name,
    locate,
    segments,
)
from ahrsd.mismatch.probabilities import chi2_above
from ahrsd.mismatch.regression import Base, group_gram
from ahrsd.mismatch.unknown import FINE, Remainder
from ahrsd.samples import Array

#: stretches are no shorter than the colour of ordinary noise is long
SHORTEST_S = 3.0
#: and no fewer than this, or their covariance says little
FEWEST = 20
#: share of the strongest direction of a single source
SINGLE = 0.6
#: mean square of the cosine between the source and the field, at most
ALONG = 0.5
_SMALLEST = 1e-9


def with_one_source(left: Remainder) -> Remainder:
    """The remainder with the frame in which a single quick source shows, if one does."""
    basis = left.basis
    count = min(FINE, int(basis.context.track.duration_s / SHORTEST_S))
    if count < FEWEST:
        return left
    cut = segments(basis.context.track.time_s, count)
    found = {frame: _directed(basis, frame, cut) for frame in FRAMES[:2]}
    best = max(found.values(), key=lambda one: one.share)
    frame = best.located.frame
    if best.share < SINGLE or best.located.evidence < left.located[frame].evidence:
        return left
    return replace(left, located={**left.located, frame: best.located})


@dataclass(frozen=True, slots=True, eq=False)
class _Directed:
    """A frame judged by its direction alone, and the share of the strongest direction."""

    located: Located
    share: float


def _directed(basis: Base, frame: Frame, cut: Segments) -> _Directed:
    gram = group_gram(basis, {group_name(frame): frame_columns(basis.context, frame, cut)})
    where = gram.groups[group_name(frame)]
    scores = whitened_scores(gram.total[where, where], gram.total[where, -1])
    scores = scores @ _even(basis)
    nats, p_value, share = sphericity(scores)
    if along_field(_field_in(basis, frame), scores) > ALONG:
        share = 0.0
    one = locate(gram, frame, cut, basis.colour)
    return _Directed(replace(one, evidence=nats, p_value=p_value), share)


def _field_in(basis: Base, frame: Frame) -> Array:
    context = basis.context
    if frame == "sensor":
        return context.field_b
    return np.asarray(np.einsum("nij,nj->ni", context.R_nb, context.field_b))


def along_field(field: Array, scores: Array) -> float:
    """Mean square of the cosine between a field (N, 3) and the strongest direction of (J, 3)."""
    unit = field / np.linalg.norm(field, axis=1, keepdims=True)
    strongest = np.linalg.eigh(scores.T @ scores)[1][:, -1]
    return float(np.mean((unit @ strongest) ** 2))


def whitened_scores(information: Array, score: Array) -> Array:
    """(J, 3) scores of stretches, each of unit covariance under the null; (3 J, 3 J) and (3 J,)."""
    count = len(score) // 3
    own = information.reshape(count, 3, count, 3)[np.arange(count), :, np.arange(count), :]
    values, vectors = np.linalg.eigh(own)
    values = np.maximum(values, _SMALLEST * max(float(values.max()), _SMALLEST))
    turned = np.einsum("jik,ji->jk", vectors, score.reshape(count, 3)) / np.sqrt(values)
    return np.asarray(np.einsum("jik,jk->ji", vectors, turned))


def sphericity(scores: Array) -> tuple[float, float, float]:
    """Nats by which scores (J, 3) have a direction, the probability of as many, and its share."""
    power = np.linalg.eigvalsh(scores.T @ scores / len(scores))
    power = np.maximum(power, _SMALLEST * max(float(power.max()), _SMALLEST))
    statistic = len(scores) * float(3 * np.log(power.mean()) - np.log(power).sum())
    cost = 0.5 * 5 * np.log(len(scores))  # Schwarz's price of the five further numbers
    return (
        statistic / 2 - float(cost),
        chi2_above(statistic, 5),
        float(power[2] / power.sum()),
    )


def _even(basis: Base) -> Array:
    """(3, 3) that makes the innovations' quick part alike on all axes: one axis may be noisier."""
    quick = np.diff(basis.innovation, axis=0)
    values, vectors = np.linalg.eigh(quick.T @ quick / len(quick))
    return np.asarray(vectors @ np.diag(1 / np.sqrt(np.maximum(values, _SMALLEST))) @ vectors.T)
