"""The settings of an effect: every one it offers is tried, and the best is sought more closely.

All settings are tried with totals only (a few small matrices each), and count together: what an
effect is worth is the mean over them.  An onset is then sought to a fraction of a second, a time
constant, a radius or a place between those of the grid; that choice is paid for.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from ahrsd.diagnosis.effects.base import ANGLES, SCALES, Effect, Setting
from ahrsd.diagnosis.effects.shapes import LOGGED
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.choices import choices
from ahrsd.diagnosis.rules.objects import closest_object, moved_object
from ahrsd.diagnosis.rules.regression import BATCH_COLUMNS, Base, Candidate
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.samples import Array

#: effects whose parameters cannot be negative
ONE_SIDED = ("mag_time_lag", "gyro_time_lag", "mag_low_pass", "mag_sample_hold")
ONSET_STEPS, ONSET_PASSES = 12, 2
#: rows that an onset leaves on either side: a run's first row opens the filter, and what begins
#: with it has no before.  A field of a quarter of a gauss then takes up how the gyro drifts
ROWS_BESIDE = 3
#: how a logged cause is read: late and as a mean of so long, and its north turned by so much
READ_ONCE = (*LOGGED, "turn_deg")
#: what the choice of a size between those of its grid costs, as so many values
SCALE_CHOICES = 3
WORTH_NATS = 4.0
#: best places of an object from which it is sought more closely
PLACES = 3
#: an onset of the coarse grid that says less than this against its effect is sought more closely
NEAR_NATS = -3.0


def best_settings(
    basis: Base, library: Mapping[str, Effect], taken: Sequence[tuple[str, Setting]]
) -> list[Candidate]:
    """Every effect that can be computed here, in its best setting; strongest evidence first."""
    found = []
    offered: dict[str, tuple[Setting, ...]] = {}
    for name, effect in library.items():
        options = _settings(effect, basis.context) if effect.kind == "mean" else ()
        given = [_cause(setting) for other, setting in taken if other == name]
        offered[name] = tuple(
            as_read(option, taken) for option in options if _cause(option) not in given
        )
    _summed(basis, [(library[name], o) for name, options in offered.items() for o in options])
    for name, options in offered.items():
        effect = library[name]
        if not options:
            continue
        best = _averaged(_scan(basis, effect, options))
        if "onset_s" in best.setting and best.evidence > NEAR_NATS:
            best = _with_onset(basis, best, options)
        if best.evidence > WORTH_NATS:
            best = _with_scale(basis, best, options)
        ways = 1 + sum(_unlogged(library, other, basis.context) for other in effect.stands_for)
        paid = best.evidence + float(np.log(ways))
        found.append(replace(best, alike=best.alike * ways, evidence=paid))
    return sorted(found, key=lambda candidate: -candidate.evidence)


def as_read(setting: Setting, taken: Sequence[tuple[str, Setting]]) -> Setting:
    """The setting with its column read as it is by what is named: a log is late by one time.

    The change of a current at another time than the current would make up for what its mean lost.
    """
    column = setting.get("covariate")
    by_it = [named for _, named in taken if column and named.get("covariate") == column]
    if not by_it:
        return setting
    read = {key: named[key] for named in by_it for key in LOGGED if key in named}
    return {**{key: setting[key] for key in setting if key not in LOGGED}, **read}


def _cause(setting: Setting) -> Setting:
    """A setting without how its cause is read: no cause is late by two times at once."""
    return {key: value for key, value in setting.items() if key not in READ_ONCE}


@lru_cache(maxsize=64)  # surveys without one name or another are of the same context
def _settings(effect: Effect, context: Context) -> tuple[Setting, ...]:
    return effect.settings(context)


def _unlogged(library: Mapping[str, Effect], name: str, context: Context) -> bool:
    """Whether an effect of the library lacks its column here."""
    return name in library and not _settings(library[name], context)


def _averaged(options: Sequence[Candidate]) -> Candidate:
    """The best of some settings of an effect, with the evidence of all together.

    Where several do as well, which of them it is was hardly chosen: a slow drift has many forms,
    and a short recording that shows it shows them all.
    """
    best = max(options, key=lambda candidate: candidate.evidence)
    if not np.isfinite(best.evidence):
        return best
    alike = float(np.sum(np.exp([one.evidence - best.evidence for one in options])))
    return replace(best, alike=alike, evidence=best.evidence + float(np.log(alike)))


def evidence_of(basis: Base, candidate: Candidate) -> float:
    """Evidence of a candidate in its own setting, whose choice is not paid for."""
    return _scan(basis, candidate.effect, [candidate.setting])[0].evidence


def _scan(basis: Base, effect: Effect, options: Sequence[Setting]) -> list[Candidate]:
    """Evidence of each setting, its choice paid for."""
    sums, kept = basis.sums, basis.kept
    keys = _summed(basis, [(effect, option) for option in options])
    inverse = solve(sums.inner[np.ix_(kept, kept)], np.eye(len(kept)))
    known_e = (sums.seen + sums.inner @ basis.back)[kept]
    scale = np.array([parameter.scale for parameter in effect.parameters])
    XX, whole, Xe = map(np.stack, zip(*(sums.found[key] for key in keys), strict=True))
    cross = whole[:, kept]
    M = inverse @ cross
    G = XX - np.swapaxes(cross, 1, 2) @ M
    s = Xe + basis.back @ whole - known_e @ M
    power = np.diagonal(XX, axis1=1, axis2=2)
    what = choices(G, s, power, scale, effect.least_information)
    tried = [len(options) * int(option.get("searched", 1)) for option in options]
    evidence = what.log_bayes(basis.colour) - np.log(tried)
    if effect.identifier in ONE_SIDED:  # a delay or a time constant, negative beyond doubt
        evidence[what.below_zero(2.0)] = -np.inf
    found = zip(options, tried, evidence.tolist(), strict=True)
    return [Candidate(effect, option, count, paid) for option, count, paid in found]


def _summed(basis: Base, wanted: Sequence[tuple[Effect, Setting]]) -> list[tuple[str, str]]:
    """Keys of effects in their settings among the basis's sums, which then has all of them."""
    keys = [(effect.identifier, repr(option)) for effect, option in wanted]
    batch: dict[tuple[str, str], Columns] = {}
    width = 0
    for number, (key, (effect, option)) in enumerate(zip(keys, wanted, strict=True), start=1):
        if key not in basis.sums.found and key not in batch:
            batch[key] = effect.columns(basis.context, option)
            width += batch[key].width
        if batch and (width >= BATCH_COLUMNS or number == len(keys)):
            new, columns = list(batch), list(batch.values())
            for numbers, seen in basis.passed(columns):
                parts = [(new[k], columns[k].width) for k in numbers]
                basis.sums.add(parts, seen)
            batch, width = {}, 0
    return keys


