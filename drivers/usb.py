"""The latency timer of a USB serial adapter (FTDI): how long it may hold bytes back.

The default of 16 ms bunches the samples of a 200 Hz stream by three; 1 ms does not. sysfs shows it
as ``/sys/class/tty/NAME/device/latency_timer``; writing it takes privileges or a udev rule.
"""

from __future__ import annotations

from pathlib import Path

SYSFS = Path("/sys")
_LONGEST_MS = 255


def latency_timer_ms(path: str | Path, sysfs: Path = SYSFS) -> int | None:
    """The adapter's latency timer, None where the port has none (or it cannot be read)."""
    try:
        text = _file(path, sysfs).read_text().strip()
    except (OSError, UnicodeDecodeError):
        return None
    return int(text) if text.isascii() and text.isdecimal() else None


def set_latency_timer(path: str | Path, milliseconds: int, sysfs: Path = SYSFS) -> int | None:
    """Ask for another latency timer; returns what it is now, changed or not."""
    if not 1 <= milliseconds <= _LONGEST_MS:
        raise ValueError(f"a latency timer is 1..{_LONGEST_MS} ms, not {milliseconds}")
    present = latency_timer_ms(path, sysfs)
    if present is None or present == milliseconds:
        return present
    try:
        _file(path, sysfs).write_text(f"{milliseconds}\n")
    except OSError:  # not allowed: what the caller gets says so
        return present
    return latency_timer_ms(path, sysfs)


def _file(path: str | Path, sysfs: Path) -> Path:
    return sysfs / "class" / "tty" / Path(path).resolve().name / "device" / "latency_timer"
