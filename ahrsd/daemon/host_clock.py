"""The host's clocks: wall clock, boot id and time since boot (suspends included)."""

from __future__ import annotations

import time
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
    """What a journal record says of the time it was made, as `writeback.clocks.Stamp` reads it."""
    return {"wall_s": time.time(), "boot_id": boot_id(), "boot_s": boot_s()}
