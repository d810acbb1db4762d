"""Files that are no recording of ours, told by how they begin, and what makes one of them."""

from __future__ import annotations

from dataclasses import dataclass

_TABLE = (
    "write a table of it: time_s, mag_{x,y,z}_gauss, gyro_{x,y,z}_rad_s, one row a sample "
    "(other names and units: --columns mag_x=NAME:uT,...)"
)
ROS = (
    "write sensor_msgs/Imu and MagneticField (tesla) into one table by time, for example with the "
    "Python package rosbags, then --columns time=NAME:ns,mag_x=NAME:T,..."
)


@dataclass(frozen=True, slots=True)
class Foreign:
    """What a file is, and what to do."""

    what: str
    remedy: str


#: (how the file begins, what it is, what to do); the first that fits
_STARTS: tuple[tuple[bytes, str, str], ...] = (
    (
        b"version https://git-lfs.github.com/spec/",
        "is a Git LFS pointer, the recording itself is not here",
        "fetch it with `git lfs pull`",
    ),
    (
        b"/annex/objects/",
        "is a git-annex pointer, the recording itself is not here",
        "fetch it with `git annex get`",
    ),
    (b"#ROSBAG V2.0", "is a ROS 1 bag", ROS),
    (b"SQLite format 3\0", "is an SQLite database, as ROS 2 bags (.db3) are", ROS),
    (b"ULog\x01\x12\x35", "is a PX4 ULog", _TABLE),
    (b"\xa3\x95\x80\x80", "is an ArduPilot DataFlash log", _TABLE),
    (b"\x89HDF\r\n\x1a\n", "is an HDF5 file", _TABLE),
    (b"MATLAB 5.0 MAT-file", "is a MATLAB file", _TABLE),
    (b"\x93NUMPY", "is a NumPy array", _TABLE),
    (b"PK\x03\x04", "is a zip archive or a spreadsheet", "unpack it, or save it as CSV"),
    (b"\xfd7zXZ\0", "is packed with xz", "unpack it with `xz -d`"),
    (b"(\xb5/\xfd", "is packed with zstd", "unpack it with `zstd -d`"),
    (b"BZh", "is packed with bzip2", "unpack it with `bzip2 -d`"),
    (b"7z\xbc\xaf\x27\x1c", "is a 7z archive", "unpack it"),
    (b"\xd4\xc3\xb2\xa1", "is a network capture (pcap)", "save the payload as .vnraw"),
    (b"\n\r\r\n", "is a network capture (pcapng)", "save the payload as .vnraw"),
    (b"%PDF-", "is a PDF", "give the recording"),
    (b"\x89PNG", "is a picture", "give the recording"),
)
_PAGES = (b"<!doctype html", b"<html")


def recognised(start: bytes) -> Foreign | None:
    """What a file that begins so is, if it is one of those that people bring."""
    for magic, what, remedy in _STARTS:
        if start.startswith(magic):
            return Foreign(what, remedy)
    if start[257:262] == b"ustar":
        return Foreign("is a tar archive", "unpack it")
    if start.lstrip()[:20].lower().startswith(_PAGES):
        return Foreign("is a web page, not the file behind its link", "download the file itself")
    return None
