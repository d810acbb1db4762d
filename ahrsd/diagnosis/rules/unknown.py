"""What is left when every name is in: is there something, in which frame, when, how large.

Three agnostic frames and the regime bins are tested against the innovations of the named model.
What fires is described, not named: frame, spans, axes, direction, regime, size, and the logged
channels that move with it.  Its held-out gain is that of the frame's own coefficients, the
nonparametric repair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Check, Heldout, Suspect, Unexplained, Where, Whiteness
from ahrsd.diagnosis.calibration_fit.problem import Problem
from ahrsd.diagnosis.innovation_filter.evidence import log_bayes
from ahrsd.diagnosis.innovation_filter.gram import Gram
from ahrsd.diagnosis.innovation_filter.score import score
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import intervals, locate
from ahrsd.diagnosis.rules.course_gram import course_gram
from ahrsd.diagnosis.rules.directions import by_direction
from ahrsd.diagnosis.rules.gram import gram
from ahrsd.diagnosis.rules.regression import Base, known_out, quieter
from ahrsd.diagnosis.rules.score import chi2_p
from ahrsd.diagnosis.rules.validate import Gain, alternating, heldout
from ahrsd.diagnosis.values import Columns
from ahrsd.diagnosis.where_and_when import regime
from ahrsd.diagnosis.where_and_when.intervals import departures
from ahrsd.diagnosis.where_and_when.locate import (
    FRAMES,
    Frame,
    Located,
    coarse_cut,
    frame_columns,
    matches,
    segments,
)
from ahrsd.diagnosis.where_and_when.regime import Regime
from ahrsd.samples import Array

FINE = 80
#: shifts of the placebo
SHIFTS = 3
AXES = ("x", "y", "z")
#: probability of an omnibus test below which innovations are not those of the model
UNEVEN_P = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Remainder:
    """The agnostic tests.

    basis: with the noise that the strongest frame leaves;  located: by frame
    bins: (regime, evidence, p-value), the strongest first
    free: the strongest frame with its course as a joint fit has it (`free_course`)
    stood_in: the frame of a name that was taken out again though the tests show nothing there
    one_source: whether a quick source is among them (`one_source`)
    quick: each frame's course that changes within seconds, in nats over white noise, where asked
    spells_s: (begin, end) where a course that comes and goes is away (`spells`)
    """

    basis: Base
    located: dict[Frame, Located]
    bins: tuple[tuple[Regime, float, float], ...]
    free: Located | None = None
    stood_in: Frame | None = None
    one_source: bool = False
    quick: Mapping[Frame, Located] = field(default_factory=dict)
    spells_s: tuple[tuple[float, float], ...] = ()

    @property
    def strongest(self) -> Located:
        """The frame that explains most."""
        if self.stood_in is not None:
            return self.located[self.stood_in]
        return max(self.located.values(), key=lambda one: one.evidence)

    @property
    def courses(self) -> tuple[Located, ...]:
        """Every frame's course, as the joint fit has it where there is one."""
        free = self.free
        return tuple(
            free if free is not None and free.frame == frame else one
            for frame, one in self.located.items()
        )


def remainder(basis: Base, with_bins: bool = True) -> Remainder:
    """Test the three frames, and the regimes where wanted.

    The noise is taken from what the strongest frame leaves: a course that is to be found must not
    count as noise.
    """
    cut = coarse_cut(basis.context.track)
    grams = {frame: course_gram(basis, frame, cut) for frame in FRAMES}
    first = max(
        (locate.locate(grams[frame], frame, cut, basis.colour) for frame in FRAMES),
        key=lambda one: one.statistic,
    )
    strongest = basis.whitened([frame_columns(basis.context, first.frame, cut)])[0]
    weighed = by_direction(quieter(basis, strongest), strongest)
    same = weighed.weight is basis.weight
    return tested(weighed, with_bins=with_bins, grams=grams if same else None)


