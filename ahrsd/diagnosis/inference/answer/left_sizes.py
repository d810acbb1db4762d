"""Sizes of the ordinary remainder, part by part, next to what real recordings ordinarily leave.

The contribution of a part is its columns times their maximum-posterior coefficients.  Its size is
the standard deviation of this contribution over the recording, less what another calibration would
explain of it.  The limit that 95 % of untouched recordings stay below is given for the same motion:
the size times the ratio of the limit of the coefficients to the coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.added_field import (
    calibration_basis,
    heading_deviation_deg,
    project_out_calibration,
    rms_about_mean,
)
from ahrsd.diagnosis.answer.diagnosis import (
    Component,
    Ordinary,
    Suspect,
    Unexplained,
)
from ahrsd.diagnosis.answer.text import SIMULATED
from ahrsd.diagnosis.inference.components.alternatives import (
    BY_HEADING,
    BY_RATE,
    BY_TILT,
    QUICK,
    factor_keys,
)
from ahrsd.diagnosis.inference.components.component import FixedLaw, ScaledLaw
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.decision.members import (
    coefficients,
    contribution_of,
    is_ordinary,
    library_members,
    size_of,
)
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult
from ahrsd.diagnosis.where_and_when import locate
from ahrsd.samples import Array

_PART_WORDS = {
    "world_course": "an outside field that varies with time and place",
    "gyro_course": "a gyro bias that varies with time",
    "by_direction": "a field that depends on attitude",
    "by_change": "magnetometer axes with different delays",
    "field_by_rate": "a field that depends on the turn rates",
    "by_rate_squared": "a gyro error that depends on the squared rates",
    "gyro_matrix": "gyro misalignment, scale and axes not at right angles",
    "by_force": "a gyro error that depends on acceleration and tilt",
    "bending": "a mount that bends under load",
    BY_RATE: "a field that depends on the turn rates",
    BY_TILT: "a field that depends on tilt",
    BY_HEADING: "a field that depends on heading",
    QUICK: "a quickly varying field on the sensor",
}
#: free processes in time, by frame
_PROCESS_WORDS = {
    "sensor": "a field on the sensor that varies with time",
    "world": "an outside field that varies with time",
    "gyro": "a gyro error that varies with time",
}
#: deviations that bound 95 % of a normal distribution
_DEVIATIONS_95 = 1.96


def with_remainder_sizes(
    all_sets: Hypotheses, answer: Answer, unexplained: Unexplained, nats: float, *, simulated: bool
) -> Unexplained:
    """The unexplained part, with the sizes of the remainder if the set contains one.

    nats: evidence of the remainder
    simulated: the recording is known to be simulated; then no remainder is ordinary
    """
    best = answer.best
    if not all_sets.is_real(best.names):
        return unexplained
    if unexplained.detected:
        parts = dict.fromkeys(_describe_part(all_sets, best, key) for key in answer.unknown)
        described = (
            ", ".join(parts)
            or "a source of one direction that varies too quickly to be followed in time"
        )
        why = f"larger than in ordinary recordings: {described}"
        sizes = remainder_sizes(all_sets, best, why, answer.unknown)
        return replace(unexplained, ordinary=sizes)
    if simulated and nats > priors.UNKNOWN_ODDS:
        sizes = remainder_sizes(all_sets, best, SIMULATED, ())
        return replace(unexplained, detected=True, ordinary=sizes, evidence_nats=nats)
    return replace(
        unexplained, ordinary=remainder_sizes(all_sets, best, None, ()), evidence_nats=nats
    )


def remainder_sizes(
    all_sets: Hypotheses, best: Hypothesis, why: str | None, keys: Sequence[str]
) -> Ordinary:
    """Sizes of everything besides the findings.

    why: reason why the remainder is not ordinary, None if it is
    keys: unknown members of the set, which are listed as well
    Effects that are no larger than is ordinary for their kind are no findings and are listed here.
    """
    ordinary_effects = [
        key
        for key in library_members(all_sets, best)
        if key not in keys and is_ordinary(all_sets, best, key)
    ]
    context = all_sets.made.context
    basis, nats = calibration_basis(context), _member_nats(all_sets, best)
    totals = {unit: np.zeros((len(context.track), 3)) for unit in ("gauss", "rad/s")}
    parts = []
    unknown = [key for key in keys if key not in all_sets.remainder]
    for key in (*all_sets.remainder, *unknown, *ordinary_effects):
        added, unit = contribution_of(all_sets, best, key)
        added = project_out_calibration(added, basis) if unit == "gauss" else added
        totals[unit] += added
        size, frame = rms_about_mean(added), all_sets.component(key).frame
        heading_deg = heading_deviation_deg(added, context) if unit == "gauss" else None
        up_to = size * _limit_ratio(all_sets, best, key)
        there = nats[key] > priors.ODDS_REAL
        part = Component(
            key,
            _describe_ordinary_effect(all_sets, key)
            if key in ordinary_effects
            else _describe_part(all_sets, best, key),
            frame,
            size,
            up_to,
            unit,
            heading_deg,
            nats[key],
            there,
        )
        parts.append(part)
    fields = [one for one in parts if one.unit == "gauss"]
    headings = [(one.heading_deg or 0.0) * one.up_to / max(one.size, 1e-300) for one in fields]
    return Ordinary(
        within=why is None,
        why=why,
        field_gauss=rms_about_mean(totals["gauss"]),
        field_up_to_gauss=_combined_limit([one.up_to for one in fields]),
        heading_deg=heading_deviation_deg(totals["gauss"], context),
        heading_up_to_deg=_combined_limit(headings),
        gyro_rad_s=rms_about_mean(totals["rad/s"]),
        gyro_up_to_rad_s=_combined_limit([one.up_to for one in parts if one.unit != "gauss"]),
        recordings=priors.RECORDINGS,
        components=tuple(parts),
    )


def _describe_part(all_sets: Hypotheses, best: Hypothesis, key: str) -> str:
    """A part in words."""
    one, effect = all_sets.component(key), key.split(maxsplit=1)[0]
    factors = {factor for name in library_members(all_sets, best) for factor in factor_keys(name)}
    if key in factors or not best.names.isdisjoint(factor_keys(key)):
        return f"a cause that {effect} resembles"
    if one.row is not None:
        return f"a step of a source that switches ({effect})"
    words = _PART_WORDS.get(key) or _PART_WORDS.get(key.removeprefix("free "))
    return words or _PROCESS_WORDS[one.frame]


def _describe_ordinary_effect(all_sets: Hypotheses, key: str) -> str:
    """An effect of ordinary size, which is no finding, in words with its times."""
    one = all_sets.component(key)
    when = " and ".join(f"{time_s:.0f} s" for time_s in one.moments_s)
    words = "" if one.row is None else one.row.words
    return f"{f'at {when} ' if when else ''}{words} ({one.effect})"


def _combined_limit(limits: Sequence[float]) -> float:
    """The ordinary limit of independent parts together."""
    return float(np.linalg.norm(limits))


def _limit_ratio(all_sets: Hypotheses, best: Hypothesis, key: str) -> float:
    """Ordinary limit of a part over its size; 0 if the part is not an ordinary one."""
    law, row = all_sets.component(key).law, all_sets.component(key).row
    if row is not None and isinstance(law, ScaledLaw):
        value, deviation = coefficients(all_sets, best, key)
        limit = row.ordinary * law.scale + 2.0 * deviation  # beyond, it is a finding (`size_of`)
        return 1.0 / max(float(np.max(np.abs(value) / limit)), 1e-12)
    if isinstance(law, FixedLaw):
        value, _ = coefficients(all_sets, best, key)
        return _DEVIATIONS_95 / max(float(np.sqrt(np.mean(value**2 / law.variance))), 1e-12)
    if key not in priors.ORDINARY:
        return 0.0
    return priors.ORDINARY[key].up_to() / max(size_of(all_sets, best, key), 1e-12)


def _member_nats(all_sets: Hypotheses, best: Hypothesis) -> dict[str, float]:
    """Log Bayes factor of each member, with sizes and noise as they are.

    For a Gaussian this is the Savage-Dickey ratio at zero coefficients: prior density to posterior.
    """
    scan = candidate_scan(all_sets.made, best.keys, best.at)
    inverse = np.linalg.inv(scan.root)
    covariance = inverse.T @ inverse
    psi, out, begin = all_sets.psi_of(best), {}, 0
    for key in best.keys:
        one = all_sets.component(key)
        mine = slice(begin, begin + one.width)
        begin = mine.stop
        mean, phi = best.at.mean[mine], one.law.log_variance(psi[key])
        out[key] = _savage_dickey_nats(mean, covariance[mine, mine], phi)
    return out


def _savage_dickey_nats(mean: Array, covariance: Array, log_variance: Array) -> float:
    """Log of the prior density at zero coefficients over the posterior density there."""
    scale = np.exp(-0.5 * log_variance)
    relative = covariance * scale * scale[:, None]
    _, log_det = np.linalg.slogdet(relative)
    z = mean * scale
    return 0.5 * float(z @ np.linalg.solve(relative, z) + log_det)


def with_correlated_channels(
    unexplained: Unexplained, found: ModelSearchResult, processes: Sequence[locate.Located]
) -> Unexplained:
    """The unexplained part, with the logged columns that correlate with it."""
    if unexplained.where is None or not unexplained.course:
        return unexplained
    frame, track = unexplained.where.frame, found.all_sets.made.context.track
    matches = [one for process in processes if process.frame == frame
            for one in locate.matching_channels(track, process)]  # fmt: skip
    follows = tuple(
        Suspect(one.channel, one.correlation, one.p_value)
        for one in matches
        if one.p_value < priors.CHANCE and abs(one.correlation) > priors.ALIKE
    )
    return replace(unexplained, follows=follows)
