"""The recording as a regression: whitened columns of calibration, terms, candidates and frames.

A candidate, an effect in its best setting (`settings`), goes into the Gram with a matrix per block,
from which all the tests are computed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.effects.base import Effect, Setting
from ahrsd.diagnosis.innovation_filter.evidence import colour
from ahrsd.diagnosis.innovation_filter.gram import Gram, slices, solve
from ahrsd.diagnosis.innovation_filter.innovation import (
    Filtered,
    nuisance_columns,
    regressing,
    sensitivities,
)
from ahrsd.diagnosis.innovation_filter.side_by_side import batches, joined
from ahrsd.diagnosis.rules.gram import block_edges, gram
from ahrsd.diagnosis.rules.rest import Whitening
from ahrsd.diagnosis.rules.sums import Sums
from ahrsd.diagnosis.values import Columns, Context
from ahrsd.samples import Array

CALIBRATION = "calibration"
#: columns that pass the filter at once: as much as stays in the processor's cache
BATCH_COLUMNS = 96


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect in one setting.

    tried: alternatives among which the setting was chosen
    alike: how many of them explain as much, the best one counted
    evidence: of the effect, whichever of them it is: the mean of the Bayes factors
    """

    effect: Effect
    setting: Setting
    tried: int
    evidence: float
    alike: float = 1.0

    @property
    def name(self) -> str:
        """Its identifier, which is also its group in a Gram."""
        return self.effect.identifier

    @property
    def scale(self) -> Array:
        """(p,) one prior deviation per parameter."""
        return np.array([parameter.scale for parameter in self.effect.parameters])

    @property
    def paid(self) -> float:
        """Nats that the choice of its setting costs."""
        return float(np.log(self.tried / self.alike))


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
    filtered = regressing(filtered, context.rate_b_rad_s)
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