def _with_onset(basis: Base, best: Candidate, options: Sequence[Setting]) -> Candidate:
    """The candidate with its onset sought between the neighbours of the coarse grid."""
    times = np.unique([option["onset_s"] for option in options if "onset_s" in option])
    if len(times) < 2:
        return best
    finer = closest_onset(basis, best, float(np.median(np.diff(times))))
    paid = finer.evidence - np.log(len(options) * 4)
    if paid <= best.evidence:
        return best
    return replace(finer, tried=len(options) * 4, alike=1.0, evidence=paid)


def _with_scale(basis: Base, best: Candidate, options: Sequence[Setting]) -> Candidate:
    """The candidate with its time constant, radius or length sought between those of the grid.

    A grid of factors of three leaves coefficients off by many of their deviations.  The place of
    an object is sought from the best few, also where something else is better as long as they
    are guesses.
    """
    key, finer = scale_of(best), []
    values = {float(option[key]) for option in options if key in option} if key else set()
    if len(values) >= 2 and "place_m" not in best.setting:
        ends = [np.radians(v) if key in ANGLES else np.log(v) for v in (min(values), max(values))]
        finer = [closest_scale(basis, best, float(ends[1] - ends[0]) / (len(values) - 1) / 3)]
    places = [option for option in options if "place_m" in option]
    if places:
        found = sorted(_scan(basis, best.effect, places), key=lambda one: -one.evidence)
        finer.append(_closest_place(basis, found[:PLACES]))
    cost = float(np.log(len(options) * SCALE_CHOICES))
    for one in finer:
        if one.evidence - cost > best.evidence:
            tried = len(options) * SCALE_CHOICES
            best = replace(one, tried=tried, alike=1.0, evidence=one.evidence - cost)
    return best


