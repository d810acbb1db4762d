"""Captures: order, kill, full disk, damage; the writer never raises and never stalls."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime
from errno import ENOSPC
from io import FileIO
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from ahrsd.errors import CaptureError, RecordingError
from ahrsd.inputs import (
    ClientLeft,
    ClientSent,
    Columns,
    EarlierRun,
    EarlierSamples,
    Examined,
    Input,
    Interlock,
    Journalled,
    JournalOpened,
    LimitsChanged,
    LinkLost,
    LinkOpened,
    Operator,
    Received,
    RegistersKnown,
    Samples,
    Stop,
    TermsKnown,
    Tick,
    WallClock,
)
from ahrsd.recording import capture
from ahrsd.recording.capture import (
    CaptureReader,
    CaptureWriter,
    Sent,
    make_private_folder,
    new_capture_path,
    part_path,
)
from ahrsd.samples import SampleBlock

EVERY_INPUT: list[Input] = [
    LinkOpened(5, "/dev/ttyUSB0", 115200, 16),
    RegistersKnown(
        6,
        {23: (1.0, 0.0, 1e-7, 0, 1, 0, 0, 0, 1, 0.1, -0.2, 1e-9), 1: ("VN-100",), 5: (115200, 0)},
        "capture",
    ),
    Received(10, b"\xfa\x00\r\n$VN"),
    Tick(11),
    WallClock(11, 1762171200.25),
    Received(12, b""),
    Interlock(13, True),
    TermsKnown(13, '{"schema": "ahrsd.model/1"}'),
    Columns(13, {"motor_current_a": 3.25}),
    Operator(14, "approve", "ab12"),
    ClientSent(5, "/run/ahrsd/vn100", "$VNRRG,01*72\r\n\xff"),
    ClientLeft(6, "/run/ahrsd/vn100"),
    LinkLost(15, "unplugged"),
    JournalOpened(15, 100012345, [{"seq": 1, "old": {"23": [1.0, 1e-7]}}], "line 2 is damaged"),
    Journalled(15, "PREPARED"),
    EarlierRun(48, "", "a.mcap", "VN-100", 7, "2.0", {44: (0, 1, 5)}, (True, False), "b", 2.0, 1e9),
    Examined(15, 3, "LinAlgError: Singular matrix"),
    LimitsChanged(15, {"max_heading_sigma_deg": 0.5, "min_rate_hz": 10.0}),
    Stop(16, "SIGTERM"),
]


def write(path: Path, items: list[Input | Sent], **options) -> None:
    with CaptureWriter(path, {"device": "VN-100 0100012345"}, **options) as writer:
        for item in items:
            if isinstance(item, Sent):
                writer.write_sent(item.host_ns, item.data)
            else:
                writer.write(item)


def wait_until(condition, seconds: float = 5.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.01)


def test_inputs_and_sent_commands_are_read_back_in_order(tmp_path):
    items = [*EVERY_INPUT[:4], Sent(11, b"$VNRRG,23*XX\r\n"), *EVERY_INPUT[4:]]
    write(tmp_path / "a.mcap", items)
    reader = CaptureReader(tmp_path / "a.mcap")
    assert list(reader) == items
    assert reader.notes == []
    assert reader.header["device"] == "VN-100 0100012345"
    assert reader.header["wall_utc"].endswith("+00:00")


def test_side_channels(tmp_path):
    with CaptureWriter(tmp_path / "a.mcap", {}) as writer:
        writer.write_event(1, {"state": "CANDIDATE", "value": np.float64(0.5), "path": tmp_path})
        writer.write_registers(2, {"23": [1.0, 2.0]})
    reader = CaptureReader(tmp_path / "a.mcap")
    assert list(reader) == []
    assert list(reader.facts("event")) == [
        (1, {"state": "CANDIDATE", "value": 0.5, "path": str(tmp_path)})
    ]
    assert list(reader.facts("registers")) == [(2, {"23": [1.0, 2.0]})]


def test_every_kind_of_input_can_be_recorded():
    assert {type(item) for item in EVERY_INPUT} | {Samples, EarlierSamples} == set(get_args(Input))


def test_samples_survive_json():
    block = SampleBlock(
        time_s=np.array([0.1, 0.2]),
        dt_s=np.array([np.nan, 0.1]),
        host_s=np.array([1.0, 1.1]),
        raw_b_gauss=np.array([[0.1, 0.2, 1 / 3]] * 2),
        gyro_b_rad_s=np.zeros((2, 3)),
        accel_b_m_s2=np.full((2, 3), np.nan),
        covariates={"temperature_c": np.array([20.0, 20.5])},
        epoch=3,
        gap_before=True,
    )
    back = capture.input_from_json(capture.input_to_json(Samples(7, block)))
    assert isinstance(back, Samples)
    np.testing.assert_array_equal(back.block.raw_b_gauss, block.raw_b_gauss)
    np.testing.assert_array_equal(back.block.dt_s, block.dt_s)
    np.testing.assert_array_equal(
        back.block.covariates["temperature_c"], block.covariates["temperature_c"]
    )
    assert (back.host_ns, back.block.epoch, back.block.gap_before) == (7, 3, True)


@given(st.binary(max_size=60) | st.sampled_from([b'{"type":"Tick"}', b'{"type":"x"}', b"[1]"]))
def test_invalid_input_raises_a_value_error(data):
    with pytest.raises(ValueError):
        capture.input_from_json(data)


def test_other_tools_can_read_it(tmp_path):
    write(tmp_path / "a.mcap", EVERY_INPUT)
    with (tmp_path / "a.mcap").open("rb") as file:
        found = [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert ("rx", 10, b"\xfa\x00\r\n$VN") in found
    assert len(found) == len(EVERY_INPUT)


def test_an_existing_file_is_never_overwritten(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(CaptureError, match="exists already"):
        CaptureWriter(tmp_path / "a.mcap", {})
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    with pytest.raises(CaptureError, match="No such file"):
        CaptureWriter(tmp_path / "missing" / "a.mcap", {})


def test_a_new_part_begins_beyond_the_size_and_reads_as_one(tmp_path):
    items: list[Input | Sent] = [Received(k, os.urandom(90_000)) for k in range(12)]
    write(tmp_path / "a.mcap", items, part_bytes=200_000)
    assert part_path(tmp_path / "a.mcap", 3).exists()
    assert list(CaptureReader(tmp_path / "a.mcap")) == items
    tail = CaptureReader(part_path(tmp_path / "a.mcap", 2))
    received = list(tail)
    assert received == items[-len(received) :]
    assert 0 < len(received) < len(items)


def test_the_oldest_captures_of_the_daemon_go_and_nothing_else(tmp_path):
    for name, age_s in [("ahrsd-1.mcap", 30), ("ahrsd-2.mcap", 20), ("mine.mcap", 40)]:
        (tmp_path / name).write_bytes(bytes(100_000))
        os.utime(tmp_path / name, (1e9 - age_s, 1e9 - age_s))
    path = new_capture_path(tmp_path, datetime(2026, 11, 3, 12, 0, 0, tzinfo=UTC))
    assert path.name == "ahrsd-20261103T120000Z.mcap"
    items: list[Input | Sent] = [Received(k, os.urandom(90_000)) for k in range(12)]
    write(path, items, part_bytes=200_000, keep_bytes=700_000)
    names = {file.name for file in tmp_path.iterdir()}
    assert "mine.mcap" in names
    assert "ahrsd-1.mcap" not in names
    assert "ahrsd-2.mcap" not in names
    assert part_path(path, 4).exists()
    assert sum(file.stat().st_size for file in tmp_path.glob("ahrsd-*")) <= 1_000_000
    path.touch()
    assert new_capture_path(tmp_path, datetime(2026, 11, 3, 12, 0, 0, tzinfo=UTC)).name == (
        "ahrsd-20261103T120000Z-2.mcap"
    )


KILLED = """
import sys, time
from pathlib import Path
from ahrsd.inputs import Received
from ahrsd.recording.capture import CaptureWriter
writer = CaptureWriter(Path(sys.argv[1]), {})
for k in range(10**9):
    writer.write(Received(k, b"%08d" % k))
    if k % 20 == 0:
        print(k, time.monotonic(), flush=True)
    time.sleep(0.002)
