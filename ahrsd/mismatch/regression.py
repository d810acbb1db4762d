"""The recording as a regression: whitened columns of calibration, terms, candidates and frames.

Every effect is tried in every setting it offers with totals only (a few small matrices each); the
best setting goes on into the Gram with a matrix per block, from which all the tests are computed.
An onset is then sought more closely, to a fraction of a second.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ahrsd.mismatch.choices import choices
from ahrsd.mismatch.effects.base import Effect, Setting
from ahrsd.mismatch.effects.world import moved_object
from ahrsd.mismatch.evidence import colour
from ahrsd.mismatch.gram import Gram, block_edges, gram, slices, solve
from ahrsd.mismatch.innovation import Filtered, nuisance_columns, sensitivities
from ahrsd.mismatch.objects import closest_object
from ahrsd.mismatch.rest import Whitening
from ahrsd.mismatch.side_by_side import batches, joined
from ahrsd.mismatch.sums import Sums
from ahrsd.mismatch.values import Columns, Context
from ahrsd.samples import Array

CALIBRATION = "calibration"
#: columns that pass the filter at once: as much as stays in the processor's cache
BATCH_COLUMNS = 96
#: effects whose parameters cannot be negative
ONE_SIDED = ("mag_time_lag", "gyro_time_lag", "mag_low_pass", "mag_sample_hold")
ONSET_STEPS, ONSET_PASSES = 12, 2
#: rows that an onset leaves on either side: a run's first row opens the filter, and what begins
#: with it has no before.  A field of a quarter of a gauss then takes up how the gyro drifts
ROWS_BESIDE = 3
#: settings that are a size, sought between the values of their grid, and what that choice costs
SCALES = ("time_constant_s", "radius_gauss", "length_s", "length_m")
ANGLES = ("turn_deg",)
SCALE_CHOICES = 3
WORTH_NATS = 4.0
#: best places of an object from which it is sought more closely
PLACES = 3
#: an onset of the coarse grid that says less than this against its effect is sought more closely
NEAR_NATS = -3.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect in one setting.  tried: alternatives among which the setting was chosen."""

    effect: Effect
    setting: Setting
    tried: int
    evidence: float

    @property
    def name(self) -> str:
        """Its identifier, which is also its group in a Gram."""
        return self.effect.identifier

    @property
    def scale(self) -> Array:
        """(p,) one prior deviation per parameter."""
        return np.array([parameter.scale for parameter in self.effect.parameters])


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """What every candidate is measured against: innovations with calibration and terms taken out.

    known (N, 3, q): whitened columns of the calibration and of the named terms, in `groups` order;
    innovation (N, 3): whitened;  rate_hz: rows per second;
    colour: power of the innovation at low frequency over white;
    sums: of the fit with all its terms: of its columns `kept` (q,) are known here, and `back` (all
    of them,) was put back into the innovation;
    weight (N, 3, 3) of the rows (`weighed`), rest: noise of its own; in all of these.
    """

    context: Context
    filtered: Filtered
    groups: Mapping[str, slice]
    known: Array
    innovation: Array
    rate_hz: float
    colour: float
    sums: Sums
    kept: NDArray[np.intp]
    back: Array
    weight: Array | None = None
    rest: Whitening | None = None

    def whitened(self, columns: Sequence[Columns]) -> list[Array]:
        """The columns (N, 3, p) as the innovation sees them, several of one side at a time."""
        out: dict[int, Array] = {}
        for batch, seen in self.passed(columns):
            edges = np.cumsum([0, *(columns[k].width for k in batch)])
            parts = (seen[:, :, a:b] for a, b in itertools.pairwise(edges))
            out.update(zip(batch, parts, strict=True))
        return [out[k] for k in range(len(columns))]

    def passed(self, columns: Sequence[Columns]) -> Iterator[tuple[list[int], Array]]:
        """Numbers of some of the columns, and these whitened next to each other (N, 3, ...)."""
        for batch in batches(columns, BATCH_COLUMNS):
            yield batch, self._seen(joined([columns[k] for k in batch]))

    def _seen(self, columns: Columns) -> Array:
        seen = sensitivities(self.filtered, columns)
        seen = seen if self.weight is None else self.weight @ seen
        return seen if self.rest is None else self.rest.whitened(seen)

    def beside(self, name: str, columns: Array) -> Base:
        """The same with a further group of whitened columns (N, 3, p) known."""
        widths = [(k, where.stop - where.start) for k, where in self.groups.items()]
        groups = slices([*widths, (name, columns.shape[2])])
        known = np.concatenate([self.known, columns], axis=2)
        return based(self, groups, known, self.innovation)

    def without(self, name: str, value: Array) -> Base:
        """The same with one named term left out, what it explains put back; value (p,)."""
        where = self.groups[name]
        kept = [k for k in self.groups if k != name]
        back = self.back.copy()
        back[self.kept[where]] += value
        return replace(
            self,
            groups=slices([(k, self.groups[k].stop - self.groups[k].start) for k in kept]),
            known=np.delete(self.known, where, axis=2),
            innovation=self.innovation + self.known[:, :, where] @ value,
            kept=np.delete(self.kept, where),
            back=back,
        )

    def moved(self, rows: int) -> Base:
        """The same with the innovations of another time, `rows` later."""
        return based(self, self.groups, self.known, np.roll(self.innovation, rows, axis=0))


