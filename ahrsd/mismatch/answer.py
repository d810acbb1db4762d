"""The whole answer: what needs no physics first, then the physics, then does it look right now?

`hygiene` -> (stop where axes or units are wrong) -> `engine.diagnose` on the track put right
          -> samples that went missing unseen, noise that changes -> `predictive.checks`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.mismatch import engine, predictive
from ahrsd.mismatch.diagnosis import Cost, Diagnosis, Finding, Heldout, Unexplained
from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.facts import Fact
from ahrsd.mismatch.hygiene import hygiene, put_right
from ahrsd.mismatch.innovation import run_filter
from ahrsd.mismatch.missing import missing_turns
from ahrsd.mismatch.noise import level_facts
from ahrsd.mismatch.null import unusable
from ahrsd.mismatch.track import Spec, Track
from ahrsd.mismatch.values import NullModel

#: samples that are missing by honest stamps, and stamps that scatter, are part of the recording
#: and not a difference from its simulation unless there are so many
MISSING_SHARE = 0.02
JITTER_SHARE = 0.05  # of the step
_NONE = float("nan")


def answer(
    track: Track,
    spec: Spec | None = None,
    *,
    library: Mapping[str, Effect] = EFFECTS,
    recording: str = "",
) -> Diagnosis:
    """Where the recording and its model differ.  Deterministic.

    ValueError, one line, where nothing can be fitted.
    """
    spec = spec or Spec()
    facts = hygiene(track)
    if any(fact.stops for fact in facts):
        return _stopped(recording, facts, library)
    if why := unusable(track):
        raise ValueError(why)
    clean = put_right(track, facts)
    found = engine.diagnose(clean, spec, library=library, recording=recording)
    if found.fits is not None:
        null, repaired = found.fits
        m = round(repaired.filtered.track.step_s / clean.step_s)
        whole = engine.model_at_rate(repaired.model, m)
        facts += tuple(_missing(clean, whole))
        facts += tuple(level_facts(repaired.filtered, spec_given=spec.sigma_mag_gauss is not None))
        checks = predictive.checks(null, repaired, found.terms, library=library)
        found = replace(found, posterior_predictive=checks, model=whole)
    return _with_facts(found, _unique(facts), library)


def _missing(track: Track, model: NullModel) -> list[Fact]:
    """Turns that are missing, at the recorded rate."""
    done = run_filter(track, model, sensitive=False)
    rate = np.nan_to_num(track.gyro_b_rad_s - model.gyro_bias_rad_s)
    return missing_turns(done, rate)


def _unique(facts: Sequence[Fact]) -> list[Fact]:
    """The first fact of each effect."""
    kept: dict[str, Fact] = {}
    for fact in facts:
        kept.setdefault(fact.effect, fact)
    return list(kept.values())


def _with_facts(found: Diagnosis, facts: list[Fact], library: Mapping[str, Effect]) -> Diagnosis:
    named = {finding.effect for finding in found.findings}
    findings = [
        _finding(fact, library) for fact in facts if _matters(fact) and fact.effect not in named
    ]
    notes = tuple(fact.words for fact in facts if not _matters(fact))
    return replace(
        found,
        findings=(*found.findings, *findings),
        mismatch=found.mismatch or bool(findings),
        notes=(*found.notes, *notes),
    )


def _matters(fact: Fact) -> bool:
    """Whether it is a difference from the simulation, which has the recording's own stamps."""
    if fact.effect == "dropped_samples" and fact.where.frame == "link" and not fact.setting:
        return fact.parameters[0].value > MISSING_SHARE
    if fact.effect == "timestamp_jitter" and not fact.stops:
        return fact.parameters[0].value > JITTER_SHARE * float(fact.setting["step_s"])
    return True


def _finding(fact: Fact, library: Mapping[str, Effect]) -> Finding:
    row = library.get(fact.effect)
    return Finding(
        effect=fact.effect,
        confidence=fact.confidence,
        alternatives=(),
        where=fact.where,
        parameters=fact.parameters,
        heldout=Heldout(_NONE, _NONE, _NONE, _NONE),
        cost_if_left_out=Cost(_NONE, _NONE),
        separate_from=None,
        words=fact.words,
        equation="" if row is None else row.equation,
        setting={name: value for name, value in fact.setting.items() if _is_plain(value)},
    )


def _is_plain(value: object) -> bool:
    return isinstance(value, str | int | float | bool | list | tuple)


def _stopped(recording: str, facts: Sequence[Fact], library: Mapping[str, Effect]) -> Diagnosis:
    """Nothing that is fitted would mean anything: only what was counted."""
    note = "put this right first: nothing that is fitted before means anything"
    return Diagnosis(
        recording=recording,
        baseline=None,
        mismatch=True,
        p_value=float(np.clip(1.0 - max(fact.confidence for fact in facts), 0.0, 1.0)),
        findings=tuple(_finding(fact, library) for fact in facts if fact.stops),
        unexplained=Unexplained(False),
        posterior_predictive={},
        notes=(note, *(fact.words for fact in facts if not fact.stops)),
    )
