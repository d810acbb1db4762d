"""The host's clocks: wall clock, boot id, time since boot (with suspends), a run's own clock."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def boot_id() -> str:
    """Which boot of the host this is; empty where the system does not tell."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""


def boot_s() -> float:
    """Seconds since the host booted, suspends included; nobody can set this clock."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def stamp() -> dict[str, object]:
    """What a journal record says of the time it was made, as `journal_history.Stamp` reads it."""
    return {"wall_s": time.time(), "boot_id": boot_id(), "boot_s": boot_s()}


@dataclass(frozen=True, slots=True)
class HostClock:
    """Monotonic host time in ns, `speed` times as fast as real time (1 but for demonstrations).

    patient_bytes: where time stands still while the device is not read, so much may lie unread
    """

    speed: float = 1.0
    start_ns: int = field(default_factory=time.monotonic_ns)
    patient_bytes: int | None = None

    def now_ns(self) -> int:
        """Nanoseconds, never falling."""
        return self.start_ns + int((time.monotonic_ns() - self.start_ns) * self.speed)

    def boot(self) -> tuple[str, float]:
        """Id of the host's boot and seconds since then; one that runs faster began with itself."""
        if self.speed == 1.0:
            return boot_id(), boot_s()
        return self._own_boot()

    def _own_boot(self) -> tuple[str, float]:
        return f"{boot_id()} {self.start_ns}", (self.now_ns() - self.start_ns) * 1e-9