def tested(basis: Base, *, with_bins: bool, grams: Mapping[Frame, Gram] | None = None) -> Remainder:
    """The same in noise of the basis's own colour.

    grams: of each frame alone, none of the others is asked beside it; where they are known
    """
    cut = coarse_cut(basis.context.track)
    found = regime.regimes(basis.context) if with_bins else ()
    grams = grams or {frame: course_gram(basis, frame, cut) for frame in FRAMES}
    located = {frame: locate.locate(grams[frame], frame, cut, basis.colour) for frame in FRAMES}
    binned = _whitened(basis, {one.group: regime.regime_columns(one) for one in found})
    bins = []
    for one in found:
        own = known_out(basis, {one.group: binned[one.group]})
        width = binned[one.group].shape[2]
        what = score(own, one.group, np.full(width, locate.UNITS["sensor"]), 1e-3)
        bins.append((one, log_bayes(what, basis.colour, locate.SPAN), chi2_p(what, basis.colour)))
    return Remainder(basis, located, tuple(sorted(bins, key=lambda item: -item[1])))


def _whitened(basis: Base, groups: Mapping[str, Columns]) -> dict[str, Array]:
    return dict(zip(groups, basis.whitened(list(groups.values())), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A frame's course in finer segments: where it changes, and its levels between the changes.

    changes_s: times of the changes;  covered: share of the frame's statistic that they explain;
    level: (J, 3);  spans: where it is away from its usual level
    """

    fine: Located
    changes_s: tuple[float, ...]
    covered: float
    level: Array
    spans: tuple[tuple[float, float], ...]


def course(left: Remainder) -> Course:
    """The strongest frame's course in segments of an eightieth of the recording."""
    basis, frame = left.basis, left.strongest.frame
    name = locate.group_name(frame)
    cut = segments(basis.context.track.time_s, FINE)
    whole = course_gram(basis, frame, cut)
    where = whole.groups[name]
    total = whole.total / basis.colour
    G, s = total[where, where], total[where, -1]
    changes = intervals.change_points(G, s)
    fine = locate.locate(whole, frame, cut, basis.colour)
    level = intervals.levels(fine.course, fine.deviation, changes)
    found = departures(cut.edges_s, level, fine.deviation, fine.course)
    always = [(float(cut.edges_s[0]), float(cut.edges_s[-1]))]
    return Course(
        fine,
        tuple(float(cut.edges_s[k]) for k in changes),
        intervals.explained(G, s, changes) / max(left.strongest.statistic / basis.colour, 1e-300),
        level,
        tuple(found or always),
    )


def beside_names(left: Remainder, price: float, limits: Limits) -> Remainder:
    """The remainder of a model with names that leave so many nats of their own forms.

    A form of an error by the rates, or one source, is nothing where it was no more than that.
    """
    located = {k: replace(one, evidence=one.evidence - price) for k, one in left.located.items()}
    bins = tuple((one, evidence - price, p) for one, evidence, p in left.bins)
    least, before = limits.unknown_nats, left.strongest.evidence
    left = replace(left, located=located, bins=bins)
    if before > least > before - price:
        return replace(left, stood_in=None, one_source=False)
    # a source needs less than a course: what is left of it must be more than nothing
    return replace(left, one_source=left.one_source and before > price)


def detected(left: Remainder, limits: Limits) -> bool:
    """Whether something is there that no name explains."""
    best = left.strongest
    by_time = best.evidence > limits.unknown_nats and best.p_value < limits.unknown_p
    by_bin = any(
        evidence > limits.unknown_nats and p < limits.unknown_p for _, evidence, p in left.bins
    )
    return by_time or by_bin or left.stood_in is not None or left.one_source


def described(left: Remainder, problem: Problem, limits: Limits) -> Unexplained:
    """The address of what is left."""
    best, basis = left.strongest, left.basis
    seen = course(left)
    words = None
    if left.bins and left.bins[0][1] > limits.unknown_nats:
        words = _bin_words(left.bins[0][0], basis)
    by_bin = bool(left.bins) and left.bins[0][1] > best.evidence and left.stood_in is None
    time_s = basis.context.track.time_s
    whole = ((float(time_s[0]), float(time_s[-1])),)
    free = left.free or best
    spread = np.sqrt(np.average((free.course - free.course.mean(0)) ** 2, axis=0))
    x, y, z = (float(part) for part in free.direction)
    follows = tuple(
        Suspect(m.channel, m.correlation, m.p_value)
        for m in matches(basis.context.track, free)
        if m.p_value < 0.2 and abs(m.correlation) > 0.5
    )
    return Unexplained(
        detected=True,
        where=Where(
            whole if by_bin else left.spells_s or seen.spans,
            tuple(AXES[k] for k in range(3) if spread[k] > 0.3 * spread.max()),
            "sensor" if by_bin else best.frame,
            words,
            None,
            (x, y, z),
        ),
        heldout=None if by_bin else _heldout(left, problem),
        size=float(np.ptp(free.source)),
        unit="rad/s" if best.frame == "gyro" else "gauss",
        single_source_share=free.single_share,
        follows=follows,
        evidence_nats=max(best.evidence, left.bins[0][1] if left.bins else -np.inf),
        course=()
        if by_bin
        else tuple(zip(free.cut.middle_s.tolist(), free.source.tolist(), strict=True)),
    )


def borne_out(
    left: Unexplained, checks: Mapping[str, Check], whiteness: Mapping[str, Whiteness]
) -> Unexplained:
    """What is left, if anything besides its own likelihood says that it is there.

    Drawn freely it gains where nothing was fitted, more than the same course at another time does,
    or simulations of the model do not look like the recording.  Else nothing is left: a model that
    predicts as well and whose simulations look the same is not wrong in a way that anybody could
    use.
    """
    held = left.heldout
    gains = held is not None and held.nll_gain_per_sample > max(0.0, held.placebo_gain)
    fails = not all(one.inside_after for one in checks.values())
    uneven = any(one.p_after < UNEVEN_P for one in whiteness.values())
    return left if gains or fails or uneven else Unexplained(False)


def _bin_words(one: Regime, basis: Base) -> str:
    """The bins of one quantity in which the innovations are away from zero."""
    whitened = basis.innovation
    size = np.zeros(len(one.edges) - 1)
    for k in range(len(size)):
        rows = whitened[one.index == k]
        size[k] = np.sum(rows.mean(axis=0) ** 2) * len(rows) if len(rows) else 0.0
    return one.words(size > 0.5 * size.max())


def _heldout(left: Remainder, problem: Problem) -> Heldout:
    """What the frame's course says of every second block, known from the others alone.

    Per recorded sample.  Placebo: the same course held against the innovations of another time.
    """
    block_s, thin = problem.block_s, problem.thin
    best, basis = left.strongest, left.basis
    columns = basis.whitened([frame_columns(basis.context, best.frame, best.cut)])[0]
    gain = _course_gain(best, basis, columns, block_s)
    count = len(basis.innovation)
    moved = [basis.moved(count * k // (SHIFTS + 1)) for k in range(1, SHIFTS + 1)]
    usual = max(_course_gain(best, one, columns, block_s).nats_per_sample for one in moved)
    rms = innovation_rms(basis)
    after = rms * float(np.sqrt(max(gain.after, 0.0) / max(gain.before, 1e-12)))
    return Heldout(rms, after, gain.nats_per_sample / thin, usual / thin)


def _course_gain(best: Located, basis: Base, columns: Array, block_s: float) -> Gain:
    """columns (N, 3, p): whitened, of the frame's course."""
    name = locate.group_name(best.frame)
    halves = _halves(basis, name, columns, min(block_s, best.cut.length_s / 4))
    spread = max(float(np.std(best.course)), 1e-3 * locate.UNITS[best.frame])
    return heldout(halves, [], name, np.full(columns.shape[2], spread), alternating)


def _halves(basis: Base, name: str, columns: Array, length_s: float) -> Gram:
    """The columns' Gram in two parts: every second stretch of this length, and the others."""
    time_s = basis.context.track.time_s
    second = (time_s - time_s[0]) // length_s % 2 == 1
    order = np.argsort(second, kind="stable")
    groups = {known: basis.known[order][:, :, where] for known, where in basis.groups.items()}
    edges = [0, int(np.count_nonzero(~second)), len(time_s)]
    whole = gram({**groups, name: columns[order]}, basis.innovation[order], time_s[order], edges)
    return whole.project(list(basis.groups))


def innovation_rms(basis: Base) -> float:
    """Root mean square of the magnetometer's one-step errors, gauss."""
    done = basis.filtered
    return float(np.sqrt(np.mean(done.innovation[done.used] ** 2)))
