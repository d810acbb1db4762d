"""What iron with hysteresis remembers from before the recording.

The play operator's middle lies anywhere within its radius of the field when the recording begins,
and most often at one end: the vehicle had turned.  Until the field has been as far away on either
side nothing else is seen of it; taken for the middle, it looks like a small jump in the first
seconds.  So each axis is held against both ends.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.mismatch.regression import Base, Candidate, evidence_of

#: nats that the choice of an axis costs
CHOICE_NATS = float(np.log(3.0))


def with_memory(left: Base, candidate: Candidate) -> Candidate:
    """The candidate with the memory that explains most, if it is one that remembers.

    left: the basis without it
    """
    if "radius_gauss" not in candidate.setting:
        return candidate
    best, nats = candidate, evidence_of(left, candidate)
    for axis in range(3):
        at = list(best.setting.get("memory", (0.0, 0.0, 0.0)))
        tried = [
            replace(best, setting={**best.setting, "memory": (*at[:axis], end, *at[axis + 1 :])})
            for end in {-1.0, 0.0, 1.0} - {at[axis]}
        ]
        found = [evidence_of(left, one) for one in tried]
        k = int(np.argmax(found))
        if found[k] > nats + CHOICE_NATS:
            best, nats = tried[k], found[k]
    return best
