"""Where a gyro's samples tell how far a sensor turned, and where they do not.

A step's turn is told by one vector as long as the rate hardly changes within it.  In a crash, a
fall or a blow a slow logger sees turns of a radian a step: what happened between is not known, the
gyro's error is as large as its reading, and all that is linear in rates is wrong by as much.  There
a run ends, and the field begins anew from its next reading: nothing is said of the turn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.one_model import priors
from ahrsd.diagnosis.track import Track


def broken_where_unsampled(track: Track) -> Track:
    """The track with a run's end ahead of each step that turns too far to be told."""
    step_s = np.nan_to_num(track.dt_s, nan=0.0)
    turn = np.linalg.norm(track.gyro_b_rad_s, axis=1) * step_s
    unknown = np.flatnonzero(turn > priors.SAMPLED_TURN_RAD)
    if not len(unknown):
        return track
    starts = np.union1d([run.start for run in track.runs] or [0], unknown)
    dt_s = track.dt_s.copy()
    dt_s[unknown] = np.nan
    ends = [*starts[1:], len(track)]
    runs = tuple(slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True))
    return replace(track, dt_s=dt_s, runs=runs)
