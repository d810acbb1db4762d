"""Byte streams as written by terminal programs, shells and drivers, each with its correct value."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from ros_files import BIAS, HARD, sensor

from ahrsd.config.config import Config
from ahrsd.errors import RecordingError
from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.replay import replay
from ahrsd.recording.bytestream import read_received, stamped
from drivers.vn100.messages import crc16, encode_sentence

COUNT, RATE_HZ = 6000, 100.0
SLOW = pytest.mark.slow
DATA = sensor(COUNT, RATE_HZ)


def lines(data: dict[str, np.ndarray] = DATA, end: str = "\r\n") -> list[str]:
    """VNIMU of the sensor, which carries no time."""
    rows = np.hstack([data["mag"], data["accel"], data["gyro"]]).tolist()
    return [
        encode_sentence("VNIMU", [*row, 25.0, 101.3]).decode().removesuffix("\r\n") + end
        for row in rows
    ]


LINES = lines()


def is_right(path, count=COUNT, rate_hz=RATE_HZ, rate=None):
    """The sensor's iron and bias, at its rate."""
    result = calibrate(path, Config(), rate_hz=rate)
    assert result.core.stream.facts.samples == count
    assert result.core.stream.facts.rate_hz == pytest.approx(rate_hz, rel=0.02)
    assert result.converged, result.reasons()
    np.testing.assert_allclose(result.estimate.hard_iron_gauss, HARD, atol=1e-3)
    np.testing.assert_allclose(result.estimate.gyro_bias_rad_s, BIAS, atol=6e-4)
    return result.all_warnings()


STAMPS = {
    "epoch": lambda t: f"{1.7e9 + t:.6f} ",
    "iso": lambda t: f"[2024-05-05 12:{t // 60:02.0f}:{t % 60:06.3f}] ",
    "counts": lambda t: f"{round(5000 + 1e3 * t)}: ",
    "seconds": lambda t: f"12:{t // 60:02.0f}:{t // 1 % 60:02.0f} ",
    "syslog": lambda t: f"May  5 23:59:{t // 1 % 60:02.0f} boat vn: ",
    "csv": lambda t: f'{1.7e12 + 1e3 * t:.0f},"',
}

TOLD = ("epoch", "counts", "csv")


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=() if kind in TOLD else pytest.mark.slow) for kind in STAMPS],
)
def test_time_at_the_start_of_a_line_is_its_arrival_time(tmp_path, kind):
    """Messages without a time of their own have the rate at which they came, not a factory's."""
    path = tmp_path / ("a.csv" if kind == "csv" else "a.txt")
    end = '"' if kind == "csv" else ""
    told = zip(DATA["time_s"].tolist(), lines(end=""), strict=True)
    path.write_text("".join(f"{STAMPS[kind](t)}{line}{end}\r\n" for t, line in told))
    warnings = is_right(path)
    assert any("begins with a time of the host" in text for text in warnings)


@pytest.mark.parametrize(
    "start",
    [
        b"".join(b"%d $VNIMU,1*00\r\n" % k for k in range(100)),  # a count of lines
        b"".join(b"%d.5 $VNIMU,1*00\r\n" % (-(k % 2)) for k in range(100)),
        b"$VNIMU,1*00\r\n" * 100,
        b"x 1.5 $VNIMU,1*00\r\n" * 100,
    ],
)
def test_other_numbers_are_no_times(start):
    assert stamped(start) is None


def test_stamps_come_back_in_nanoseconds(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{10 + k / 8:.3f} {line}" for k, line in enumerate(LINES[:80])))
    items = list(read_received(path))
    assert [item.host_ns for item in items] == [10_000_000_000 + k * 125_000_000 for k in range(80)]
    assert b"".join(item.data for item in items) == "".join(LINES[:80]).encode()


CHANGED = {
    "no line ends": "".join(lines(end="")) + "\r\n",
    "small letters": "".join(line[:-4] + line[-4:].lower() for line in LINES),
    "quotes": "".join(f'"{line}"\n' for line in lines(end="")),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "name"),
    [
        pytest.param(CHANGED[how], name, id=f"{how}-{name}", marks=() if k == j else SLOW)
        for k, how in enumerate(CHANGED)
        for j, name in enumerate(("a.txt", "a.log", "a.csv"))
    ],
)
def test_lines_that_a_program_changed_are_read(tmp_path, content, name):
    path = tmp_path / name
    path.write_text(content, newline="")
    result = replay(path, Config(), rate_hz=RATE_HZ)
    assert result.core.stream.facts.samples >= COUNT - 1
    assert result.core.stream.facts.damaged <= 1