def base(
    context: Context, filtered: Filtered, terms: Sequence[tuple[str, Columns]], rate_hz: float
) -> Base:
    """Whiten the columns of calibration and named terms (group name, columns)."""
    parts = [(CALIBRATION, sensitivities(filtered, nuisance_columns(filtered)))]
    parts += [(name, sensitivities(filtered, columns)) for name, columns in terms]
    known = np.concatenate([part for _, part in parts], axis=2)
    return Base(
        context,
        filtered,
        slices([(name, part.shape[2]) for name, part in parts]),
        known,
        filtered.whitened,
        rate_hz,
        colour(filtered.whitened, rate_hz),
        Sums.of(known, filtered.whitened),
        np.arange(known.shape[2]),
        np.zeros(known.shape[2]),
    )


def based(basis: Base, groups: Mapping[str, slice], known: Array, innovation: Array) -> Base:
    """A base with other columns or innovations, against which nothing was held yet."""
    return replace(
        basis,
        groups=groups,
        known=known,
        innovation=innovation,
        sums=Sums.of(known, innovation),
        kept=np.arange(known.shape[2]),
        back=np.zeros(known.shape[2]),
    )


def quieter(basis: Base, columns: Array) -> Base:
    """The basis with its colour taken from what the columns (N, 3, p) leave."""
    left = residual(np.concatenate([basis.known, columns], axis=2), basis.innovation)
    return replace(basis, colour=colour(left, basis.rate_hz))


def residual(columns: Array, innovation: Array) -> Array:
    """(N, 3) innovation with (N, 3, p) columns regressed out."""
    flat = columns.reshape(-1, columns.shape[2])
    theta = solve(flat.T @ flat, (flat.T @ innovation.ravel())[:, None])[:, 0]
    return np.asarray((innovation.ravel() - flat @ theta).reshape(innovation.shape))


def best_settings(
    basis: Base, library: Mapping[str, Effect], taken: Sequence[tuple[str, Setting]]
) -> list[Candidate]:
    """Every effect that can be computed here, in its best setting; strongest evidence first."""
    found = []
    offered: dict[str, tuple[Setting, ...]] = {}
    for name, effect in library.items():
        options = _settings(effect, basis.context) if effect.kind == "mean" else ()
        offered[name] = tuple(option for option in options if (name, option) not in taken)
    _summed(basis, [(library[name], o) for name, options in offered.items() for o in options])
    for name, options in offered.items():
        effect = library[name]
        if not options:
            continue
        best = max(_scan(basis, effect, options), key=lambda candidate: candidate.evidence)
        if "onset_s" in best.setting and best.evidence > NEAR_NATS:
            best = _with_onset(basis, best, options)
        if best.evidence > WORTH_NATS:
            best = _with_scale(basis, best, options)
        found.append(best)
    return sorted(found, key=lambda candidate: -candidate.evidence)


@lru_cache(maxsize=64)  # surveys without one name or another are of the same context
def _settings(effect: Effect, context: Context) -> tuple[Setting, ...]:
    return effect.settings(context)


def evidence_of(basis: Base, candidate: Candidate) -> float:
    """Evidence of a candidate in its own setting, whose choice is not paid for."""
    return _scan(basis, candidate.effect, [candidate.setting])[0].evidence


def candidate_gram(basis: Base, columns: Mapping[str, Array], block_s: float) -> Gram:
    """Gram of calibration, terms and the given whitened columns, with a matrix per block."""
    groups = {name: basis.known[:, :, where] for name, where in basis.groups.items()}
    time_s = basis.context.track.time_s
    return gram({**groups, **columns}, basis.innovation, time_s, block_edges(time_s, block_s))


def columns_of(basis: Base, candidates: Sequence[Candidate]) -> dict[str, Array]:
    """Whitened columns (N, 3, p) of the candidates by name."""
    columns = basis.whitened([c.effect.columns(basis.context, c.setting) for c in candidates])
    return {c.name: part for c, part in zip(candidates, columns, strict=True)}


def group_gram(basis: Base, groups: Mapping[str, Columns], block_s: float | None = None) -> Gram:
    """Gram of the given groups, calibration and terms projected out; one block by default."""
    whitened = basis.whitened(list(groups.values()))
    return known_out(basis, dict(zip(groups, whitened, strict=True)), block_s)


def known_out(basis: Base, columns: Mapping[str, Array], block_s: float | None = None) -> Gram:
    """Gram of whitened columns (N, 3, p), calibration and terms projected out; one block."""
    length_s = basis.context.track.duration_s if block_s is None else block_s
    return candidate_gram(basis, columns, length_s).project(list(basis.groups))


def without_known(basis: Base, columns: Array) -> tuple[Array, Array]:
    """Columns (N, 3, p) and innovation (N, 3) with calibration and terms regressed out."""
    flat = basis.known.reshape(-1, basis.known.shape[2])
    stacked = np.concatenate([columns, basis.innovation[:, :, None]], axis=2)
    other = stacked.reshape(len(flat), -1)
    left = other - flat @ solve(flat.T @ flat, flat.T @ other)
    cube = left.reshape(stacked.shape)
    return cube[:, :, :-1], cube[:, :, -1]


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
    return replace(finer, tried=len(options) * 4, evidence=paid)


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
            best = replace(one, tried=len(options) * SCALE_CHOICES, evidence=one.evidence - cost)
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
