"""A complete diagnosis: the findings and everything that is reported besides.

held-out gains and those of shifted copies, priors halved and doubled, residual checks, sizes of the
remainder, smallest detectable effects, the repaired model with its noise, data of the plots
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import (
    Check,
    Diagnosis,
    Finding,
    RegimeMap,
)
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, baseline_of
from ahrsd.diagnosis.data_quality.facts import Fact, as_finding
from ahrsd.diagnosis.data_quality.preparation import PreparedRecording
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.answer import pictures, residual_checks, support, visibility
from ahrsd.diagnosis.inference.answer.held_out import HeldOut
from ahrsd.diagnosis.inference.answer.left_sizes import (
    with_correlated_channels,
    with_remainder_sizes,
)
from ahrsd.diagnosis.inference.answer.repaired_noise import noise_level_facts, repaired_noise
from ahrsd.diagnosis.inference.decision.decision import Answer
from ahrsd.diagnosis.inference.decision.members import nats_of_remainder
from ahrsd.diagnosis.inference.likelihood.logged_columns import recorded_setting
from ahrsd.diagnosis.inference.recorded_rate import RecordedRateResult
from ahrsd.diagnosis.inference.search_rounds import ModelSearchResult
from ahrsd.diagnosis.model import Term

#: what has a setting by logged columns
Reported = TypeVar("Reported", Finding, Term)


def build_diagnosis(
    prepared: PreparedRecording,
    start: NullFit,
    found: ModelSearchResult,
    fast: RecordedRateResult,
    library: Mapping[str, Effect],
    rest_findings: tuple[Finding, ...],
    *,
    spec_given: bool,
    simulated: bool,
) -> Diagnosis:
    """The complete diagnosis.

    start: the calibration alone;  simulated: the recording is known to be simulated
    rest_findings: bias drift of a gyro at rest;  spec_given: whether the noise level was specified
    """
    answer, all_sets = found.answer, found.all_sets
    held, fast_held = HeldOut(all_sets, answer.best), HeldOut(fast.all_sets, fast.answer.best)
    slow = support.validate_findings(answer, held, 0)
    quick = support.validate_findings(fast.answer, fast_held, len(slow))
    findings = tuple(sorted((*slow, *quick), key=lambda one: -one.evidence_nats))
    processes = pictures.locate_processes(all_sets, answer.best)
    added = [
        *pictures.contributions(all_sets, answer),
        *pictures.contributions(fast.all_sets, fast.answer),
    ]
    unknown = support.unexplained_part(found, fast.answer, (held, fast_held), added)
    unknown = with_correlated_channels(unknown, found, processes)
    remainder_nats = nats_of_remainder(all_sets, answer.best)
    unknown = with_remainder_sizes(all_sets, answer, unknown, remainder_nats, simulated=simulated)
    unknown = max(unknown, fast.band, key=lambda one: (one.detected, one.evidence_nats))
    level_facts = noise_level_facts(found, fast, prepared.facts, findings, spec_given=spec_given)
    counted = [as_finding(fact, library) for fact in level_facts]
    all_findings = (*prepared.findings(library), *findings, *counted, *rest_findings)
    differs = bool(all_findings) or unknown.detected
    residuals = residual_checks.fit_residuals(held.rows(answer.best.names))
    maps = residual_checks.regime_maps(residuals)
    evidence = visibility.effect_evidence(all_sets, found.space, held.without(answer.keys))
    odds = answer.log_odds, fast.answer.log_odds, remainder_nats, unknown.evidence_nats, 0.0
    any_counted = len(all_findings) > len(findings)
    answer_notes = support.doubts(findings) if differs else support.nearest_effect(answer, all_sets)
    terms = (*_as_recorded((*answer.terms, *fast.answer.terms), found), *prepared.rounding)
    return Diagnosis(
        recording="",
        baseline=baseline_of(start),
        mismatch=differs,
        p_value=0.0 if any_counted else float(np.exp(-max(odds))),
        findings=_as_recorded(all_findings, found),
        unexplained=unknown,
        posterior_predictive=_check_both_rates(residuals, maps, fast.answer, fast_held),
        sensitivity=() if differs else visibility.limits([*evidence, *_quick_evidence(fast)]),
        notes=support.notes(prepared, start, found, answer_notes, differs=differs),
        model=fast.point.filtered.model,
        noise=repaired_noise(found, fast, library, prepared.facts, _intervals(level_facts)),
        terms=terms,
        drawn=pictures.plot_data(start, found, residuals.whitened, added, processes, evidence),
        omnibus=residual_checks.whiteness(start, residuals),
        validation=support.validation((answer, held), (fast.answer, fast_held), findings, unknown),
        regime_map=maps,
    )


def _as_recorded(reported: Sequence[Reported], found: ModelSearchResult) -> tuple[Reported, ...]:
    """Findings or terms with settings by the columns as logged, not as they were corrected."""
    problem = found.all_sets.made.point.problem
    return tuple(replace(one, setting=recorded_setting(one.setting, problem)) for one in reported)


def _check_both_rates(
    residuals: residual_checks.Residuals,
    maps: Sequence[RegimeMap],
    fast_answer: Answer,
    held: HeldOut,
) -> dict[str, Check]:
    """Residual checks; if quick effects were found, those of the recorded rate are made there."""
    slow_checks = residual_checks.checks(residuals, maps)
    if not fast_answer.keys:
        return slow_checks
    fast = residual_checks.fit_residuals(held.rows(fast_answer.best.names))
    return residual_checks.merge_recorded_rate_checks(slow_checks, fast)


def _quick_evidence(fast: RecordedRateResult) -> list[visibility.EffectEvidence]:
    return visibility.effect_evidence(fast.all_sets, fast.space, fast.answer.best.names)


def _intervals(facts: Sequence[Fact]) -> list[tuple[float, float]]:
    return [span for fact in facts for span in fact.where.intervals_s]
