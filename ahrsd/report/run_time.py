"""Time of a run: the device's own clock, going on where the device restarted and began again."""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array

_LATE_S = 60.0  # an estimate is not told later than this; what is older is from after a restart
_PAUSE_S = 1.0  # between the last sample before a restart and the first one behind it


class RunTime:
    """Device time in seconds that never falls; until the first restart it is the device's own."""

    def __init__(self) -> None:
        self._offset_s = self._before_s = 0.0
        self._newest_s = -np.inf  # of the device, since its last restart

    def samples(self, time_s: Array) -> Array:
        """Of samples, in their order: a time that falls is a restart."""
        run_s = np.array(time_s, dtype=np.float64)
        if len(run_s) and run_s[0] >= self._newest_s and bool(np.all(np.diff(run_s) >= 0.0)):
            self._newest_s = float(run_s[-1])
            return run_s + self._offset_s
        for k, t in enumerate(time_s.tolist()):
            if t < self._newest_s:
                self._before_s = self._offset_s
                self._offset_s += self._newest_s + _PAUSE_S - t
                self._newest_s = t
            self._newest_s = max(self._newest_s, t)
            run_s[k] += self._offset_s
        return run_s

    def at(self, at_s: float) -> float:
        """Of an event at this device time.

        One that is from before the restart stays there, and one that comes before the first sample
        behind a restart is behind the last one before it.
        """
        if self._offset_s > 0.0 and at_s > self._newest_s + _PAUSE_S:
            return at_s + self._before_s
        if at_s < self._newest_s - _LATE_S:
            return float(self._newest_s + self._offset_s + _PAUSE_S)
        return at_s + self._offset_s

    @property
    def newest_s(self) -> float:
        """Of the newest sample; nan before the first."""
        return float(self._newest_s + self._offset_s) if np.isfinite(self._newest_s) else np.nan