def scale_of(candidate: Candidate) -> str | None:
    """The setting of a candidate that is a size and goes with its value, None where none is."""
    if candidate.name in ONE_SIDED:
        return None
    return next((key for key in (*SCALES, *ANGLES) if key in candidate.setting), None)


def scaled(setting: Setting, key: str, change: float) -> Setting:
    """The setting with its scale exp(change) times as large, or turned by `change` radians."""
    value = float(setting[key])
    return {
        **setting,
        key: value + np.degrees(change) if key in ANGLES else value * float(np.exp(change)),
    }


def closest_scale(basis: Base, start: Candidate, reach: float) -> Candidate:
    """The best scale within about `reach` (`scaled`), to a small part; the choice is not paid."""
    key, best = scale_of(start), start
    if key is None:
        return start
    if "place_m" in start.setting:
        return _closest_place(basis, [start])
    keys = dict.fromkeys([key, *(angle for angle in ANGLES if angle in start.setting)])
    for share, key in itertools.product((1.0, 1 / 3, 1 / 9), keys):
        steps = [scaled(best.setting, key, k * share * reach) for k in (-1, 0, 1)]
        found = max(_scan(basis, best.effect, steps), key=lambda candidate: candidate.evidence)
        best = replace(found, tried=start.tried, evidence=found.evidence + np.log(len(steps)))
    return best


def _closest_place(basis: Base, starts: Sequence[Candidate]) -> Candidate:
    """An object's place and the turn of the positions' frame sought together; unpaid for."""
    effect, context, setting = starts[0].effect, basis.context, starts[0].setting

    def fields(place: Array) -> Array:
        return np.asarray(effect.columns(context, moved_object(context, setting, place)).mag)

    def whitened(parts: Sequence[Array]) -> list[Array]:
        return basis.whitened([Columns(mag=part) for part in parts])

    at = [np.append(one.setting["place_m"], one.setting["turn_deg"]) for one in starts]
    found = closest_object(fields, whitened, basis.known, basis.innovation, at)
    best = replace(starts[0], setting=moved_object(context, setting, found))
    return replace(best, evidence=evidence_of(basis, best))


def closest_onset(basis: Base, start: Candidate, reach_s: float) -> Candidate:
    """The best onset within `reach_s`, to a small part of it; the choice is not paid for."""
    time_s = basis.context.track.time_s
    first_s, last_s = time_s[ROWS_BESIDE], time_s[-ROWS_BESIDE]
    best = start
    for _ in range(ONSET_PASSES):
        grid = best.setting["onset_s"] + reach_s * np.linspace(-1, 1, ONSET_STEPS + 1)
        inside = np.unique(np.clip(grid, first_s, last_s))
        closer = [{**best.setting, "onset_s": round(float(t), 4)} for t in inside]
        best = max(_scan(basis, best.effect, closer), key=lambda candidate: candidate.evidence)
        best = replace(best, tried=start.tried, evidence=best.evidence + np.log(len(closer)))
        reach_s *= 2.0 / ONSET_STEPS
    return best
