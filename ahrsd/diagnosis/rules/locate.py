"""What the segments of a frame (`where_and_when/locate.py`) explain, and their course.

The frame whose coefficients explain most, each judged with priors from tenths of a milligauss to
tenths of a gauss and with both independent and wandering coefficients, is the frame of the source.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.innovation_filter.evidence import log_bayes
from ahrsd.diagnosis.innovation_filter.gram import Gram
from ahrsd.diagnosis.innovation_filter.score import score
from ahrsd.diagnosis.rules.score import chi2_p
from ahrsd.diagnosis.where_and_when.locate import Frame, Located, Segments, single_source
from ahrsd.samples import Array

#: sizes of one coefficient over which the evidence is averaged: gauss, gauss, rad/s
UNITS: Mapping[Frame, float] = {"sensor": 1e-3, "world": 1e-3, "gyro": 1e-4}
SPAN = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)


def log_bayes_walk(G: Array, s: Array, axes: int, deviations: Array, colour: float = 1.0) -> float:
    """Log Bayes factor of J segments x `axes` coefficients whose prior is a random walk in time.

    G (J axes, J axes) information and s (J axes,) score in natural units, segment-major;
    deviations: of one coefficient from its mean over the recording, natural units, averaged over.
    """
    J = len(s) // axes
    if J < 2:  # one segment has no deviation from its own mean
        return 0.0
    walk = np.minimum.outer(np.arange(1, J + 1), np.arange(1, J + 1)) / J
    centred = walk - walk.mean(0) - walk.mean(1)[:, None] + walk.mean()
    centred /= np.mean(np.diag(centred))
    values, vectors = np.linalg.eigh(centred)
    root = np.kron(vectors * np.sqrt(np.maximum(values, 0.0)), np.eye(axes))
    inner, turned = root.T @ (G / colour) @ root, root.T @ (s / colour)
    information, directions = np.linalg.eigh((inner + inner.T) / 2)
    information = np.maximum(information, 0.0)
    z2 = (directions.T @ turned) ** 2
    terms = [
        0.5 * float(np.sum(z2 / (information + d**-2)))
        - 0.5 * float(np.sum(np.log1p(d**2 * information)))
        for d in deviations
    ]
    return float(np.logaddexp.reduce(terms) - np.log(len(terms)))


def group_name(frame: Frame) -> str:
    """The frame's group in a Gram; no effect has such an identifier."""
    return f"unknown {frame}"


def locate(projected: Gram, frame: Frame, cut: Segments, colour: float) -> Located:
    """Judge one frame in a Gram from which calibration and named terms are projected out."""
    name, unit = group_name(frame), UNITS[frame]
    columns = projected.groups[name]
    what = score(projected, name, np.full(columns.stop - columns.start, unit), 1e-3)
    G = projected.total[columns, columns]
    s = projected.total[columns, -1]
    walk = log_bayes_walk(G, s, 3, np.asarray(SPAN) * unit, colour)
    evidence = float(np.logaddexp(log_bayes(what, colour, SPAN), walk) - np.log(2.0))
    course, deviation = _posterior_mean(G / colour, s / colour, unit)
    direction, share = single_source(course, deviation)
    return Located(
        frame,
        evidence,
        what.statistic,
        what.rank,
        chi2_p(what, colour),
        cut,
        course,
        deviation,
        direction,
        share,
    )


def _posterior_mean(G: Array, s: Array, unit: float) -> tuple[Array, Array]:
    """Coefficients (J, 3) under the prior size that fits best, and their deviations (J,)."""
    values, vectors = np.linalg.eigh((G + G.T) / 2)
    values = np.maximum(values, 0.0)
    z2 = (vectors.T @ s) ** 2
    sizes = np.asarray(SPAN) * unit
    fit = [
        0.5 * np.sum(z2 / (values + d**-2)) - 0.5 * np.sum(np.log1p(d**2 * values)) for d in sizes
    ]
    ridge = sizes[int(np.argmax(fit))] ** -2
    mean = vectors @ ((vectors.T @ s) / (values + ridge))
    variance = np.sum(vectors**2 / (values + ridge), axis=1)
    return mean.reshape(-1, 3), np.sqrt(variance.reshape(-1, 3).mean(axis=1))
