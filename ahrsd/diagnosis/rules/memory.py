"""What iron remembers from before the recording.

The middle of the play operator lies anywhere within its radius of the field when the recording
begins, and most often at one end: the vehicle had turned.  Until the field has been as far away on
either side nothing else is seen of it; taken for the middle, it looks like a small jump in the
first seconds.  So each axis is held against both ends, and then against what is between.

Iron that takes its time to follow a turn has not settled when the recording begins either:

    dA (LP_tau[h] - h) + dA g exp(-t / tau),   g: how far it was behind

which looks like a step or a drift if nobody allows for it.  g follows from the best vector on
exp(-t / tau) beside the effect.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.effects import series, shapes
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.regression import Base, Candidate, group_gram
from ahrsd.diagnosis.rules.settings import evidence_of, scaled
from ahrsd.diagnosis.values import Columns

#: nats that the choice of an axis costs
CHOICE_NATS = float(np.log(3.0))
#: parts of the radius by which a memory is moved, once or twice
PLAYED_STEPS = (1.0, 0.25)
#: nats that three more numbers cost, each known to a seventh of what it may be
UNSETTLED_NATS = 6.0
#: logarithm of the factor within which the time constant is sought beside the memory
REACH = 1.0


def with_memory(left: Base, candidate: Candidate) -> Candidate:
    """The candidate with the memory that explains most, if it is one that remembers.

    left: the basis without it
    """
    if "radius_gauss" in candidate.setting:
        return _played(left, candidate)
    return _unsettled(left, candidate) if candidate.name == "viscous_magnetisation" else candidate


def _unsettled(left: Base, candidate: Candidate) -> Candidate:
    """Viscous iron with what it was behind by when the recording began, and its time constant.

    The two are sought together: the time constant of iron that is taken for settled is another.
    """
    kept = {key: value for key, value in candidate.setting.items() if key != "memory"}
    settled = replace(candidate, setting=kept)
    best = _behind(left, settled)
    nats = evidence_of(left, best)
    for share in (1.0, 1 / 3, 1 / 9):
        around = [scaled(best.setting, "time_constant_s", k * share * REACH) for k in (-1, 1)]
        tried = [_behind(left, replace(candidate, setting=setting)) for setting in around]
        found = [evidence_of(left, one) for one in tried]
        if max(found) > nats:
            best, nats = tried[int(np.argmax(found))], max(found)
    return best if nats > evidence_of(left, settled) + UNSETTLED_NATS else settled


def _behind(left: Base, candidate: Candidate) -> Candidate:
    """The candidate with the likeliest memory for its time constant."""
    kept = {key: value for key, value in candidate.setting.items() if key != "memory"}
    forgotten = series.forgotten(left.context.track.dt_s, kept["time_constant_s"])
    decay = Columns(mag=forgotten[:, None, None] * np.eye(3))
    gram = group_gram(left, {"iron": candidate.effect.columns(left.context, kept), "decay": decay})
    whole = gram.total / left.colour
    value = solve(whole[:-1, :-1], whole[:-1, -1:])[:, 0]
    iron, seen = (value[gram.groups[name]] for name in ("iron", "decay"))
    lagging = np.einsum("jik,k->ij", shapes.times_symmetric(np.eye(3)), iron)
    alone = gram.project(["iron"]).total[:-1, :-1] / left.colour
    usual = float(np.median(np.linalg.norm(left.context.field_b, axis=1)))
    inner = lagging.T @ alone @ lagging + np.eye(3) / usual**2
    memory = np.linalg.solve(inner, lagging.T @ alone @ seen)
    return replace(candidate, setting={**kept, "memory": tuple(memory.tolist())})


def _played(left: Base, candidate: Candidate) -> Candidate:
    """Iron with hysteresis with the memory that explains most.

    Axis by axis, twice: what one axis remembers is another matter once the others' is right.
    """
    best, nats = candidate, evidence_of(left, candidate)
    for step in PLAYED_STEPS:
        for axis in [*range(3), *range(3)]:
            at = list(best.setting.get("memory", (0.0, 0.0, 0.0)))
            ends = {float(np.clip(at[axis] + k * step, -1.0, 1.0)) for k in (-2, -1, 1, 2)}
            tried = [
                replace(
                    best, setting={**best.setting, "memory": (*at[:axis], end, *at[axis + 1 :])}
                )
                for end in sorted(ends - {at[axis]})
            ]
            found = [evidence_of(left, one) for one in tried]
            k = int(np.argmax(found))
            if found[k] > nats + CHOICE_NATS:
                best, nats = tried[k], found[k]
    return best
