"""A named term as a finding: set, address, parameters, held-out gain, cost, what would separate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.answer.added_field import heading_error_deg
from ahrsd.diagnosis.answer.confound import separating_manoeuvre
from ahrsd.diagnosis.answer.diagnosis import Cost, Finding, Heldout, Share, Value, Where
from ahrsd.diagnosis.calibration_fit.delay import usual_step
from ahrsd.diagnosis.innovation_filter.evidence import posterior
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.delays import DELAYS, time_constant_less_lag, weighed
from ahrsd.diagnosis.rules.heldout import gain_of
from ahrsd.diagnosis.rules.itself import beside_itself
from ahrsd.diagnosis.rules.name import LONELY_BLOCKS, Judged
from ahrsd.diagnosis.rules.regression import CALIBRATION, Base, Candidate, candidate_gram
from ahrsd.diagnosis.rules.reweighted import stepped
from ahrsd.diagnosis.rules.search import (
    COUNTERPART_NATS,
    WANDERING,
    State,
    Survey,
    counterpart,
    in_its_place,
    term_group,
)
from ahrsd.diagnosis.rules.settings import scale_of, scaled
from ahrsd.diagnosis.rules.unknown import innovation_rms
from ahrsd.diagnosis.rules.validate import Gain, alternating, heldout
from ahrsd.diagnosis.values import NullModel, Term
from ahrsd.diagnosis.where_and_when.address import where_of
from ahrsd.estimator.locked import TRACELESS
from ahrsd.samples import Array

#: shares below this are not worth a line
SMALLEST_SHARE = 0.005
_SCALE_STEP = 0.05
#: seconds to which the onset of what creeps is known: a device that updates every few of them goes
#: in steps, and one that ran before the recording began creeps from before
CREEPS_S = 5.0
#: deviations by which two weightings of one recording differ at most where the model is true
AGREE = 3.0
#: odds of a gyro whose axes share one error of scale, to a clock of that error
COMMON_SCALE = 0.5
#: power to which shares of names are raised: noise is taken for coloured wherever it may be, which
#: makes evidence less than it is.  Of names with a near rival 15 of 16 were right in opened trials
#: at a mean share of .73, then 13 of 13 at .77 in those of another ring; no more of the two is used
#: than a prior of a factor of 1.5 either way leaves
SHARPER = 1.5
#: seconds that are dealt in turn where an effect shows no longer than some of them
SECOND_S = 1.0


def finding(
    state: State,
    basis: Base,
    number: int,
    seen: Survey,
    last: Survey,
    beside: Base | None = None,
) -> Finding:
    """The finding of term `number`.

    basis: of the whole model;  seen: the survey without the term;  last: with all terms
    beside: the basis against the spectrum of what is left, if that is more than noise
    """
    judged, library = state.named[number], state.problem.library
    shares = _delay_shares(state, basis, number, beside) or shares_of(state, number, seen, last)
    term = whole_term(state, basis, number, next(iter(shares)), beside)
    effect = library[term.identifier]
    alternatives = tuple(
        Share(name, share) for name, share in shares.items() if name != effect.identifier
    )[:4]
    parameters = tuple(
        Value(p.name, float(v), float(d), p.unit)
        for p, v, d in zip(effect.parameters, term.value, term.deviation, strict=True)
    )
    close = [share.effect for share in alternatives if share.confidence > 0.05]
    return Finding(
        effect=effect.identifier,
        confidence=shares[effect.identifier],
        alternatives=tuple(a for a in alternatives if a.confidence > SMALLEST_SHARE),
        where=where(judged, added_value(state, number), basis),
        parameters=parameters,
        heldout=_heldout(state, basis, number, with_all_else(judged, seen)),
        cost_if_left_out=cost(basis, number, added_value(state, number)),
        separate_from=separating_manoeuvre(library, effect.identifier, close) if close else None,
        words=effect.words,
        equation=effect.equation,
        setting=term.setting,
        evidence_nats=judged.evidence,
        term=number,
    )


def added_value(state: State, number: int) -> Array:
    """(p,) a term's whole value: a delay's includes what was taken out of the track."""
    value = state.fit.terms[number].value
    return np.array([state.lag_s(number)]) if _is_delay(state, number) else value


def whole_term(
    state: State,
    basis: Base,
    number: int,
    name: str | None = None,
    beside: Base | None = None,
) -> Term:
    """A fitted term as it is told: whole value, deviations for the noise as coloured as it is.

    name: what a delay is called in the end
    """
    term = state.fit.terms[number]
    told = _told_in(state, basis, number, beside)
    shape = _by_shape(state, told, number)
    change, deviation = refined(told, number, shape)
    if shape is not None and shape.shape[2] > 1:  # the value goes with the onset that is told
        change = refined(told, number, shape[:, :, :1])[0]
    if told is not basis:
        deviation = of_both(change, deviation, refined(basis, number)[1])
    value = added_value(state, number) + change
    deviation = with_unseen(state.named[number].candidate, deviation)
    setting = {k: v for k, v in term.setting.items() if k != "searched"}
    if not _is_delay(state, number):
        return Term(term.identifier, value, deviation, setting)
    name = name or term.identifier
    if name == "gyro_integration":
        half_s = float(np.nanmedian(state.problem.recorded.dt_s)) / 2
        return Term(name, value / half_s, deviation / half_s, {})
    if name == "mag_low_pass":
        value = value + time_constant_less_lag(basis, term_group(number), float(value[0]))
        setting = {"time_constant_s": float(value[0])}
    return Term(name, value, deviation, setting)


def of_both(change: Array, deviation: Array, before: Array) -> Array:
    """(p,) deviations that hold what two weightings of one recording disagree in.

    change: from the value in the one to that in the other;  before, deviation: of the two.  Where
    the model is true they differ by no more than both are uncertain.  A cause that was logged with
    noise is told too small by the one that looks at quick changes, with a deviation that knows
    nothing of it.
    """
    excess = np.maximum(np.abs(change) - AGREE * np.hypot(deviation, before), 0.0)
    return np.asarray(np.hypot(deviation, excess))


def with_unseen(candidate: Candidate, deviation: Array) -> Array:
    """(p,) deviations with the prior's in the directions that no motion shows."""
    directions = np.array(candidate.effect.unseen).reshape(-1, len(deviation))
    prior = np.sum((directions * candidate.scale) ** 2, axis=0)
    return np.asarray(np.sqrt(deviation**2 + prior))


