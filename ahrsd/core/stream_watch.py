"""Whether what comes now may be of another device, or of one that restarted: cheap to suspect.

A device that is swapped is silent for seconds, and then its clock or its readings are elsewhere; in
a text stream without device time a restart looks the same. So a silence of more than a few samples,
a time that runs ahead and readings that jump further than the rate of turn explains are told. None
of them proves anything: they make the daemon ask the device who it is.
"""

from __future__ import annotations

import numpy as np

from ahrsd.samples import Array, SampleBlock

SAMPLES = 5  # missing in a row
LEAST_SILENCE_S, UNKNOWN_RATE_SILENCE_S = 0.3, 2.0
JUMP_GAUSS = 0.03  # from one sample to the next, beyond what turning explains
_TURN = 1.5  # times the rate of turn, for what it changes between samples


class StreamWatch:
    """See the module; both methods return what was seen, empty where there was nothing."""

    def __init__(self) -> None:
        self._heard_s: float | None = None
        self._last: tuple[float, Array] | None = None

    def resumed(self, host_s: float) -> None:
        """The output was paused by ourselves, or begins anew: from now on it ought to come."""
        self._heard_s, self._last = host_s, None

    def heard(self, host_s: float, rate_hz: float) -> str:
        """Messages came at `host_s`; the rate is nan while nobody knows it."""
        known = np.isfinite(rate_hz) and rate_hz > 0.0
        limit_s = max(SAMPLES / rate_hz, LEAST_SILENCE_S) if known else UNKNOWN_RATE_SILENCE_S
        before_s, self._heard_s = self._heard_s, host_s
        if before_s is None or host_s - before_s <= limit_s:
            return ""
        return f"the device was silent for {host_s - before_s:.1f} s"

    def block(self, block: SampleBlock, rate_hz: float) -> tuple[str, bool]:
        """Samples; and whether it is the readings that jumped."""
        if not len(block):
            return "", False
        period_s = 1.0 / rate_hz if np.isfinite(rate_hz) and rate_hz > 0.0 else np.inf
        last, self._last = self._last, (float(block.time_s[-1]), block.raw_b_gauss[-1].copy())
        time_s, field = block.time_s, block.raw_b_gauss
        rate = np.linalg.norm(block.gyro_b_rad_s, axis=1)
        if last is not None:
            step_s = float(time_s[0]) - last[0]
            if step_s > (SAMPLES + 0.5) * period_s:
                return f"its time ran ahead by {step_s:.1f} s", False
            time_s, field = np.r_[last[0], time_s], np.vstack([last[1], field])
            rate = np.r_[rate[:1], rate]
        if len(time_s) < 2:
            return "", False
        step = np.linalg.norm(np.diff(field, axis=0), axis=1)
        turned = np.maximum(rate[1:], rate[:-1]) * np.diff(time_s)
        allowed = JUMP_GAUSS + _TURN * turned * np.linalg.norm(field[:-1], axis=1)
        beyond = step - allowed
        worst = int(np.argmax(np.where(np.isfinite(beyond), beyond, -np.inf)))
        if not beyond[worst] > 0.0:
            return "", False
        return f"the field's reading jumped by {1e3 * step[worst]:.0f} mG at once", True
