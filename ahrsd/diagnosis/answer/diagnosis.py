"""The answer of a diagnosis, as in section 5 of the contract, and the data of the report.

`to_json` gives the contract's object, without arrays and working values.
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
    """An effect with its probability."""

    effect: str
    confidence: float


@dataclass(frozen=True, slots=True)
class Where:
    """Where a mismatch acts.  frame: sensor, world, gyro, link or noise."""

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
    """Predictive gain of the model on blocks that it was not fitted to.

    placebo_gain: that of the best of the time-shifted copies of the effect, nats per sample
    """

    rms_before_gauss: float
    rms_after_gauss: float
    nll_gain_per_sample: float
    placebo_gain: float


@dataclass(frozen=True, slots=True)
class Cost:
    """Error of the calibration if the effect is left out of the model."""

    hard_iron_shift_gauss: float
    heading_error_deg: float


@dataclass(frozen=True, slots=True)
class Assumed:
    """The log odds of an answer if one prior assumption is halved and doubled."""

    what: str
    half_nats: float
    double_nats: float


@dataclass(frozen=True, slots=True)
class OnPriors:
    """Prior sensitivity of an answer.

    log_odds: of the answer against the most probable one without it, nats;  asked: the threshold
    from which it is reported
    stays: whether it is reported with each assumption halved and doubled
    """

    log_odds: float
    asked: float
    stays: bool
    assumed: tuple[Assumed, ...]


@dataclass(frozen=True, slots=True)
class Finding:
    """One effect of the library that was found.

    heldout, cost_if_left_out: None, and no key in the answer, for what was counted and not fitted
    term: index among the terms of the repaired model, likewise
    priors: likewise, where the odds are not those of a posterior
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
    """A logged channel that correlates with an unexplained time series."""

    channel: str
    correlation: float
    p_value: float


@dataclass(frozen=True, slots=True)
class Component:
    """One part of the residual, compared with what recordings ordinarily leave of it.

    size:    standard deviation over the recording, in `unit`
    up_to:   what ordinary recordings leave
    heading_deg: deviation of a level vehicle's heading by it; None for errors of the gyro
    evidence_nats: log evidence for it;  there: whether that is enough
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
    """Size of the residual, compared with what real recordings ordinarily leave.

    within: whether it is ordinary;  why: in a sentence, if it is not
    field_gauss, heading_deg, gyro_rad_s: all parts together, and what ordinary recordings leave
    recordings: number of untouched real recordings on which this was measured
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
    """A mismatch that is no effect of the library: where it is, and its time series.

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
    """A test of the innovations without an alternative hypothesis.

    p_before, p_after: its p-value for the null and the repaired model
    """

    words: str
    p_before: float
    p_after: float


@dataclass(frozen=True, slots=True)
class Limit:
    """The smallest effect that this recording would have shown, by parameter; None: none."""

    effect: str
    parameter: str
    smallest: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Validation:
    """Predictive gain of whole models over the calibration alone, on readings not used for the fit.

    Nats per recorded sample.  named: all effects together, each fifth of the recording from the
    other four;  free: with them, a free time series for the residual, from every second segment;
    placebo: the largest gain of an effect that was shifted in time
    """

    named: float
    free: float
    placebo: float


@dataclass(frozen=True, slots=True)
class RegimeMap:
    """Residual by condition: one quantity in bins of equally many samples.

    edges: (bins + 1,)
    before, after: (bins,) nats that a constant field of the bin gains, with the calibration alone
    and with the repaired model; noise alone gains 1.5
    """

    quantity: str
    edges: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """What an effect adds to the readings: time_s (N,), added (N, 3) in `unit`, gauss or rad/s."""

    effect: str
    time_s: Array
    added: Array
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What the report draws; rows as in the (thinned) track.

    time_s (N,); before, after (N, 3): whitened innovations of the null and the repaired model;
    before_gauss, after_gauss (N, 3): the same without whitening, reading less prediction;
    contributions: of the repaired model's terms, in their order;  courses: the piecewise constant
    fields of the three frames, given the effects;  evidence: nats of every candidate in the first
    round, at its best setting.
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

    undecided: why the recording cannot be judged; None where it can
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
        """Statistics in which the recording differs from simulations of the repaired model."""
        return [k for k, check in self.posterior_predictive.items() if not check.inside_after]

    def to_json(self) -> dict[str, Any]:
        """The contract's object, and additional keys: tests, maps, notes, the repaired model."""
        out: dict[str, Any] = {
            "schema": SCHEMA,
            "recording": self.recording,
            "baseline": _to_plain(self.baseline),
            "mismatch": self.mismatch,
            "p_value": self.p_value,
            "findings": [_finding_json(finding) for finding in self.findings],
            "unexplained": _without_missing(self.unexplained, ("priors",)),
            "posterior_predictive": {k: _to_plain(v) for k, v in self.posterior_predictive.items()},
            "omnibus": {k: _to_plain(v) for k, v in self.omnibus.items()},
            "validation": _to_plain(self.validation),
            "regime_map": [_to_plain(one) for one in self.regime_map],
            "sensitivity": [_to_plain(limit) for limit in self.sensitivity],
            "notes": list(self.notes),
        }
        if self.undecided is not None:
            out["undecided"] = self.undecided
        if self.model is not None:
            out["model"] = {
                **_to_plain(self.model),
                "terms": [_to_plain(term) for term in self.terms],
            }
        return out


def _finding_json(finding: Finding) -> dict[str, Any]:
    """A finding without the keys of what was not measured."""
    return _without_missing(finding, ("heldout", "cost_if_left_out", "term", "priors"))


def _without_missing(record: Any, optional: tuple[str, ...]) -> dict[str, Any]:  # noqa: ANN401
    """A record as a dictionary, without those optional keys that are None."""
    out: dict[str, Any] = _to_plain(record)
    return {k: value for k, value in out.items() if value is not None or k not in optional}


def _to_plain(value: Any) -> Any:  # noqa: ANN401 - any of the records above
    """Dataclasses to dictionaries, arrays to lists, numbers to Python's own."""
    if isinstance(value, np.ndarray):
        return [_to_plain(item) for item in value.tolist()]
    if isinstance(value, np.generic):
        return _to_plain(value.item())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, tuple | list):
        return [_to_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _to_plain(item) for key, item in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {name: _to_plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value