def _by_shape(state: State, basis: Base, number: int) -> Array | None:
    """(N, 3, q) whitened change of the term with what else was fitted of it; None for nothing.

    The logarithm of its scale; and of what creeps from an onset on the onset, in `CREEPS_S`.
    """
    candidate, value = state.named[number].candidate, state.fit.terms[number].value
    key = scale_of(candidate)
    if key is None:
        return None
    effect, setting = candidate.effect, candidate.setting
    sides = [scaled(setting, key, change) for change in (-_SCALE_STEP, _SCALE_STEP)]
    steps = [2 * _SCALE_STEP]
    if key == "time_constant_s" and "onset_s" in setting:
        step_s = _SCALE_STEP * setting[key]
        sides += [{**setting, "onset_s": setting["onset_s"] + s} for s in (-step_s, step_s)]
        steps.append(2 * step_s / CREEPS_S)
    seen = [
        part @ value for part in basis.whitened([effect.columns(basis.context, s) for s in sides])
    ]
    changes = [(seen[2 * k + 1] - seen[2 * k]) / step for k, step in enumerate(steps)]
    return np.stack(changes, axis=2)


def _told_in(state: State, basis: Base, number: int, beside: Base | None) -> Base:
    """The basis in which a term was fitted, and is told."""
    if beside is None:
        return basis
    if _is_delay(state, number):
        return beside_itself(beside, state.names)
    return basis if stepped(state) else beside


def refined(basis: Base, number: int, shape: Array | None = None) -> tuple[Array, Array]:
    """What is left to change in a term's value (p,), and its deviation (p,) in coloured noise.

    shape (N, 3, q): how the whitened readings move with the term's time constant or radius, which
    was fitted too, and with its onset, if that is a second, known to about 1 of its units.
    """
    Z = basis.known.reshape(-1, basis.known.shape[2])
    if shape is not None:
        Z = np.column_stack([Z, shape.reshape(len(Z), -1)])
    where = basis.groups[term_group(number)]
    G = Z.T @ Z
    if shape is not None and shape.shape[2] > 1:
        G[-1, -1] += 1.0
    inverse = solve(G, np.column_stack([Z.T @ basis.innovation.ravel(), np.eye(len(G))]))
    variance = np.diag(inverse[:, 1:])[where]
    return inverse[where, 0], np.sqrt(np.maximum(variance, 0.0) * basis.colour)


def _is_delay(state: State, number: int) -> bool:
    return state.named[number].candidate.name in DELAYS


def _delay_shares(
    state: State, basis: Base, number: int, beside: Base | None
) -> dict[str, float] | None:
    if not _is_delay(state, number):
        return None
    term = state.fit.terms[number]
    told = _told_in(state, basis, number, beside)
    change, deviation = (float(part[0]) for part in refined(told, number))
    recorded = usual_step(state.problem.recorded.dt_s)
    lag_s = DELAYS[term.identifier] * (state.lag_s(number) + change)
    return weighed(basis, state.problem.library, lag_s, deviation, recorded)


