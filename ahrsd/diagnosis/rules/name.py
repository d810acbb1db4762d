"""Which name may be given: the acceptance gate, the ranking, the set that cannot be told apart.

Evidence ranks; it does not accept.  A candidate is named only if its family-wise score and robust
tests, its evidence, its held-out gain, its time-shifted copies and its physical bounds all allow
it: on a real drone log the score test alone would name four terms, this gate one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis.effects.base import BOUND_DEVIATIONS
from ahrsd.diagnosis.innovation_filter.evidence import log_bayes, posterior
from ahrsd.diagnosis.innovation_filter.gram import Gram
from ahrsd.diagnosis.innovation_filter.score import Score, score, total_score
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules.regression import Base, Candidate, without_known
from ahrsd.diagnosis.rules.score import chi2_p, robust_p, shift_statistics
from ahrsd.diagnosis.rules.settings import evidence_of
from ahrsd.diagnosis.rules.validate import Gain, heldout
from ahrsd.samples import Array

#: shifts shorter than this are the effect itself a moment later
MINIMUM_SHIFT_SHARE = 0.05
#: what fewer blocks than this show cannot be known from the others: a jump of the outside field,
#: which the filter follows within seconds; nats beyond all doubt then stand for the held-out gain
LONELY_BLOCKS, LONELY_NATS = 5.0, 20.0
#: deviations beyond which a reading says no more: three axes of it are 13 nats, a place costs them
OUTLIER = 3.0
#: a play of this many deviations of a reading or less follows the noise as well; what it explains
#: of that is as wide as the filter's errors: a quarter of a deviation in red noise
NARROW, LEAST_WIDTH = 5.0, 0.5
#: the check that needs many blocks
ROBUST = "block-robust probability"
#: what is shorter turns too little to tell a field outside from one on the vehicle
LONELY_S = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A candidate with all that the gate looks at; `refused` names what it failed."""

    candidate: Candidate
    what: Score
    evidence: float
    family_p: float
    robust_family_p: float
    gain: Gain
    placebo_beaten: float
    placebo_gain: float
    refused: tuple[str, ...]

    @property
    def accepted(self) -> bool:
        """Whether it may be named."""
        return not self.refused