# -- packets ---------------------------------------------------------------------------------------


def packet(groups: int, words: tuple[int, ...], payload: bytes) -> bytes:
    checked = struct.pack(f"<B{len(words)}H", groups, *words) + payload
    return b"\xfa" + checked + struct.pack(">H", crc16(checked))


def vector(row: np.ndarray) -> bytes:
    return struct.pack("<3f", *row)


def time_of(k: int) -> bytes:
    return struct.pack("<Q", 5_000_000_000 + round(k / RATE_HZ * 1e9))


def field(k: int) -> bytes:
    return packet(0x05, (0x0001, 0x0002), time_of(k) + vector(DATA["mag"][k]))


def rates(k: int) -> bytes:
    inertial = vector(DATA["accel"][k]) + vector(DATA["gyro"][k])
    return packet(0x05, (0x0001, 0x000C), time_of(k) + inertial)


def whole(k: int) -> bytes:
    values = (DATA[name][k] for name in ("mag", "accel", "gyro"))
    return packet(0x05, (0x0001, 0x000E), time_of(k) + b"".join(map(vector, values)))


def test_a_text_mode_is_undone(tmp_path):
    """Each LF became CR LF, also within packets: then every sixth of them is damaged."""
    path = tmp_path / "a.vnbin"
    path.write_bytes(b"".join(map(whole, range(COUNT))).replace(b"\n", b"\r\n"))
    warnings = is_right(path)
    assert any("a text mode turned each LF of the packets into CR LF" in text for text in warnings)


def test_correct_stream_with_cr_lf_is_unchanged(tmp_path):
    path = tmp_path / "a.vnbin"
    path.write_bytes(b"".join(whole(k) + LINES[k].encode() for k in range(2000)))
    result = replay(path, Config())
    assert result.core.stream.facts.samples == 2000
    assert result.core.stream.facts.damaged == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("every", "first"),
    [
        (1, "rates"),
        (4, "field"),
        (1, "field"),
        (4, "rates"),
    ],
)
def test_field_and_rates_of_two_outputs_are_put_together(tmp_path, first, every):
    """By the device's time, whichever of the two comes first."""
    parts = []
    for k in range(COUNT):
        pair = [field(k) if k % every == 0 else b"", rates(k)]
        parts += pair if first == "field" else pair[::-1]
    path = tmp_path / "a.vnbin"
    path.write_bytes(b"".join(parts))
    warnings = is_right(path, count=pytest.approx(COUNT, abs=6))
    assert any("matched by their time" in text for text in warnings)
    assert abs(calibrate(path, Config()).estimate.mag_lag_s) < 0.5 / RATE_HZ


def test_one_output_with_all_is_taken_before_two(tmp_path):
    path = tmp_path / "a.vnbin"
    path.write_bytes(b"".join(field(k) + rates(k) + whole(k) for k in range(2000)))
    facts = replay(path, Config()).core.stream.facts
    assert facts.layout == "FA 05 0001 000E"
    assert facts.samples >= 1990


def test_parts_without_a_time_are_reported(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(
        "".join(
            encode_sentence("VNMAG", DATA["mag"][k].tolist()).decode()
            + encode_sentence("VNGYR", DATA["gyro"][k].tolist()).decode()
            for k in range(200)
        )
    )
    with pytest.raises(RecordingError, match=r"in different messages \(VNMAG and VNGYR\)"):
        calibrate(path, Config(), rate_hz=40.0)


def test_a_device_that_restarted_has_no_wrong_times(tmp_path):
    def again(k: int) -> bytes:
        values = (DATA[name][k] for name in ("mag", "accel", "gyro"))
        since = time_of(k if k < 3000 else k - 3000)
        return packet(0x05, (0x0001, 0x000E), since + b"".join(map(vector, values)))

    path = tmp_path / "a.vnbin"
    path.write_bytes(b"".join(map(again, range(COUNT))))
    assert not [text for text in is_right(path) if "time does not increase" in text]
