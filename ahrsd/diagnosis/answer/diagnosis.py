"""The answer of a diagnosis, field for field as the contract's section 5, and what a report draws.

`to_json` gives the contract's object; arrays and working values are left out of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ahrsd.diagnosis.model import Noise, NullModel, Term
from ahrsd.diagnosis.where_and_when.locate import Located
from ahrsd.samples import Array

SCHEMA = "ahrsd.diagnosis/1"


@dataclass(frozen=True, slots=True)
class Baseline:
    """How well the calibration alone predicts; NIS is 1 where model and noise are right."""

    heldout_rms_gauss: float
    heldout_nll_per_sample: float
    normalised_innovation: float


@dataclass(frozen=True, slots=True)
class Share:
    """A name with its probability."""

    effect: str
    confidence: float


@dataclass(frozen=True, slots=True)
class Where:
    """The address of a mismatch.  frame: sensor, world, gyro, link or noise."""

    intervals_s: tuple[tuple[float, float], ...]
    axes: tuple[str, ...]
    frame: str
    regime: str | None = None
    band_hz: tuple[float, float] | None = None
    direction: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class Value:
    """One coefficient with its standard deviation."""

    name: str
    value: float
    std: float
    unit: str


@dataclass(frozen=True, slots=True)
class Heldout:
    """What the model gains on blocks that it was not fitted to.

    placebo_gain: that of the same effect moved in time (99th percentile), nats per sample
    """

    rms_before_gauss: float
    rms_after_gauss: float
    nll_gain_per_sample: float
    placebo_gain: float


@dataclass(frozen=True, slots=True)
class Cost:
    """What the calibration would be off by without the effect in the model."""

    hard_iron_shift_gauss: float
    heading_error_deg: float


@dataclass(frozen=True, slots=True)
class Assumed:
    """The log odds of an answer where one thing that was assumed is half and twice as much."""

    what: str
    half_nats: float
    double_nats: float


@dataclass(frozen=True, slots=True)
class OnPriors:
    """How an answer depends on what was assumed before any reading.

    log_odds: of it, nats, to what is likeliest without it;  asked: from which on it is told
    stays: whether it is told whichever of these is half or twice as much
    """

    log_odds: float
    asked: float
    stays: bool
    assumed: tuple[Assumed, ...]


@dataclass(frozen=True, slots=True)
class Finding:
    """One named effect.

    heldout, cost_if_left_out: None, and no key in the answer, for what was counted and not fitted
    term: its number among the terms of the repaired model, likewise
    priors: likewise, where the odds are no posterior's
    """

    effect: str
    confidence: float
    alternatives: tuple[Share, ...]
    where: Where
    parameters: tuple[Value, ...]
    heldout: Heldout | None
    cost_if_left_out: Cost | None
    separate_from: str | None
    words: str = ""
    equation: str = ""
    setting: dict[str, Any] = field(default_factory=dict)
    evidence_nats: float = 0.0
    term: int | None = None
    priors: OnPriors | None = None


@dataclass(frozen=True, slots=True)
class Suspect:
    """A logged channel that moves with an unexplained course."""

    channel: str
    correlation: float
    p_value: float


@dataclass(frozen=True, slots=True)
class Component:
    """One part of what is left, beside what recordings ordinarily leave of it.

    size:    deviation over the recording, in `unit`;  up_to: what ordinary recordings leave
    heading_deg: deviation of a level vehicle's heading by it; None of the gyro's errors
    evidence_nats: by which the recording is likelier with it;  there: whether that is enough
    """

    component: str
    words: str
    frame: str
    size: float
    up_to: float
    unit: str
    heading_deg: float | None
    evidence_nats: float
    there: bool


@dataclass(frozen=True, slots=True)
class Ordinary:
    """The size of what is left beside what real recordings ordinarily leave.

    within: whether it is ordinary;  why: in a sentence, if it is not
    field_gauss, heading_deg, gyro_rad_s: everything together, and what ordinary recordings leave
    recordings: untouched real recordings that this was measured on
    """

    within: bool
    why: str | None
    field_gauss: float
    field_up_to_gauss: float
    heading_deg: float
    heading_up_to_deg: float
    gyro_rad_s: float
    gyro_up_to_rad_s: float
    recordings: int
    components: tuple[Component, ...]


@dataclass(frozen=True, slots=True)
class Unexplained:
    """What the library has no name for: located, with its course in time.

    detected: whether it is there and, where `ordinary` is known, beyond what is ordinary
    course: (time in s, value in `unit`) of one source along `where.direction`, about its mean
    """

    detected: bool
    where: Where | None = None
    heldout: Heldout | None = None
    size: float | None = None
    unit: str = ""
    single_source_share: float | None = None
    follows: tuple[Suspect, ...] = ()
    evidence_nats: float = 0.0
    course: tuple[tuple[float, float], ...] = ()
    ordinary: Ordinary | None = None
    priors: OnPriors | None = None


@dataclass(frozen=True, slots=True)
class Check:
    """One statistic of the recording against simulations of the null and the repaired model."""

    value: float
    band: tuple[float, float]
    inside_before: bool
    inside_after: bool


@dataclass(frozen=True, slots=True)
class Whiteness:
    """A test of the innovations that needs no idea of what may be wrong.

    p_before, p_after: its probability if nothing were left out, for the null and the repaired model
    """

    words: str
    p_before: float
    p_after: float


@dataclass(frozen=True, slots=True)
class Limit:
    """The smallest effect that this recording would have shown, per parameter; None: not at all."""

    effect: str
    parameter: str
    smallest: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Validation:
    """What whole models gain over the calibration alone where nothing was fitted.

    Nats per recorded sample.  named: all names together, each fifth of the recording from the other
    four;  free: what the names leave, drawn freely, beside them, from every second stretch;
    placebo: the largest gain of a name that was moved in time
    """

    named: float
    free: float
    placebo: float


@dataclass(frozen=True, slots=True)
class RegimeMap:
    """How much is left under which conditions: one quantity in bins with equally many samples.

    edges: (bins + 1,);  before, after: (bins,) nats that a field of the bin's own gains beside the
    calibration, and beside the repaired model; noise alone has 1.5
    """

    quantity: str
    edges: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """What a term adds to the readings: time_s (N,), added (N, 3) in `unit`, gauss or rad/s."""

    effect: str
    time_s: Array
    added: Array
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What the report draws; rows as in the (thinned) track.

    time_s (N,); before, after (N, 3): whitened innovations of the null and the repaired model;
    before_gauss, after_gauss (N, 3): the same as they are, reading less what was expected;
    contributions: of the repaired model's terms, in their order;  courses: the agnostic frames'
    after the named terms;  evidence: nats of every candidate in the first round, best setting.
    """

    time_s: Array
    before: Array
    after: Array
    before_gauss: Array
    after_gauss: Array
    contributions: tuple[Contribution, ...]
    courses: tuple[Located, ...]
    evidence: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """The whole answer.

    undecided: why nothing can be told, None where it can: then it says neither yes nor no
    model, noise, terms: the repaired model, of single samples
    """

    recording: str
    baseline: Baseline | None
    mismatch: bool
    p_value: float
    findings: tuple[Finding, ...]
    unexplained: Unexplained
    posterior_predictive: dict[str, Check]
    sensitivity: tuple[Limit, ...] = ()
    notes: tuple[str, ...] = ()
    model: NullModel | None = None
    noise: Noise | None = None
    terms: tuple[Term, ...] = ()
    drawn: Drawn | None = None
    omnibus: dict[str, Whiteness] = field(default_factory=dict)
    validation: Validation | None = None
    regime_map: tuple[RegimeMap, ...] = ()
    undecided: str | None = None

    @property
    def failed_checks(self) -> list[str]:
        """Statistics in which the recording is not like simulations of the repaired model."""
        return [k for k, check in self.posterior_predictive.items() if not check.inside_after]

    def to_json(self) -> dict[str, Any]:
        """The contract's object, and what is beside it: tests, maps, notes, the repaired model."""
        out: dict[str, Any] = {
            "schema": SCHEMA,
            "recording": self.recording,
            "baseline": _plain(self.baseline),
            "mismatch": self.mismatch,
            "p_value": self.p_value,
            "findings": [_told(finding) for finding in self.findings],
            "unexplained": _measured(self.unexplained, ("priors",)),
            "posterior_predictive": {k: _plain(v) for k, v in self.posterior_predictive.items()},
            "omnibus": {k: _plain(v) for k, v in self.omnibus.items()},
            "validation": _plain(self.validation),
            "regime_map": [_plain(one) for one in self.regime_map],
            "sensitivity": [_plain(limit) for limit in self.sensitivity],
            "notes": list(self.notes),
        }
        if self.undecided is not None:
            out["undecided"] = self.undecided
        if self.model is not None:
            out["model"] = {**_plain(self.model), "terms": [_plain(term) for term in self.terms]}
        return out


def _told(finding: Finding) -> dict[str, Any]:
    """A finding without the keys of what was not measured."""
    return _measured(finding, ("heldout", "cost_if_left_out", "term", "priors"))


def _measured(record: Any, optional: tuple[str, ...]) -> dict[str, Any]:  # noqa: ANN401 - as below
    """A record without the keys of these that were not measured."""
    out: dict[str, Any] = _plain(record)
    return {k: value for k, value in out.items() if value is not None or k not in optional}


def _plain(value: Any) -> Any:  # noqa: ANN401 - any of the records above
    """Dataclasses to dictionaries, arrays to lists, numbers to Python's own."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value
