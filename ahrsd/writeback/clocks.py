"""What may be concluded from the times of journal records: a proven restart, a time that passed.

A record is stamped by three clocks. The wall clock can be wrong by any amount and can be set at any
moment. The time since the host's boot (CLOCK_BOOTTIME) cannot be set, but only means something
within one boot, which the boot id names. The device's own time since its start-up falls when, and
only when, the device restarts.

* A restart of the device is proven within one boot of the host by boottime and the device's time,
  across boots by the device's time alone. The wall clock is never asked.
* How long ago a budgeted write was is read cautiously: the least that the clocks leave possible.
  Within one boot boottime says it, and a wall clock that shows less makes it less. Across boots the
  host has been up at least since its boot, and the wall clock counts less `WALL_ERROR_S`, and only
  where both of its readings are of this age (a computer without a battery starts in 1970 or 2000).

A record without boot id is of another boot: old journals and recordings have none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

PLAUSIBLE_FROM_S: Final = 1577836800.0  # 2020: an earlier wall clock was never set
WALL_ERROR_S: Final = 7500.0  # an hour behind then and an hour ahead now, and some minutes
LATENCY_S: Final = 0.5  # what a message of the device may take to get here
CLOCK_RATE: Final = 1e-3  # how much slower or faster than the host a device's clock may run


@dataclass(frozen=True, slots=True)
class Stamp:
    """One moment by every clock that was there; None or "": not known.

    boot_s:   time since the host's boot `boot_id`
    device_s: the device's own time since its start-up, at most: its newest sample
    """

    wall_s: float | None = None
    boot_id: str = ""
    boot_s: float | None = None
    device_s: float | None = None

    @staticmethod
    def of(facts: Mapping[str, Any]) -> Stamp:
        """From a journal record, whatever is in it."""
        boot_id = facts.get("boot_id")
        return Stamp(
            wall_s=_number(facts.get("wall_s")),
            boot_id=boot_id if isinstance(boot_id, str) else "",
            boot_s=_number(facts.get("boot_s")),
            device_s=_number(facts.get("device_s")),
        )

    def facts(self) -> dict[str, Any]:
        """For a journal record."""
        return {
            "wall_s": self.wall_s,
            "boot_id": self.boot_id,
            "boot_s": self.boot_s,
            "device_s": self.device_s,
        }


UNKNOWN: Final = Stamp()


@dataclass(frozen=True, slots=True)
class Now:
    """The present by the same clocks, and how long ago this run last read the whole journal."""

    stamp: Stamp
    run_s: float = 0.0


def _number(value: object) -> float | None:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if plain and math.isfinite(value) else None  # type: ignore[arg-type]


def same_boot_s(record: Stamp, now: Stamp) -> float | None:
    """The age of the record by boottime; None where it is of another boot, or claims to be ahead"""
    if not record.boot_id or record.boot_id != now.boot_id:
        return None
    if record.boot_s is None or now.boot_s is None or now.boot_s < record.boot_s:
        return None
    return now.boot_s - record.boot_s


def restarted_since(record: Stamp, now: Stamp, uptime_s: float | None) -> bool:
    """Whether a device with this time since its start-up must have restarted after the record.

    A device whose clock is a thousandth slow is not taken for one that restarted. A time that fell
    to more than has passed since the record is a clock that jumped, and no restart.
    """
    if uptime_s is None or not math.isfinite(uptime_s) or uptime_s < 0.0:
        return False
    fell = record.device_s is not None and uptime_s < record.device_s - LATENCY_S
    if not record.boot_id or record.boot_id != now.boot_id:
        return fell
    age_s = same_boot_s(record, now)
    if age_s is None:
        return False
    started_later = uptime_s < age_s * (1.0 - CLOCK_RATE) - LATENCY_S
    return started_later or (fell and uptime_s <= age_s * (1.0 + CLOCK_RATE) + LATENCY_S)


def passed_s(records: Sequence[Stamp], now: Now) -> list[float]:
    """For each record, oldest first, the least time that must have passed since; at least 0.

    A record is at least as old as every record behind it.
    """
    least: list[float] = []
    newest_s = 0.0
    for record in reversed(records):
        newest_s = max(newest_s, _passed_s(record, now))
        least.append(newest_s)
    return least[::-1]


def _passed_s(record: Stamp, now: Now) -> float:
    wall_s = None
    if plausible(record.wall_s) and plausible(now.stamp.wall_s):
        wall_s = (now.stamp.wall_s or 0.0) - (record.wall_s or 0.0)
    if record.boot_id and record.boot_id == now.stamp.boot_id:
        age_s = same_boot_s(record, now.stamp)
        known = [s for s in (age_s, wall_s) if s is not None]
        return min(known) if age_s is not None else 0.0
    up_s = 0.0
    if now.stamp.boot_id:  # what this run writes has its boot id: this was there before
        up_s = now.run_s if not record.boot_id else now.stamp.boot_s or 0.0
    return max(up_s, 0.0 if wall_s is None else wall_s - WALL_ERROR_S)


def plausible(wall_s: float | None) -> bool:
    """Whether somebody has set this wall clock."""
    return wall_s is not None and wall_s >= PLAUSIBLE_FROM_S
