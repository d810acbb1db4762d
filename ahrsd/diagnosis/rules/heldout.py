"""What a named term gains on parts of the recording that nothing was fitted to.

Fifths of the recording in turn, each filtered on its own: calibration, strength of the field and
the other terms are fitted to the other four, without the term and with it.  A slow effect bends the
calibration of four fifths, and it shows in the fifth.

The filter of a diagnosis finds the field's strength as it goes, in what is held out as well; here
the strength is a parameter.  A gyro bias that wanders is held against one that stays, in a filter
in which it stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis.calibration_fit.descent import NullFit
from ahrsd.diagnosis.effects import series
from ahrsd.diagnosis.innovation_filter.evidence import colour
from ahrsd.diagnosis.innovation_filter.gram import Gram
from ahrsd.diagnosis.innovation_filter.innovation import (
    nuisance_columns,
    regressing,
    run_filter,
    sensitivities,
)
from ahrsd.diagnosis.rules.gram import block_edges, gram
from ahrsd.diagnosis.rules.regression import CALIBRATION
from ahrsd.diagnosis.rules.validate import FOLDS, PRIOR, Folds, Gain, heldout, one_by_one
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import Columns
from ahrsd.samples import Array

#: twice the nats that may be lost per parameter because the other fifths do not know it exactly;
#: where all five know as much of it they are 1.25
_LOST = 5.0
#: group of all terms that are asked together
_ALL = "terms"


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A whole model, all its terms taken out, as the filter of the fifths sees it.

    fifths: of calibration and terms;  scatter: logarithm of the innovations' deviations, summed
    over the axes, mean of the rows
    """

    fifths: Gram
    scatter: float


def gain_of(
    fit: NullFit,
    number: int,
    value: Array,
    scale: Array,
    *,
    wanders: bool = False,
    white: bool = False,
) -> Gain | None:
    """The held-out gain of a term of a fit.

    value (p,): the whole of it;  scale (p,): its prior deviations
    wanders: it is a bias that may walk in the fit, and would not without it
    white: what fifths do not know of each other is reckoned in white noise
    None where a fifth says what the others do not know.  The noise is as loud as the fit leaves it.
    """
    name = _name(number)
    after = _seen(fit, fit.model.gyro_walk_rad_s_sqrt_s)
    blocks = _put_back(after.fifths, name, value)
    known = [group for group in blocks.groups if group != name]
    if not wanders:
        lost, won = _exchanged(blocks, known, name, value, scale)
        if _alone(lost, won, len(scale), 1.0 if white else _scatter(fit)):
            return None
    level = fit.filtered.normalised_innovation
    gain = heldout(blocks, known, name, scale, one_by_one)
    before, scatter = gain.before, 0.0
    if wanders:
        still = _seen(fit, 0.0)
        left = _put_back(still.fifths, name, value)
        before = heldout(left, known, name, scale, one_by_one).before
        scatter = still.scatter - after.scatter
    return Gain(before / level, gain.after / level, scatter)


def gain_of_all(fit: NullFit, values: Sequence[Array], scales: Sequence[Array]) -> Gain:
    """The held-out gain of all terms of a fit together, in fifths; arguments as in `gain_of`.

    A gyro bias that may walk is noise here: in both filters it may.
    """
    seen = _seen(fit, fit.model.gyro_walk_rad_s_sqrt_s)
    gain = gain_together(seen.fifths, values, scales, one_by_one)
    level = fit.filtered.normalised_innovation
    return Gain(gain.before / level, gain.after / level)


def gain_together(
    blocks: Gram, values: Sequence[Array], scales: Sequence[Array], dealt: Callable[[int], Folds]
) -> Gain:
    """The held-out gain of all terms of some blocks together; values, scales: of each term."""
    names = [_name(number) for number in range(len(values))]
    for name, value in zip(names, values, strict=True):
        blocks = _put_back(blocks, name, value)
    known = [group for group in blocks.groups if group not in names]
    ordered = blocks.select([*known, *names])
    groups = {group: ordered.groups[group] for group in known}
    first = ordered.groups[names[0]].start
    whole = replace(ordered, groups={**groups, _ALL: slice(first, len(ordered.information))})
    return heldout(whole, known, _ALL, np.concatenate(scales), dealt)