def ranked(basis: Base, quiet: Base, candidates: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """The candidates in the noise that the strongest of them leaves, strongest first.

    What an effect does is no noise: told as if it were, a name of three coefficients may lead one
    of nine that explains more by thirty nats.
    """
    if quiet.colour >= basis.colour:
        return tuple(candidates)
    louder = [
        replace(c, evidence=c.evidence + evidence_of(quiet, c) - evidence_of(basis, c))
        if np.isfinite(c.evidence)
        else c
        for c in candidates
    ]
    return tuple(sorted(louder, key=lambda c: -c.evidence))


def judge(
    candidate: Candidate,
    gram: Gram,
    columns: Array,
    basis: Base,
    tried: int,
    limits: Limits,
) -> Judged:
    """Hold one candidate against the gate.

    gram: with the known groups in;  columns (N, 3, p) whitened;  tried: size of the library
    """
    known = list(basis.groups)
    what = score(
        gram.select([*known, candidate.name]).project(known),
        candidate.name,
        candidate.scale,
        candidate.effect.least_information,
    )
    evidence = log_bayes(what, basis.colour) - candidate.paid
    tests = tried * candidate.tried
    family = min(1.0, tests * chi2_p(what, basis.colour))
    robust = min(1.0, tests * robust_p(what, basis.colour))
    gain = heldout(gram, known, candidate.name, candidate.scale)
    own, left = without_known(basis, columns)
    found, shifted = shift_statistics(own, left, round(MINIMUM_SHIFT_SHARE * len(columns)))
    beaten = float(np.mean(shifted < found)) if len(shifted) else 1.0
    lonely = _lonely(candidate, what, evidence)
    checks = (
        ("family-wise probability", family < limits.family_p),
        (ROBUST, robust < limits.robust_family_p),
        ("evidence", evidence > limits.evidence_nats),
        ("held-out gain", gain.nats_per_sample > limits.cv_gain or lonely),
        ("without outliers", _without_outliers(candidate, own, left, basis) > limits.evidence_nats),
        ("time-shifted copies", beaten >= limits.placebo_beaten or _periodic(candidate)),
        ("own noise", not _of_own_noise(candidate, what.value, basis)),
        ("physical bounds", believable(candidate, what, what.value, basis.colour)),
    )
    usual = float(np.quantile(shifted, 0.99)) if len(shifted) else 0.0
    return Judged(
        candidate,
        what,
        evidence,
        family,
        robust,
        gain,
        beaten,
        max(0.0, (usual - what.rank) / (2.0 * len(columns))),
        tuple(name for name, passed in checks if not passed),
    )


def believable(candidate: Candidate, what: Score, value: Array, colour: float) -> bool:
    """Whether no coefficient (p,) is beyond its physical bound by more than noise brings it there.

    Where the calibration takes nearly all of an effect, the little that is left knows a coefficient
    at its bound to a tenth or worse.  What is known to half of its bound only is not known: a mount
    of 40 degrees, in a spin that shows next to nothing of mounts.
    """
    bounds = np.array([parameter.bound for parameter in candidate.effect.parameters])
    least = np.array([parameter.least for parameter in candidate.effect.parameters])
    sigma = np.sqrt(np.diag(what.covariance) * colour) if what.rank else np.zeros(len(bounds))
    slack = np.minimum(BOUND_DEVIATIONS * sigma, bounds / 2)
    return bool(np.all(np.abs(value) <= bounds + slack) and np.all(value >= least - slack))


def _without_outliers(candidate: Candidate, columns: Array, left: Array, basis: Base) -> float:
    """Evidence where no reading says more than one of OUTLIER deviations.

    A handful of wild readings at the turn of a recording is an object passed by, or a jump, to
    whatever has a column that is large just there.
    """
    most = OUTLIER * 1.4826 * max(float(np.median(np.abs(left))), 1e-300)
    flat, readings = columns.reshape(-1, columns.shape[2]), np.clip(left, -most, most).ravel()
    G = flat.T @ flat
    least = candidate.effect.least_information
    what = total_score(G, flat.T @ readings, np.diag(G), candidate.scale, least)
    return log_bayes(what, basis.colour) - candidate.paid


def _of_own_noise(candidate: Candidate, value: Array, basis: Base) -> bool:
    """Whether a play is no wider than the errors of the field that it is made of."""
    noise = basis.context.model.sigma_mag_gauss
    narrow = candidate.setting.get("radius_gauss", np.inf) < NARROW * noise
    return bool(narrow and np.max(np.abs(value), initial=0.0) < LEAST_WIDTH * noise)


def _periodic(candidate: Candidate) -> bool:
    """Whether it repeats so regularly that a copy moved in time is itself again: a steady line."""
    return any(key in candidate.setting for key in ("frequency_hz", "harmonic", "period_s"))


def _lonely(candidate: Candidate, what: Score, evidence: float) -> bool:
    """Whether a field outside shows in so few blocks that no others can know it, beyond doubt."""
    outside = candidate.effect.family == "world"
    outside &= candidate.setting.get("length_s", np.inf) > LONELY_S
    return bool(outside and what.effective_blocks < LONELY_BLOCKS and evidence > LONELY_NATS)


def confusable(evidence: Mapping[str, float], name: str, lead_nats: float) -> dict[str, float]:
    """`name` and all within `lead_nats` of it, with their shares of the probability."""
    near = {k: v for k, v in evidence.items() if v > evidence[name] - lead_nats}
    return dict(sorted(posterior(near, {}).items(), key=lambda item: -item[1]))
