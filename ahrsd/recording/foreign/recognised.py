"""Files that are no recording of ours, told by how they begin, and what makes one of them."""

from __future__ import annotations

import re
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
    (b"\x1f\x8b", "is packed with gzip twice", "unpack it once with `gunzip`"),
    (b"\x04\x22\x4d\x18", "is packed with lz4", "unpack it with `lz4 -d`"),
    (b"Rar!\x1a\x07", "is a RAR archive", "unpack it"),
    (b"\xd0\xcf\x11\xe0", "is a spreadsheet or document of Microsoft Office", "save it as CSV"),
    (b"ARROW1\0\0", "is an Arrow or Feather file", "write it as Parquet"),
    (b"FEA1", "is a Feather file", "write it as Parquet"),
    (b"Obj\x01", "is an Avro file", _TABLE),
    (b"\x80\x04\x95", "is a Python pickle", _TABLE),
    (b"\x80\x05\x95", "is a Python pickle", _TABLE),
    (b"FMT, 128", "is an ArduPilot log as text", "give the .bin log from which it was made"),
    (b"FMT,128", "is an ArduPilot log as text", "give the .bin log from which it was made"),
    (b"7z\xbc\xaf\x27\x1c", "is a 7z archive", "unpack it"),
    (b"\xd4\xc3\xb2\xa1", "is a network capture (pcap)", "save the payload as .vnraw"),
    (b"\n\r\r\n", "is a network capture (pcapng)", "save the payload as .vnraw"),
    (b"%PDF-", "is a PDF", "give the recording"),
    (b"\x89PNG", "is a picture", "give the recording"),
)
_PAGES = (b"<!doctype html", b"<html")
#: what text is: a pattern from its first byte that is no blank
_TEXTS: tuple[tuple[re.Pattern[bytes], str, str], ...] = (
    (
        re.compile(rb'\{\s*"[^"\n]*"\s*:|\[\s*[\[{]'),
        "is JSON, not a table",
        "write a table of it, for example with pandas: read_json(FILE, lines=True).to_csv(...)",
    ),
    (
        re.compile(rb"(?s)(?:---\s+)?[a-z_]+:\s.*^ *(?:magnetic_field|angular_velocity|stamp):\s*$",
                   re.MULTILINE),
        "is what `rostopic echo` prints",
        "give the bag, or a table of `rostopic echo -p`",
    ),
    (
        re.compile(rb"(?i)[0-9a-f]{4,16}(?:: ?|  +)(?:[0-9a-f]{2} ?){8}"),
        "is a hex dump, not the bytes themselves",
        "convert it: `xxd -r FILE > FILE.vnraw`",
    ),
    (
        re.compile(rb"(?i)(?=[^\n]*[a-f])(?:(?:(?:0x)?[0-9a-f]{2}[ ,:\r\n]+){24}|[0-9a-f]{48})"),
        "is a hex dump, not the bytes themselves",
        "convert it: `xxd -r -p FILE > FILE.vnraw`",
    ),
    (
        re.compile(rb"(?:[A-Za-z0-9+/]{76}\r?\n){3}"),
        "is base64, not the bytes themselves",
        "convert it: `base64 -d FILE > FILE.vnraw`",
    ),
)  # fmt: skip


def recognised(start: bytes) -> Foreign | None:
    """What a file that begins so is, if it is one of those that people bring."""
    for magic, what, remedy in _STARTS:
        if start.startswith(magic):
            return Foreign(what, remedy)
    if start[257:262] == b"ustar":
        return Foreign("is a tar archive", "unpack it")
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    for pattern, what, remedy in _TEXTS:
        if pattern.match(text):
            return Foreign(what, remedy)
    if start.lstrip()[:20].lower().startswith(_PAGES):
        return Foreign("is a web page, not the file behind its link", "download the file itself")
    return None