def _name(number: int) -> str:
    return f"term {number}"


def _seen(fit: NullFit, walk_rad_s_sqrt_s: float) -> _Seen:
    key = f"fifths at {walk_rad_s_sqrt_s}"
    if key not in fit.made:
        model = replace(fit.model, gyro_walk_rad_s_sqrt_s=walk_rad_s_sqrt_s)
        track, edges = _cut(fit.filtered.track)
        done = run_filter(track, model, fit.terms_mag, fit.terms_gyro, strength_known=True)
        done = regressing(done, fit.context().rate_b_rad_s)
        strength = Columns(mag=(done.predicted_b @ model.soft_iron.T)[:, :, None])
        own = [sensitivities(done, part) for part in (nuisance_columns(done), strength)]
        groups = {CALIBRATION: np.concatenate(own, axis=2)}
        context = fit.context()
        for number, term in enumerate(fit.terms):
            groups[_name(number)] = sensitivities(done, term.columns(context))
        nats = done.log_likelihood + 0.5 * np.sum(done.whitened**2, axis=1)
        blocks = gram(groups, done.whitened, track.time_s, edges)
        fit.made[key] = _Seen(blocks, -float(np.mean(nats[done.used])))
    seen: _Seen = fit.made[key]
    return seen


def _cut(track: Track) -> tuple[Track, list[int]]:
    """The track with runs of their own in every fifth, and the fifths' edges."""
    edges = block_edges(track.time_s, track.duration_s / FOLDS)
    dt_s = track.dt_s.copy()
    dt_s[edges[:-1]] = np.nan
    return replace(track, dt_s=dt_s, runs=tuple(series.runs(dt_s))), edges


def _put_back(blocks: Gram, name: str, value: Array) -> Gram:
    """The blocks with what a group of that value explains back in the innovation."""
    turn = np.eye(blocks.blocks.shape[1])
    turn[blocks.groups[name], -1] = value
    return replace(blocks, blocks=turn.T @ blocks.blocks @ turn)


def _alone(lost: Array, won: Array, count: int, scatter: float) -> bool:
    """Whether fifths say much more of a group than the others know, too little for a gain.

    lost, won (FOLDS,): `_exchanged`, of `count` coefficients
    scatter: times which is lost in noise as it is
    """
    if lost.sum() <= _LOST * count:
        return False
    there = scatter * lost > np.maximum(won / 2, won.sum() / 10)
    return bool(scatter * lost.sum() > won.sum() / 2 or there.any())


def _exchanged(
    blocks: Gram, known: list[str], name: str, value: Array, scale: Array
) -> tuple[Array, Array]:
    """What each fifth loses because the others do not know it exactly, and wins.

    (FOLDS,) each, twice in nats, of white noise.
    """
    lost, won = [], []
    for training, test in one_by_one(len(blocks)):
        others = blocks.rows(training)
        seen = others.project(known)
        where = seen.groups[name]
        information = seen.total[where, where] + np.diag(1.0 / (PRIOR * scale) ** 2)
        there = blocks.rows(test).project(known, others.total).total[where, where]
        lost.append(float(np.trace(np.linalg.solve(information, there))))
        won.append(float(value @ there @ value))
    return np.array(lost), np.array(won)


def _scatter(fit: NullFit) -> float:
    """By how much more than in white noise what is known of one part is off in another.

    A room's field is another one where the vehicle was put down: a step that came just before is
    known from there far less well than white noise would have it.
    """
    rate_hz = 1.0 / float(np.nanmedian(fit.filtered.track.dt_s))
    return max(1.0, colour(fit.filtered.whitened, rate_hz))
