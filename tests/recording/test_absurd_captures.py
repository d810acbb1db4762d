"""Captures that somebody else wrote: one line and exit 2, or read as far as they go."""

from __future__ import annotations

import json
import struct
from functools import reduce
from io import BytesIO
from operator import xor

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import Chunk, Header

from ahrsd.__main__ import main
from ahrsd.recording import blocks
from ahrsd.recording.blocks import Entry

BODY = b"VNYMR,+010.071,+000.278,-002.026,+00.2067,-00.0568,+00.4169,-00.019,+00.320,-09.802,"
BODY += b"+00.002801,-00.001186,-00.001582"
LINE = b"$" + BODY + b"*%02X\r\n" % reduce(xor, BODY)


def stream() -> list[Entry]:
    return [Entry("rx", k, (k + 1) * 25_000_000, LINE) for k in range(200)]


def inputs(*bodies: object, text: str | None = None) -> list[Entry]:
    data = [json.dumps(body).encode() for body in bodies] if text is None else [text.encode()]
    return [Entry("input", k, k, content) for k, content in enumerate(data)]


def run(path, capsys, *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as end:
        main([*(arguments or ("replay",)), str(path)])
    shown = capsys.readouterr()
    return int(end.value.code or 0), shown.out + shown.err


def of(type_name: str, /, **fields: object) -> dict[str, object]:
    return {"type": type_name, "host_ns": 5, **fields}


def block(**fields: object) -> dict[str, object]:
    row, vector = [0.0, 0.1, 0.2], [[0.2, 0.1, 0.4]] * 3
    return {
        "time_s": row, "dt_s": [float("nan"), 0.1, 0.1], "host_s": row, "raw_b_gauss": vector,
        "gyro_b_rad_s": vector, "accel_b_m_s2": vector, "covariates": {}, "epoch": 0,
        "gap_before": True, **fields,
    }  # fmt: skip


WRONG_TYPES = [
    of("Tick") | {"host_ns": "5"},
    of("Tick") | {"host_ns": 1e300},
    of("Tick") | {"host_ns": -1},
    of("Tick") | {"host_ns": 2**70},
    of("Tick") | {"host_ns": None},
    of("Tick") | {"host_ns": True},
    of("WallClock", wall_s="noon"),
    of("WallClock", wall_s=float("nan")),
    of("LinkOpened", port=5, baud=115200),
    of("LinkOpened", port="/dev/ttyUSB0", baud="fast"),
    of("LinkLost", reason=["unplugged"]),
    of("Interlock", safe="yes"),
    of("Columns", values={"motor_current_a": "5"}),
    of("Columns", values=[1, 2]),
    of("TermsKnown", text=7),
    of("Operator", verb=1),
    of("Operator", verb="approve", argument={}),
    of("RegistersKnown", values={"23": "abc"}),
    of("RegistersKnown", values={"23": [[1]]}),
    of("RegistersKnown", values={"-1": [1.0]}),
    of("RegistersKnown", values={"9999999": [1.0]}),
    of("RegistersKnown", values={"23": [1.0] * 100_000}),
    of("JournalOpened", serial=1, records=["PREPARED"]),
    of("JournalOpened", serial="x", records=[]),
    of("Journalled", kind=None),
    of("Examined", pieces=-0.5),
    of("Examined", pieces=10**30),
    of("Stop", reason=3),
    of("Samples", block=[1, 2, 3]),
    of("Samples", block=block(time_s=[0.0, 0.1])),
    of("Samples", block=block(time_s=[0.2, 0.1, 0.0])),
    of("Samples", block=block(raw_b_gauss=[[1.0, 2.0]] * 3)),
    of("Samples", block=block(raw_b_gauss=[["a", "b", "c"]] * 3)),
    of("Samples", block=block(raw_b_gauss=[[1e400, 0.0, 0.0]] * 3)),
    of("Samples", block=block(dt_s=[0.1, 0.0, -1.0])),
    of("Samples", block=block(epoch="one")),
    of("Samples", block=block(covariates={"x": [1.0]})),
    of("Samples", block=block(gap_before=1)),
    of("Samples", block=block(more=1)),
    of("RegistersKnown", values={"23": [1.0]}),
    of("RegistersKnown", values={"23": ["x"] * 12}),
    of("RegistersKnown", values={"23": [0.0] * 12, "84": [0.0] * 12, "26": [0.0] * 9}),
    of("RegistersKnown", values={"44": [], "47": [1.0] * 3, "82": ["?"], "5": ["fast"], "7": [-4]}),
    of("JournalOpened", serial=1, records=[{"kind": 5, "registers": "no"}, {}]),
    of("JournalOpened", serial=1, records=[{"kind": "PREPARED", "old": 3, "new": [], "at": "?"}]),
    of("Journalled", kind="NONSENSE"),
    of("Samples"),
    of("Unknown"),
    of("Tick", more=1),
    {"type": ["Tick"], "host_ns": 5},
    {"host_ns": 5},
    [1, 2],
    "Tick",
    None,
]


@pytest.mark.parametrize("body", WRONG_TYPES, ids=lambda body: json.dumps(body)[:60])
def test_an_input_of_a_wrong_type_ends_in_one_line(tmp_path, capsys, body):
    path = tmp_path / "a.mcap"
    path.write_bytes(blocks.head({}) + blocks.chunk(inputs(body)) + blocks.end({}))
    code, shown = run(path, capsys)
    assert code == 2
    assert len(shown.splitlines()) == 1
    assert "a.mcap: " in shown
    assert shown.rstrip("\n").isprintable()


@pytest.mark.parametrize(
    "text", ["{", "[" * 100_000, '{"type":"Tick","host_ns":' + "9" * 9999 + "}"]
)
def test_an_input_that_is_no_json_ends_in_one_line(tmp_path, capsys, text):
    path = tmp_path / "a.mcap"
    path.write_bytes(blocks.head({}) + blocks.chunk(inputs(text=text)) + blocks.end({}))
    code, shown = run(path, capsys)
    assert (code, len(shown.splitlines())) == (2, 1)


ODD_BUT_SOUND = [
    of("RegistersKnown", values={"82": ["?"], "5": ["fast"], "7": [-4]}),
    of("JournalOpened", serial=1, records=[{"kind": "X", "facts": {"old": 3, "new": [], "at": 0}}]),
    of("Journalled", kind="PREPARED"),
    of("RegistersKnown", values={"23": [1e308] * 12, "7": [1e308]}),
    of("Examined", pieces=10**9),
    of("Examined", pieces=-3),
    of("Operator", verb="approve", argument="x" * 100_000),
    of("Operator", verb="\x1b[2J", argument="\x07"),
    of("TermsKnown", text="{"),
    of("TermsKnown", text="[]"),
    of("Columns", values={"a" * 100_000: 1.0, "b": float("nan")}),
    of("LinkOpened", port="\x1b]0;x\x07", baud=-1, latency_ms=-5),
    of("WallClock", wall_s=1e300),
    of("Samples", block=block()),
    of("Samples", block=block(epoch=-7)),
]


@pytest.mark.parametrize("body", ODD_BUT_SOUND, ids=lambda body: json.dumps(body)[:60])
def test_odd_values_are_no_internal_error(tmp_path, capsys, body):
    path = tmp_path / "a.mcap"
    path.write_bytes(
        blocks.head({}) + blocks.chunk(inputs(body)) + blocks.chunk(stream()) + blocks.end({})
    )
    code, shown = run(path, capsys)
    assert code in (0, 2)
    assert "Traceback" not in shown
    assert all(line.isprintable() for line in shown.splitlines())


def rewritten(**changes: object) -> bytes:
    """A capture whose one block is changed."""
    data = blocks.chunk(stream())[9:]  # without opcode and length
    whole = Chunk.read(ReadDataStream(BytesIO(data)))
    for name, value in changes.items():
        setattr(whole, name, value)
    builder = RecordBuilder()
    whole.write(builder)
    return blocks.head({}) + bytes(builder.end()) + blocks.chunk(stream()) + blocks.end({})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"uncompressed_size": 16 * 2**30}, "unpacks to 17179869184 bytes, over the limit"),
        ({"uncompressed_size": 2**63}, "unpacks to 9223372036854775808 bytes, over the limit"),
        ({"uncompressed_size": 2**64 - 1}, "over the limit, was left out"),
        ({"uncompressed_size": 0}, "a damaged block"),
        ({"uncompressed_size": 5}, "a damaged block"),
        ({"compression": "lz4"}, "a damaged block"),
        ({"compression": "lz4", "data": lz4.frame.compress(b"x" * 99)[:-9]}, "a damaged block"),
        ({"compression": "lz4", "data": lz4.frame.compress(bytes(2**27))}, "a damaged block"),
        ({"compression": "zstd", "data": zstandard.compress(bytes(2**27))}, "over the limit"),
        ({"compression": "zstd", "data": b"\x28\xb5\x2f\xfd" + b"\xff" * 40}, "a damaged block"),
        ({"compression": "zstd", "data": b""}, "a damaged block"),
        ({"compression": "snappy"}, "a damaged block"),
        ({"compression": ""}, "a damaged block"),
        ({"uncompressed_crc": 1}, "a damaged block"),
    ],
)
def test_inconsistent_block_is_skipped_and_reported(tmp_path, capsys, changes, words):
    path = tmp_path / "a.mcap"
    path.write_bytes(rewritten(**changes))
    code, shown = run(path, capsys)
    assert code == 0
    assert words in shown
    assert ": 200 samples in" in shown


