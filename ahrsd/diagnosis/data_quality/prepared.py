"""A recording as it is diagnosed: columns in their roles, one clock, and what was counted in it.

What hygiene finds is told before any fit, and put right before it; what stops a fit is an answer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.calibration_fit.null_fit import unusable
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.data_quality.dead import dead
from ahrsd.diagnosis.data_quality.facts import Fact, matters, of_fact, stopped
from ahrsd.diagnosis.data_quality.hygiene import hygiene, put_right
from ahrsd.diagnosis.data_quality.pauses import without_jumps
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.track import NothingToFit, Track


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A recording before any fit.

    track: as it was recorded, but for the clock's jumps;  facts: found by counting
    notes: what a person should know of how it was read
    """

    track: Track
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]

    def stopped(self, recording: str, library: Mapping[str, Effect]) -> Diagnosis | None:
        """The answer where nothing that is fitted would mean anything; else None."""
        stops = [fact for fact in self.facts if fact.stops]
        return stopped(recording, stops, library, self.notes) if stops else None

    def with_facts(self, more: Sequence[Fact]) -> Prepared:
        """The same with what was counted later: turns that were lost."""
        return replace(self, facts=(*self.facts, *more))

    def put_right(self) -> Track:
        """The track without what its facts say is wrong."""
        return put_right(self.track, self.facts)

    def told(self, library: Mapping[str, Effect]) -> tuple[Finding, ...]:
        """The facts that are findings."""
        return tuple(of_fact(fact, library) for fact in self.facts if matters(fact))

    @property
    def lesser(self) -> tuple[str, ...]:
        """The others, which are worth a note."""
        return tuple(fact.words for fact in self.facts if not matters(fact))


def prepared(track: Track) -> Prepared:
    """A recording ready to be fitted.  NothingToFit, one line, where nothing can be."""
    track, notes = roles.prepared(track)
    track, jumped = without_jumps(track)
    if why := unusable(track) or dead(track):
        raise NothingToFit(why)
    return Prepared(track, hygiene(track), (*jumped, *notes))
