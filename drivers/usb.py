"""The latency timer of a USB serial adapter (FTDI): how long it may hold bytes back.

The default of 16 ms bunches the samples of a 200 Hz stream by three; 1 ms does not. sysfs shows it
as ``/sys/class/tty/NAME/device/latency_timer`` (a udev rule sets it).
"""

from __future__ import annotations

from pathlib import Path

SYSFS = Path("/sys")


def latency_timer_ms(path: str | Path, sysfs: Path = SYSFS) -> int | None:
    """The adapter's latency timer, None where the port has none (or it cannot be read)."""
    try:
        text = _file(path, sysfs).read_text().strip()
    except (OSError, UnicodeDecodeError):
        return None
    return int(text) if text.isascii() and text.isdecimal() else None


def _file(path: str | Path, sysfs: Path) -> Path:
    return sysfs / "class" / "tty" / Path(path).resolve().name / "device" / "latency_timer"
