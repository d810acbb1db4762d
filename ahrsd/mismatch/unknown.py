"""What is left when every name is in: is there something, in which frame, when, how large.

Three agnostic frames and the regime bins are tested against the innovations of the named model.
What fires is described, not named: frame, spans, axes, direction, regime, size, and the logged
channels that move with it.  Its held-out gain is that of the frame's own coefficients, the
nonparametric repair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd.mismatch import intervals, locate, regime
from ahrsd.mismatch.diagnosis import Heldout, Suspect, Unexplained, Where
from ahrsd.mismatch.evidence import log_bayes
from ahrsd.mismatch.gram import Gram
from ahrsd.mismatch.limits import Limits
from ahrsd.mismatch.locate import FRAMES, Frame, Located
from ahrsd.mismatch.regime import Regime
from ahrsd.mismatch.regression import Base, group_gram
from ahrsd.mismatch.score import chi2_p, score
from ahrsd.mismatch.validate import heldout
from ahrsd.mismatch.values import Columns
from ahrsd.samples import Array

SEGMENT_S = 20.0
SEGMENTS = (6, 24)
FINE = 80
AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class Remainder:
    """The agnostic tests on one basis.

    located: by frame;  bins: (regime, evidence, p-value) with the strongest first
    """

    located: dict[Frame, Located]
    bins: tuple[tuple[Regime, float, float], ...]

    @property
    def strongest(self) -> Located:
        """The frame that explains most."""
        return max(self.located.values(), key=lambda one: one.evidence)


def remainder(basis: Base, with_bins: bool = True) -> Remainder:
    """Test the three frames, and the regimes where wanted."""
    cut = coarse_cut(basis)
    groups: dict[str, Columns] = {
        locate.group_name(frame): locate.frame_columns(basis.context, frame, cut)
        for frame in FRAMES
    }
    found = regime.regimes(basis.context) if with_bins else ()
    groups |= {one.group: regime.regime_columns(one) for one in found}
    gram = group_gram(basis, groups)
    located = {frame: locate.locate(gram, frame, cut, basis.colour) for frame in FRAMES}
    bins = []
    for one in found:
        width = gram.groups[one.group].stop - gram.groups[one.group].start
        what = score(gram, one.group, np.full(width, locate.UNITS["sensor"]), 1e-3)
        bins.append((one, log_bayes(what, basis.colour, locate.SPAN), chi2_p(what, basis.colour)))
    return Remainder(located, tuple(sorted(bins, key=lambda item: -item[1])))


def coarse_cut(basis: Base) -> locate.Segments:
    """Segments of about 20 s, fewer and more on short and long recordings."""
    track = basis.context.track
    count = int(np.clip(round(track.duration_s / SEGMENT_S), *SEGMENTS))
    return locate.segments(track.time_s, count)


def detected(left: Remainder, limits: Limits) -> bool:
    """Whether something is there that no name explains."""
    best = left.strongest
    by_time = best.evidence > limits.unknown_nats and best.p_value < limits.unknown_p
    by_bin = any(
        evidence > limits.unknown_nats and p < limits.unknown_p for _, evidence, p in left.bins
    )
    return by_time or by_bin


def described(basis: Base, left: Remainder, block_s: float, limits: Limits) -> Unexplained:
    """The address of what is left."""
    best = left.strongest
    regime_first = bool(left.bins) and left.bins[0][1] > best.evidence
    frame = best.frame
    cut = locate.segments(basis.context.track.time_s, FINE)
    gram = group_gram(
        basis, {locate.group_name(frame): locate.frame_columns(basis.context, frame, cut)}, block_s
    )
    columns = gram.groups[locate.group_name(frame)]
    total = gram.total / basis.colour
    changes = intervals.change_points(total[columns, columns], total[columns, -1])
    fine = locate.locate(gram, frame, cut, basis.colour)
    level = intervals.levels(fine.course, fine.deviation, changes)
    spans = intervals.departures(cut.edges_s, level, fine.deviation)
    words = None
    if left.bins and left.bins[0][1] > limits.unknown_nats:
        words = _bin_words(left.bins[0][0], basis)
    if regime_first:
        track = basis.context.track
        spans = [(float(track.time_s[0]), float(track.time_s[-1]))]
        frame = "sensor"
    spread = np.sqrt(np.average((best.course - best.course.mean(0)) ** 2, axis=0))
    axes = tuple(AXES[k] for k in range(3) if spread[k] > 0.3 * spread.max())
    follows = tuple(
        Suspect(m.channel, m.correlation, m.p_value)
        for m in locate.matches(basis.context.track, best)
        if m.p_value < 0.2 and abs(m.correlation) > 0.5
    )
    return Unexplained(
        detected=True,
        where=Where(
            tuple(spans),
            axes,
            frame,
            words,
            None,
            (float(best.direction[0]), float(best.direction[1]), float(best.direction[2])),
        ),
        heldout=_heldout(
            gram, locate.group_name(frame) if not regime_first else None, frame, basis
        ),
        size=float(np.ptp(best.source)),
        unit="rad/s" if frame == "gyro" else "gauss",
        single_source_share=best.single_share,
        follows=follows,
        evidence_nats=max(best.evidence, left.bins[0][1] if left.bins else -np.inf),
    )


def _bin_words(one: Regime, basis: Base) -> str:
    """The bins of one quantity in which the innovations are away from zero."""
    whitened = basis.innovation
    size = np.zeros(len(one.edges) - 1)
    for k in range(len(size)):
        rows = whitened[one.index == k]
        size[k] = np.sum(rows.mean(axis=0) ** 2) * len(rows) if len(rows) else 0.0
    return one.words(size > 0.5 * size.max())


def _heldout(gram: Gram, name: str | None, frame: Frame, basis: Base) -> Heldout | None:
    if name is None:
        return None
    width = gram.groups[name].stop - gram.groups[name].start
    gain = heldout(gram, [], name, np.full(width, 10.0 * locate.UNITS[frame]))
    rms = innovation_rms(basis)
    return Heldout(
        rms,
        rms * float(np.sqrt(max(gain.after, 0.0) / max(gain.before, 1e-12))),
        gain.nats_per_sample,
        0.0,
    )


def innovation_rms(basis: Base) -> float:
    """Root mean square of the magnetometer's one-step errors, gauss."""
    done = basis.filtered
    return float(np.sqrt(np.mean(done.innovation[done.used] ** 2)))


def coverage(without: Array, with_terms: Array) -> float:
    """Share of an agnostic statistic that named terms explain, 0..1."""
    before, after = float(np.sum(without)), float(np.sum(with_terms))
    return float(np.clip(1.0 - after / max(before, 1e-300), 0.0, 1.0))
