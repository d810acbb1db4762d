"""The registry of recordings of other programs, told by their content and never by their name.

A reader's library is imported when a file of its kind is opened; where it is absent, one line says
which extra brings it.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ahrsd.errors import RecordingError
from ahrsd.recording.bytestream import is_gzip
from ahrsd.recording.foreign.sensors import Choice, RawBytes, Sensors
from ahrsd.recording.limits import STREAM_BYTES, refuse_beyond

_MCAP = b"\x89MCAP0\r\n"
_ROS_2 = b"\x04\0\0\0ros2"


@dataclass(frozen=True, slots=True)
class Format:
    """One kind of file.

    what:    as a sentence about the file goes on
    begins:  whether a file with this start is one
    picks:   the option that chooses where it holds several sensors
    library: Python package that reads it, of the extra; empty where we do
    read:    its sensors, or the bytes of its device; list: one line about each thing in it
    """

    what: str
    begins: Callable[[bytes], bool]
    picks: str
    library: str
    extra: str
    read: Callable[[Path, Choice], Sensors | RawBytes]
    list: Callable[[Path], list[str]]


def _ros_2_mcap(start: bytes) -> bool:
    """An MCAP file whose header, the first record, names the profile of ROS 2."""
    return start.startswith(_MCAP + b"\x01") and start[17:].startswith(_ROS_2)


def _ros(what: str, suffix: str, begins: Callable[[bytes], bool]) -> Format:
    def read(path: Path, choice: Choice) -> Sensors | RawBytes:
        from ahrsd.recording.foreign import ros

        return ros.read(path, suffix, choice)

    def listed(path: Path) -> list[str]:
        from ahrsd.recording.foreign import ros

        return ros.listed(path, suffix)

    return Format(what, begins, "topic", "rosbags", "ros", read, listed)


def _read_ardupilot(path: Path, choice: Choice) -> Sensors:
    from ahrsd.recording.foreign import ardupilot

    return ardupilot.read(path, choice)


def _list_ardupilot(path: Path) -> list[str]:
    from ahrsd.recording.foreign import ardupilot

    return ardupilot.listed(path)


def _read_px4(path: Path, choice: Choice) -> Sensors:
    from ahrsd.recording.foreign import ulog

    return ulog.read(path, choice)


def _list_px4(path: Path) -> list[str]:
    from ahrsd.recording.foreign import ulog

    return ulog.listed(path)


FOLDER = _ros("is a ROS 2 recording", "", lambda _: False)  # a folder with metadata.yaml
FORMATS: tuple[Format, ...] = (
    _ros("is a ROS 1 bag", ".bag", lambda start: start.startswith(b"#ROSBAG V2.0")),
    _ros("is a ROS 2 recording (MCAP)", ".mcap", _ros_2_mcap),
    _ros(
        "is a ROS 2 recording (SQLite)",
        ".db3",
        lambda start: start.startswith(b"SQLite format 3\0"),
    ),
    Format(
        "is an ArduPilot DataFlash log",
        lambda start: start.startswith(b"\xa3\x95\x80\x80"),
        "compass", "", "", _read_ardupilot, _list_ardupilot,
    ),
    Format(
        "is a PX4 log (ULog)",
        lambda start: start.startswith(b"ULog\x01\x12\x35"),
        "compass", "pyulog", "px4", _read_px4, _list_px4,
    ),
)  # fmt: skip


def format_of(path: Path, start: bytes) -> Format | None:
    """The kind of a file that begins so, or of a folder; None where it is none of these."""
    if path.is_dir():
        return FOLDER if (path / "metadata.yaml").is_file() else None
    return next((one for one in FORMATS if one.begins(start)), None)


def ready(path: Path, kind: Format) -> None:
    """Raise RecordingError where the file cannot be read here: packed, too large, no library."""
    if not path.is_dir():
        if is_gzip(path):
            raise RecordingError(
                path, f"{kind.what}, packed with gzip", f"unpack it: gunzip {path.name}"
            )
        refuse_beyond(path, path.stat().st_size, STREAM_BYTES, "bytes", "cut it in parts")
    if kind.library and importlib.util.find_spec(kind.library) is None:
        raise RecordingError(
            path,
            f"{kind.what}, which the package {kind.library} reads and which is not installed",
            f"install it: pip install 'ahrsd[{kind.extra}]'",
        )
