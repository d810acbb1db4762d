"""Any recording opens the same way and ends in Stop."""

from __future__ import annotations

import gzip

import numpy as np
import pytest

from ahrsd.errors import RecordingError
from ahrsd.inputs import LinkOpened, Received, RegistersKnown, Samples, Stop
from ahrsd.recording.capture import CaptureWriter
from ahrsd.recording.opening import RecordingKind, open_recording

TABLE = "time_s,mag_x_gauss,mag_y_gauss,mag_z_gauss,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s\n"
TABLE += "".join(f"{100 + 0.1 * k:.1f},0.2,0.1,0.4,0.0,0.0,0.1\n" for k in range(1500))
SENTENCES = b"$VNYMR,+010.071*64\r\n" * 400


def capture(path, *items) -> None:
    with CaptureWriter(path, {"device": "VN-100"}) as writer:
        for item in items:
            writer.write(item)
        writer.write_sent(7, b"$VNRRG,01*72\r\n")


@pytest.mark.parametrize("name", ["a.vnraw", "a.vnbin", "a.bin", "a.log", "a.txt", "A.VNRAW"])
@pytest.mark.parametrize("zipped", [False, True])
def test_byte_streams(tmp_path, name, zipped):
    path = tmp_path / (name + ".gz" * zipped)
    path.write_bytes(gzip.compress(SENTENCES, mtime=0) if zipped else SENTENCES)
    recording = open_recording(path, rate_hz=40.0)
    assert (recording.kind, recording.rate_hz, recording.notes) == (RecordingKind.BYTES, 40.0, [])
    *received, stop = recording.inputs()
    assert b"".join(item.data for item in received) == SENTENCES
    assert stop == Stop(0, "end of recording")


def test_tables(tmp_path):
    (tmp_path / "t.csv").write_text(TABLE)
    recording = open_recording(tmp_path / "t.csv")
    assert (recording.kind, recording.name) == (RecordingKind.TABLE, "t.csv")
    first, second, stop = recording.inputs()
    assert isinstance(first, Samples)
    assert isinstance(second, Samples)
    assert (len(first.block), len(second.block)) == (1024, 476)
    assert (first.block.gap_before, second.block.gap_before) == (True, False)
    np.testing.assert_allclose(second.block.dt_s, 0.1)
    assert second.host_ns == stop.host_ns == 249_900_000_000


def test_captures_skip_sent_commands_and_keep_the_order(tmp_path):
    items = [
        LinkOpened(1, "/dev/ttyUSB0", 115200),
        RegistersKnown(2, {7: (40.0,)}),
        Received(3, b"x"),
    ]
    capture(tmp_path / "c.mcap", *items)
    recording = open_recording(tmp_path / "c.mcap")
    assert list(recording.inputs()) == [*items, Stop(3, "end of recording")]
    assert recording.header["device"] == "VN-100"
    assert next(recording.inputs()) == items[0]  # may be read again


def test_a_stop_that_was_recorded_is_not_doubled(tmp_path):
    capture(tmp_path / "c.mcap", Received(3, b"x"), Stop(4, "SIGTERM"))
    assert list(open_recording(tmp_path / "c.mcap").inputs()) == [
        Received(3, b"x"),
        Stop(4, "SIGTERM"),
    ]


def test_truncated_capture_is_read_to_its_end_with_a_note(tmp_path):
    capture(tmp_path / "c.mcap", Received(3, b"x" * 100))
    data = (tmp_path / "c.mcap").read_bytes()
    (tmp_path / "c.mcap").write_bytes(data[:-40])
    recording = open_recording(tmp_path / "c.mcap")
    assert [item.host_ns for item in recording.inputs()] == [3, 3]
    assert "was not closed" in recording.notes[0]


def test_a_capture_of_a_silent_device_is_refused(tmp_path):
    capture(tmp_path / "c.mcap", LinkOpened(1, "/dev/ttyUSB0", 115200))
    with pytest.raises(RecordingError, match="holds nothing that a device sent"):
        list(open_recording(tmp_path / "c.mcap").inputs())


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"noise\r\n$VNYMR,+010.071*64\r\n" * 9, RecordingKind.BYTES),
        (b"\xfa\x14\x3e\x00" * 9, RecordingKind.BYTES),
        (TABLE.encode(), RecordingKind.TABLE),
    ],
)
def test_unknown_file_name_is_recognised_by_content(tmp_path, content, kind):
    (tmp_path / "a.logger_mixed_stream.gz").write_bytes(gzip.compress(content, mtime=0))
    assert open_recording(tmp_path / "a.logger_mixed_stream.gz").kind is kind


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("a.txt", TABLE.encode(), RecordingKind.TABLE),
        ("a.log.gz", gzip.compress(TABLE.encode("utf-16"), mtime=0), RecordingKind.TABLE),
        ("a.csv", SENTENCES, RecordingKind.BYTES),
        ("a.csv", b"PAR1", None),
    ],
)
def test_wrong_file_name_does_not_hide_the_content(tmp_path, name, content, kind):
    (tmp_path / name).write_bytes(content)
    if kind is None:
        with pytest.raises(RecordingError, match="is no Parquet table"):
            open_recording(tmp_path / name)
        return
    assert open_recording(tmp_path / name).kind is kind


def test_an_unused_rate_is_noted(tmp_path):
    (tmp_path / "t.csv").write_text(TABLE)
    assert "--rate is not used" in open_recording(tmp_path / "t.csv", 40.0).notes[0]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.vnraw", b"", "is empty"),
        ("a.vnraw.gz", gzip.compress(SENTENCES, mtime=0)[:20], "truncated"),
        ("a.mcap", SENTENCES, "is not a capture of ahrsd"),
        ("a.doc", b"hello", "by its name nor by its content"),
        ("a.csv", b"a,b\n1,2\n", "has no column"),
        (
            "a.mcap.gz",
            gzip.compress(b"\x89MCAP0\r\n", mtime=0),
            "is packed with gzip; unpack it: gunzip",
        ),
        ("a.txt", b"PK\x03\x04", "is a zip archive"),
    ],
)
def test_file_that_is_no_recording_is_refused_in_one_line(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=words) as caught:
        open_recording(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_paths_that_are_no_file(tmp_path):
    with pytest.raises(RecordingError, match="is a folder"):
        open_recording(tmp_path)
    with pytest.raises(RecordingError, match="does not exist"):
        open_recording(tmp_path / "no.vnraw")
    with pytest.raises(RecordingError, match="not positive"):
        open_recording(tmp_path / "no.vnraw", 0.0)


def test_the_real_mixed_stream_opens_as_bytes(recordings):
    recording = open_recording(recordings / "vn100" / "F00379.logger_mixed_stream.gz")
    assert recording.kind is RecordingKind.BYTES
    assert sum(len(item.data) for item in recording.inputs() if isinstance(item, Received)) > 10**6
