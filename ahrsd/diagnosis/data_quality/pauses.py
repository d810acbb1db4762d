"""A clock that jumps is no time that passed: breaks of a recording are made short.

A host's clock that is set while it records, from 1970 to today, an hour on, two seconds back,
leaves two stretches with decades between them or one on top of the other.  Everything that is cut
by time (a drift, blocks, pieces of twenty seconds) would have nothing but the two, and grids that
grow with the span no memory.  So no break is longer than a recording's own length, and time always
goes on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.track import Track

#: a break that is believed whatever the recording's length, and what is left of one that is not
BELIEVED_S, LEFT_S = 60.0, 10.0


def without_jumps(track: Track) -> tuple[Track, tuple[str, ...]]:
    """The track with the jumps of its clock closed, and a sentence on the first of them.

    Rows stay as they are; the times behind a jump are moved.  Only where a run begins: a step back
    within one is no break.
    """
    starts = np.array([run.start for run in track.runs[1:]], dtype=np.intp)
    if not len(starts):
        return track, ()
    breaks_s = track.time_s[starts] - track.time_s[starts - 1]
    passed_s = sum(float(track.time_s[r.stop - 1] - track.time_s[r.start]) for r in track.runs)
    jumps = (breaks_s <= 0.0) | (breaks_s > max(BELIEVED_S, passed_s))
    if not jumps.any():
        return track, ()
    moved = np.zeros(len(track))
    moved[starts[jumps]] = LEFT_S - breaks_s[jumps]
    first = int(np.argmax(jumps))
    others = f" (and {np.count_nonzero(jumps) - 1} more)" if np.count_nonzero(jumps) > 1 else ""
    at_s = float(track.time_s[starts[first] - 1])
    words = (
        f"the clock jumps by {breaks_s[first]:+.6g} s behind {at_s:.13g} s{others}: "
        f"taken as a break of {LEFT_S:g} s; times behind it are told as if no more had passed"
    )
    return replace(track, time_s=track.time_s + np.cumsum(moved)), (words,)
