"""How fast recordings of other programs are read.

    python tests/benchmarks/recording/bench_files.py [FORMAT ...] [--megabytes 60]

`camera` is a ROS 1 bag as a vehicle records it, with pictures beside the sensors.

A file of each format of some 60 MB (`--megabytes`), processor time of `open_recording` on it, and
the ratio to a peer that reads the same file in the same run: for ROS and PX4 the library itself,
every message decoded and nothing done with it; for a DataFlash log one `struct` for
each message, as a reader without numpy does.
"""

from __future__ import annotations

import argparse
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

import dataflash_files
import ros_files
import ulog_files

from ahrsd.recording.opening import open_recording

FORMATS = ("dataflash", "bag", "camera", "mcap", "db3", "ulog")
BYTES_PER_ROW = {"dataflash": 118, "bag": 540, "camera": 5540, "mcap": 525, "db3": 550, "ulog": 196}
RATE_HZ = 100.0


@dataclass(frozen=True)
class Result:
    """What one file took, in seconds of processor time."""

    format: str
    megabytes: float
    rows: int
    read_s: float
    peer_s: float

    def __str__(self) -> str:
        return (
            f"{self.format:10} {self.megabytes:6.1f} MB {self.rows:8,} rows "
            f"{self.read_s:6.2f} s  {self.megabytes / self.read_s:7.1f} MB/s  "
            f"{self.read_s / self.peer_s:5.2f} x its peer"
        )


def written(name: str, folder: Path, megabytes: float) -> Path:
    """A recording of about that size."""
    data = ros_files.sensor(max(400, round(megabytes * 1e6 / BYTES_PER_ROW[name])), RATE_HZ)
    if name == "dataflash":
        slow = {key: values[::10] for key, values in data.items()}
        other = [  # what most of a log is: messages that nobody needs here
            (t, dataflash_files.message("MSG", dataflash_files.us(t), b"")) for t in data["time_s"]
        ]
        return dataflash_files.save(
            folder / "log.bin",
            dataflash_files.mags(slow["time_s"], 1e3 * slow["mag"], np.zeros(3), np.zeros(3)),
            dataflash_files.imus(data["time_s"], data["gyro"], data["accel"]),
            other,
        )
    if name == "ulog":
        messages = ulog_files.mags(data["time_s"], data["mag"])
        messages += ulog_files.combined(data["time_s"], data["gyro"], data["accel"])
        messages += [
            ("vehicle_attitude", 0, t, (1.0, 0.0, 0.0, 0.0)) for t in np.repeat(data["time_s"], 4)
        ]
        return ulog_files.save(folder / "log.ulg", messages)
    messages = ros_files.imu(data) + ros_files.magnetic(data)
    if name == "camera":
        picture = np.random.default_rng(1).integers(0, 256, 50_000, dtype=np.uint8)
        messages += [
            ("/camera", "sensor_msgs/msg/CompressedImage", ros_files.ns_of(t), {"data": picture})
            for t in data["time_s"][::10]
        ]
        name = "bag"
    return ros_files.save(folder, name, messages, name)


def by_struct(path: Path) -> int:
    """Messages of a DataFlash log, each by a `struct` of its own."""
    layouts = {
        number: struct.Struct("<" + "".join(dataflash_files.SIZES[code] for code in codes))
        for number, codes, _ in dataflash_files.TYPES.values()
    }
    layouts[128] = struct.Struct("<BB4s16s64s")
    data, at, count = path.read_bytes(), 0, 0
    while at < len(data):
        layout = layouts[data[at + 2]]
        layout.unpack_from(data, at + 3)
        at += 3 + layout.size
        count += 1
    return count


def by_rosbags(path: Path) -> int:
    """Messages of a ROS recording, decoded by the library."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    place = path if path.suffix == ".bag" else path.parent
    with AnyReader([place], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        return sum(
            reader.deserialize(data, connection.msgtype) is not None
            for connection, _, data in reader.messages()
        )


def by_pyulog(path: Path) -> int:
    """Messages of a PX4 log, by the library."""
    from pyulog import ULog

    return sum(len(topic.data["timestamp"]) for topic in ULog(str(path)).data_list)


PEERS: dict[str, Callable[[Path], int]] = {
    "dataflash": by_struct,
    "bag": by_rosbags,
    "camera": by_rosbags,
    "mcap": by_rosbags,
    "db3": by_rosbags,
    "ulog": by_pyulog,
}


def took(work: Callable[[], object], times: int = 2) -> float:
    """Processor seconds, the least of some runs: what else runs only adds to it."""
    found = []
    for _ in range(times):
        begun = time.process_time()
        work()
        found.append(time.process_time() - begun)
    return min(found)


def measured(name: str, folder: Path, megabytes: float) -> Result:
    """One format, read by us and by its peer."""
    folder.mkdir(parents=True, exist_ok=True)
    path = written(name, folder, megabytes)
    recording = open_recording(path)
    assert recording.table is not None
    return Result(
        name,
        path.stat().st_size / 1e6,
        len(recording.table.rows),
        took(lambda: open_recording(path)),
        took(lambda: PEERS[name](path)),
    )


def main() -> None:
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("formats", nargs="*", default=FORMATS, help=", ".join(FORMATS))
    words.add_argument("--megabytes", type=float, default=60.0)
    given = words.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in given.formats:
            print(measured(name, Path(folder) / name, given.megabytes), flush=True)


if __name__ == "__main__":
    main()