"""


def test_kill_9_costs_at_most_half_a_second(tmp_path):
    path = tmp_path / "killed.mcap"
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    stamps = []
    for line in child.stdout:
        stamps.append((int(line.split()[0]), float(line.split()[1])))
        if len(stamps) > 1 and stamps[-1][1] - stamps[0][1] > 1.5:
            break
    child.send_signal(signal.SIGKILL)
    child.communicate()
    reader = CaptureReader(path)
    found = [item for item in reader if isinstance(item, Received)]
    assert [item.data for item in found] == [b"%08d" % k for k in range(len(found))]
    durable = [k for k, at_s in stamps if at_s < stamps[-1][1] - 0.5]
    assert len(found) > durable[-1] > 0
    assert len(reader.notes) == 1
    assert "was not closed" in reader.notes[0]


def test_every_truncation_reads_up_to_its_last_whole_block(tmp_path):
    items: list[Input | Sent] = [Received(k, os.urandom(50_000)) for k in range(12)]
    write(tmp_path / "whole.mcap", items)
    data = (tmp_path / "whole.mcap").read_bytes()
    counts = set()
    for size in [*range(2000, len(data), 9973), len(data) - 30]:
        (tmp_path / "cut.mcap").write_bytes(data[:size])
        reader = CaptureReader(tmp_path / "cut.mcap")
        found = list(reader)
        assert found == items[: len(found)]
        assert len(reader.notes) == 1
        counts.add(len(found))
    assert min(counts) == 0
    assert max(counts) == len(items)


def test_damaged_block_is_skipped_and_reported(tmp_path):
    items: list[Input | Sent] = [Received(k, os.urandom(100_000)) for k in range(9)]
    write(tmp_path / "a.mcap", items)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(data)
    reader = CaptureReader(tmp_path / "a.mcap")
    found = list(reader)
    assert 0 < len(found) < len(items)
    assert all(item in items for item in found)
    assert "damaged block" in reader.notes[0]
    assert "missing: " in reader.notes[1]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"$VNYMR,+1.0*00\r\n" * 9, "is not a capture of ahrsd"),
        (b"\x89MCAP0\r\n", "ends within its header"),
        (b"\x89MCAP0\r\n\x01\x08\x00\x00\x00\x00\x00\x00\x00" + bytes(8), "is not a capture"),
        (b"\x89MCAP0\r\n" + b"\xff" * 50, "ends within its header"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path, data, words):
    (tmp_path / "x.mcap").write_bytes(data)
    with pytest.raises(RecordingError, match=words) as caught:
        CaptureReader(tmp_path / "x.mcap")
    assert "\n" not in str(caught.value)
    assert "x.mcap" in str(caught.value)


class Disk(FileIO):
    """A file whose writes fail while `full` is set, after half of the bytes."""

    full = False
    stalled = threading.Event()
    stalled.set()

    def write(self, data) -> int:
        self.stalled.wait()
        if type(self).full:
            super().write(bytes(data)[: len(data) // 2])
            raise OSError(ENOSPC, os.strerror(ENOSPC))
        return super().write(data)


def new_disk() -> type[Disk]:
    released = threading.Event()
    released.set()
    return type("OneDisk", (Disk,), {"full": False, "stalled": released})


def test_a_full_disk_costs_nothing_while_the_queue_holds(tmp_path):
    disk = new_disk()
    writer = CaptureWriter(tmp_path / "a.mcap", {}, create=lambda p: disk(p, "xb"))
    writer.write(Received(1, b"before"))
    wait_until(lambda: writer.status.records == 1)
    disk.full = True
    writer.write(Received(2, b"during"))
    wait_until(lambda: writer.status.error == os.strerror(ENOSPC))
    assert writer.status.queued_bytes > 0
    disk.full = False
    wait_until(lambda: writer.status.error == "")
    writer.write(Received(3, b"after"))
    status = writer.close()
    assert (status.records, status.lost_records, status.complete) == (3, 0, True)
    reader = CaptureReader(tmp_path / "a.mcap")
    assert list(reader) == [Received(1, b"before"), Received(2, b"during"), Received(3, b"after")]
    assert reader.notes == []


def test_dropped_items_are_counted_and_reported_by_the_reader(tmp_path):
    disk = new_disk()
    disk.full = True
    writer = CaptureWriter(
        tmp_path / "a.mcap", {}, queue_bytes=3000, create=lambda p: disk(p, "xb")
    )
    for k in range(20):
        writer.write(Received(k, bytes(800)))
    status = writer.status
    assert (status.lost_records, status.lost_bytes) == (17, 17 * 800)
    assert status.queued_bytes <= 3000
    disk.full = False
    wait_until(lambda: writer.status.queued_bytes == 0)
    writer.write(Received(99, b"later"))
    writer.close()
    reader = CaptureReader(tmp_path / "a.mcap")
    assert [item.host_ns for item in reader] == [0, 1, 2, 99]
    assert reader.notes == ["a.mcap: missing: 17 records"]


def test_a_stalled_disk_does_not_stall_the_caller(tmp_path):
    disk = new_disk()
    writer = CaptureWriter(tmp_path / "a.mcap", {}, create=lambda p: disk(p, "xb"))
    disk.stalled.clear()
    writer.write(Received(0, b"wakes the thread"))
    time.sleep(0.4)  # the thread is inside write(2) now
    slowest_s = 0.0
    for k in range(2000):
        start_s = time.perf_counter()
        writer.write(Received(k, bytes(100)))
        slowest_s = max(slowest_s, time.perf_counter() - start_s)
    assert slowest_s < 0.2
    assert writer.status.queued_bytes > 2000 * 100
    disk.stalled.set()
    assert writer.close().records == 2001


def test_closing_on_a_full_disk_reports_the_loss(tmp_path):
    disk = new_disk()
    disk.full = True
    writer = CaptureWriter(tmp_path / "a.mcap", {}, create=lambda p: disk(p, "xb"))
    writer.write(Received(1, b"12345"))
    status = writer.close()
    assert (status.records, status.lost_records, status.lost_bytes) == (0, 1, 5)
    assert status.error == os.strerror(ENOSPC)


def test_a_real_full_disk_resumes_when_space_returns(small_disk):
    filler = small_disk / "filler"
    filler.write_bytes(bytes(180_000))
    writer = CaptureWriter(small_disk / "a.mcap", {}, queue_bytes=10**6)
    for k in range(12):
        writer.write(Received(k, os.urandom(10_000)))
    wait_until(lambda: writer.status.error == os.strerror(ENOSPC))
    filler.unlink()
    wait_until(lambda: writer.status.queued_bytes == 0)
    assert writer.close().complete
    assert [item.host_ns for item in CaptureReader(small_disk / "a.mcap")] == list(range(12))


def test_memory_does_not_grow_with_the_file(tmp_path):
    with CaptureWriter(tmp_path / "a.mcap", {}) as writer:
        threads = threading.active_count()
        for k in range(5000):
            writer.write(Received(k, bytes(64)))
        wait_until(lambda: writer.status.queued_bytes == 0)
        assert len(writer._queue) == 0
    assert threading.active_count() == threads - 1


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_a_capture_and_its_folder_are_for_their_owner_alone(tmp_path, umask):
    """It holds where the vehicle was."""
    before = os.umask(umask)
    try:
        folder = tmp_path / "state" / "captures"
        make_private_folder(folder)
        with CaptureWriter(folder / "a.mcap", {}, part_bytes=1) as writer:
            writer.write(Received(1, b"x" * 100))
            wait_until(lambda: writer.status.records == 1, 60.0)
            writer.write(Received(2, b"y"))
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode & 0o777 for path in folder.iterdir()}
    assert modes == {"a.mcap": 0o600, "a.part2.mcap": 0o600}
    assert [p.stat().st_mode & 0o777 for p in (folder, folder.parent)] == [0o700, 0o700]


def test_a_folder_that_exists_keeps_its_mode(tmp_path):
    tmp_path.chmod(0o755)
    make_private_folder(tmp_path)
    assert tmp_path.stat().st_mode & 0o777 == 0o755