def test_a_capture_that_another_tool_packed_with_lz4_is_read(tmp_path, capsys):
    content = zstandard.decompress(_data(blocks.chunk(stream())), 2**20)
    path = tmp_path / "a.mcap"
    packed = {"compression": "lz4", "data": lz4.frame.compress(content)}
    path.write_bytes(rewritten(**packed, uncompressed_size=len(content)))
    code, shown = run(path, capsys)
    assert (code, "a damaged block" in shown) == (0, False)


def _data(record: bytes) -> bytes:
    at = record.index(b"zstd") + 4
    (length,) = struct.unpack_from("<Q", record, at)
    return record[at + 8 : at + 8 + length]


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ("ros2", "is damaged, cut off or was never closed"),
        ("ros1", "is a ROS 1 recording (MCAP); write"),
        ("x-\x1b[31mred", "is an MCAP file of another program (profile x-\\x1b[31mred)"),
        ("", "is not a capture of ahrsd"),
    ],
)
def test_mcap_files_of_other_programs_are_named(tmp_path, capsys, profile, words):
    builder = RecordBuilder()
    Header(profile=profile, library="other").write(builder)
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + bytes(builder.end()) + b"\x04" + bytes(60))
    code, shown = run(path, capsys)
    assert (code, len(shown.splitlines())) == (2, 1)
    assert words in shown


def test_lengths_beyond_the_file_are_its_end(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    whole = blocks.head({}) + blocks.chunk(stream())
    path.write_bytes(whole + struct.pack("<BQ", 6, 2**63) + bytes(100))
    code, shown = run(path, capsys)
    assert code == 0
    assert "its last 100 bytes are half a block" in shown