def contribution(judged: Judged, value: Array, basis: Base) -> Array:
    """(N, 3) what the term adds to the readings: gauss, or rad/s where it acts on the gyro."""
    columns = judged.candidate.effect.columns(basis.context, judged.candidate.setting)
    matrix = columns.mag if columns.mag is not None else columns.gyro
    if matrix is None:
        return np.zeros((len(basis.innovation), 3))
    return np.asarray(matrix @ value)


def where(judged: Judged, value: Array, basis: Base) -> Where:
    """When and on which axes the term acts."""
    effect = judged.candidate.effect
    added = contribution(judged, value, basis)
    frame = effect.frame or effect.family
    return where_of(basis.context.track, added, judged.candidate.setting, frame)


def cost(basis: Base, number: int, value: Array) -> Cost:
    """How far the calibration moves when it has to take over what the term explains."""
    flat = basis.known.reshape(-1, basis.known.shape[2])
    Z, X = flat[:, basis.groups[CALIBRATION]], flat[:, basis.groups[term_group(number)]]
    shift = solve(Z.T @ Z, (Z.T @ (X @ value))[:, None])[:, 0]
    model = basis.context.model
    moved = NullModel(
        model.soft_iron + np.einsum("a,aij->ij", shift[:5], TRACELESS),
        model.hard_iron_gauss + shift[5:8],
        model.gyro_bias_rad_s + shift[8:11],
        model.sigma_mag_gauss,
        model.sigma_gyro_rad_s,
    )
    return Cost(
        float(np.linalg.norm(shift[5:8])), heading_error_deg(moved, model, basis.context.field_b)
    )


def shares_of(state: State, number: int, seen: Survey, last: Survey) -> dict[str, float]:
    """Every name's share of the probability of being what the term explains; the term's first."""
    judged = state.named[number]
    mine = judged.candidate.name
    lead = COUNTERPART_NATS if counterpart(state, number) is not None else 0.0
    evidence = {c.name: in_its_place(c, last) for c in seen.candidates if c.name != mine}
    own = [c.evidence for c in seen.candidates if c.name == mine]
    evidence = {mine: lead + max([judged.evidence, *own]), **evidence}
    found = posterior(_with_common({k: SHARPER * nats for k, nats in evidence.items()}), {})
    rest = {k: v for k, v in sorted(found.items(), key=lambda item: -item[1]) if k != mine}
    return {mine: found[mine], **rest}


def _with_common(nats: Mapping[str, float]) -> dict[str, float]:
    """The same, a gyro's scale as likely as three numbers or as one that all axes share.

    As one it is a clock's error to the last digit; only the host's time tells.
    """
    if not {"clock_rate", "gyro_scale"} <= nats.keys():
        return dict(nats)
    common = nats["clock_rate"] + float(np.log(COMMON_SCALE))
    return {**nats, "gyro_scale": max(nats["gyro_scale"], common)}


def with_all_else(judged: Judged, seen: Survey) -> Judged:
    """The name judged beside all the others with the noise that they leave, where it was."""
    mine = (j for j in seen.judged if j.candidate.name == judged.candidate.name)
    return next(mine, judged)


def _heldout(state: State, basis: Base, number: int, judged: Judged) -> Heldout:
    """Gains per recorded sample, of which `thin` are one of the search's.

    Of fifths of the recording; where those know too little of each other the gate's own gain, and
    of what so few of the gate's blocks show that they do not know each other either, by the second.
    """
    wanders = state.walk > 0.0 and judged.candidate.name in WANDERING
    value, scale = added_value(state, number), judged.candidate.scale
    gain = gain_of(state.fit, number, value, scale, wanders=wanders)
    if gain is None:
        brief = judged.what.effective_blocks < LONELY_BLOCKS
        gain = _within_seconds(basis, number, value, scale) if brief else judged.gain
    rms, thin = innovation_rms(basis), state.problem.thin
    ratio = gain.before / max(gain.after, 1e-12)
    before = rms * float(np.sqrt(max(ratio, 0.0)))
    return Heldout(before, rms, gain.nats_per_sample / thin, judged.placebo_gain / thin)


def _within_seconds(basis: Base, number: int, value: Array, scale: Array) -> Gain:
    """The gain on every second second of a name that shows for a few seconds alone.

    What the outside field does at once the filter has followed before a stretch is over; then no
    stretch knows of it what another needs, and what is told of the gain is chance.
    """
    name = term_group(number)
    columns = {name: basis.known[:, :, basis.groups[name]]}
    gram = candidate_gram(basis.without(name, value), columns, SECOND_S)
    known = [group for group in basis.groups if group != name]
    return heldout(gram, known, name, scale, alternating)
