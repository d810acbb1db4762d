"""Every wire example, three ways: whole, byte by byte, cut at random; with noise around it.

The examples are those of fixtures/vn100: manual_examples.toml, and wire_examples.json, which
names its sources. Both have the device's bytes, so a mistake shared by encoder and decoder is
caught.
"""

from __future__ import annotations

import gzip
import json
import math
import random
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.vn100.decode import ErrorReply, Measurement, Undecodable, Unused, decode
from drivers.vn100.deframer import Cause, Deframer, Packet, Sentence
from drivers.vn100.messages import Reply

PROJECT = Path(__file__).parents[3]
OWN = PROJECT / "fixtures" / "vn100" / "manual_examples.toml"
WIRE = PROJECT / "fixtures" / "vn100" / "wire_examples.json"

Case = dict[str, Any]


def load() -> list[Any]:
    with OWN.open("rb") as file:
        cases = [
            pytest.param(case, id=f"own-{case['name']}") for case in tomllib.load(file)["case"]
        ]
    wire = json.loads(WIRE.read_text())
    return cases + [pytest.param(case, id=case["name"]) for case in wire]


every_case = pytest.mark.parametrize("case", load())

# Refused by decoding, although the checksum is right.
BAD_CONTENT = {"ascii_non_numeric", "ascii_double_sign", "ascii_too_few_fields"}
DAMAGE = {
    "bad_xor_checksum": {Cause.CHECKSUM: 1},
    "bad_crc16_ascii": {Cause.CHECKSUM: 1},
    "bad_checksum_in_the_wild_1": {Cause.CHECKSUM: 1},
    "bad_checksum_in_the_wild_2": {Cause.CHECKSUM: 1},
    "bad_checksum_in_the_wild_3": {Cause.CHECKSUM: 1},
    "wrong_ardupilot_comment": {Cause.CHECKSUM: 1},
    "ascii_missing_field_char": {Cause.CHECKSUM: 1},
    "ascii_truncated_no_eol": {Cause.CUT: 1},
    "ascii_merged_lines": {Cause.BROKEN: 1},
    "ascii_no_checksum": {Cause.CHECKSUM: 1},
    "bin_bad_crc": {Cause.CRC: 1},
    "bin_manual_misprint": {Cause.CRC: 1},  # its header announces 22 of its 24 bytes
    "bin_truncated": {Cause.CUT: 1},
    "bit6_flip_header_real": {Cause.CRC: 1},
    "bit6_flip_wrong_fieldword_real": {},  # a position: no VN-100 sends it
    "bit6_flip_ascii_real": {},  # its V is damaged
    "bin_reserved_bit": {},
    "bin_group_zero": {},
    "bin_truncated_then_good": {Cause.CRC: 1},
    "bin_start_mid_packet_false_sync": {},
    "bin_start_on_crc_sync": {},
    "mixed_stream_real": {},
    "sync_noise": {},
    "response_between_frames": {},
    "binary_cuts_ascii": {Cause.BROKEN: 1},
}
BEFORE = b"\x00\xfb noise $GPVTG,,T,,M*00\r\n\xfa\xfa\x00 $V \xfa\x08\x01\x00"
BEHIND = b"\x00\x80*60\r\n\xfa\x00,noise"


def pieces(data: bytes, how: str) -> Iterator[bytes]:
    if how == "whole":
        yield data
    elif how == "bytes":
        yield from (data[at : at + 1] for at in range(len(data)))
    else:
        rng = random.Random(how)
        at = 0
        while at < len(data):
            size = rng.choice((1, 2, 3, 7, 20, 64, 200))
            yield data[at : at + size]
            at += size


def receive(deframer: Deframer, data: bytes, how: str) -> list[Sentence | Packet]:
    """All messages of `data`, then silence; counters and skipped bytes add up throughout."""
    frames = []
    skipped = bytearray()
    counters = deframer.counters
    for piece in pieces(data, how):
        frames += deframer.feed(piece)
        skipped += b"".join(part.data for part in deframer.take_skipped())
        valid = sum(frame.length for frame in frames)
        assert counters.valid_bytes == valid
        assert counters.skipped_bytes == len(skipped)
        assert counters.fed_bytes == valid + len(skipped) + deframer.pending
    deframer.drop_pending()
    frames += deframer.feed(b"")
    assert deframer.pending == 0
    assert counters.fed_bytes == counters.valid_bytes + counters.skipped_bytes == len(data)
    assert counters.valid == len(frames)
    return frames


def deframer_for(case: Case) -> Deframer:
    host = case["direction"] == "host"
    return Deframer(host_side=host)


def expected(case: Case) -> tuple[list[str], list[bytes]]:
    """Bodies of the sentences and bytes of the packets that must come out."""
    data = bytes.fromhex(case["hex"])
    if case["category"] == "valid" or case["name"] in BAD_CONTENT:
        ascii_case = case["kind"] == "ascii"
        return ([_body(data.decode())], []) if ascii_case else ([], [data])
    messages = [_body(line) for line in case.get("expect_messages") or []]
    return messages, [bytes.fromhex(text) for text in case.get("expect_packets") or []]


def _body(line: str) -> str:
    return line[1 : line.index("*")]


@every_case
@pytest.mark.parametrize("noise", [False, True], ids=["alone", "in noise"])
def test_exactly_the_expected_messages_come_out(case: Case, noise: bool) -> None:
    data = bytes.fromhex(case["hex"])
    if noise:
        data = BEFORE + data + BEHIND
    for how in ("whole", "bytes", "1", "2", "3"):
        frames = receive(deframer_for(case), data, how)
        bodies = [frame.body for frame in frames if isinstance(frame, Sentence)]
        packets = [frame.data for frame in frames if isinstance(frame, Packet)]
        assert (bodies, packets) == expected(case), how
        for frame in frames:
            wire = data[frame.offset : frame.offset + frame.length]
            same = wire == frame.data if isinstance(frame, Packet) else frame.body.encode() in wire
            assert same, how


@every_case
def test_damage_is_counted_by_cause(case: Case) -> None:
    for how in ("whole", "bytes"):
        deframer = deframer_for(case)
        receive(deframer, bytes.fromhex(case["hex"]), how)
        assert deframer.counters.damage == DAMAGE.get(case["name"], {}), how
        cut = deframer.counters.damage.get(Cause.CUT, 0)
        assert deframer.counters.rejected == sum(deframer.counters.damage.values()) - cut, how


@every_case
def test_values_are_those_of_the_example(case: Case) -> None:
    frames = receive(deframer_for(case), bytes.fromhex(case["hex"]), "whole")
    decoded = [decode(frame) for frame in frames]
    fields = case.get("fields") or {}
    if case["name"] in BAD_CONTENT:
        assert [type(result) for result in decoded] == [Undecodable]
    elif case["name"] == "syn_ext_field_word":
        assert decoded == [Unused("FA 08 8001 0002", 0)]
    elif case["category"] != "valid":
        assert all(isinstance(result, Measurement | Reply) for result in decoded)
    elif case["kind"] == "binary":
        check_packet(frames[0], decoded[0], fields)
    elif "message" in fields:
        check_sentence(decoded[0], fields)
    elif fields["command"] == "ERR":
        assert decoded == [ErrorReply(fields["error_code"])]
    else:
        check_reply(decoded[0], fields, case["ascii"])


SENTENCE_COLUMNS = {
    "temp_c": "temperature_c",
    "dt_s": "delta_time_s",
    **{f"{angle}_deg": f"{angle}_rad" for angle in ("yaw", "pitch", "roll")},
    **{f"dtheta_{axis}_deg": f"delta_theta_{axis}_rad" for axis in "xyz"},
    **{f"dvel_{axis}_mps": f"delta_velocity_{axis}_m_s" for axis in "xyz"},
}


def check_sentence(decoded: object, fields: Case) -> None:
    assert isinstance(decoded, Measurement)
    assert decoded.layout.name == fields["message"]
    want = {}
    for name, value in fields.items():
        if name in ("message", "checksum"):
            continue
        column = SENTENCE_COLUMNS.get(name, name).replace("mps2", "m_s2").replace("radps", "rad_s")
        want[column] = math.radians(value) if name.endswith("_deg") else value
    got = dict(zip((c.name for c in decoded.layout.columns), decoded.values, strict=True))
    assert got == pytest.approx(want, rel=1e-15)


def check_reply(decoded: object, fields: Case, text: str) -> None:
    word, *tokens = text[1 : text.index("*")].split(",")
    assert word == "VN" + fields["command"]
    if "register" in fields:
        assert decoded == Reply(word, fields["register"], tuple(tokens[1:]))
    else:
        assert decoded == Reply(word, None, tuple(tokens))


def vector(stem: str, unit: str) -> list[str]:
    return [f"{stem}_{axis}_{unit}" for axis in "xyz"]


PACKET_COLUMNS = {
    "TimeStartup": ["time_startup_s"],
    "SyncInCnt": ["sync_in_count"],
    "Ypr": ["yaw_rad", "pitch_rad", "roll_rad"],
    "YprU": ["yaw_sigma_rad", "pitch_sigma_rad", "roll_sigma_rad"],
    "Quaternion": ["quat_x", "quat_y", "quat_z", "quat_w"],
    "AngularRate": vector("gyro", "rad_s"),
    "Accel": vector("accel", "m_s2"),
    "Mag": vector("mag", "gauss"),
    "UncompAccel": vector("uncomp_accel", "m_s2"),
    "UncompGyro": vector("uncomp_gyro", "rad_s"),
    "UncompMag": vector("uncomp_mag", "gauss"),
    "Temp": ["temperature_c"],
    "Pres": ["pressure_kpa"],
    "ImuStatus": ["imu_status"],
    "SensSat": ["sens_sat"],
    "VpeStatus": ["vpe_status"],
    "MagNed": ["mag_n_n_gauss", "mag_n_e_gauss", "mag_n_d_gauss"],
    "DeltaTime": ["delta_time_s"],
    "DeltaTheta": vector("delta_theta", "rad"),
    "DeltaVel": vector("delta_velocity", "m_s"),
}
DEGREES = {"Ypr", "YprU", "DeltaTheta"}


def check_packet(frame: Sentence | Packet, decoded: object, fields: Case) -> None:
    assert isinstance(frame, Packet)
    assert isinstance(decoded, Measurement)
    name = " ".join(["FA", fields["groups"], *fields["field_words"]])
    assert decoded.layout is frame.layout
    assert (frame.layout.name, frame.layout.size) == (name, fields["packet_len"])
    wire = frame.layout.unpack(frame.data)
    seen = set()
    for key, value in fields.items():
        if "." not in key:
            continue
        field = key.split(".")[1]
        value = [int(value)] if field == "TimeStartup" else value
        numbers = value if isinstance(value, list) else [value]
        for column, number in zip(PACKET_COLUMNS[field], numbers, strict=True):
            place = frame.layout.index(column)
            assert place is not None
            seen.add(place)
            assert wire[place] == number  # exact: f32 and whole nanoseconds
            si = math.radians(number) if field in DEGREES else number
            si = si / 1e9 if field == "TimeStartup" else si
            assert decoded.values[place] == pytest.approx(si, rel=1e-15)
    assert seen == set(range(len(frame.layout.columns)))


@pytest.mark.parametrize(
    ("name", "messages", "valid", "rejected"),
    [
        ("walk_square_2024_sazgar.vnraw", "VNYMR", 5466, 8),
        ("walk_circle_2024_sazgar.vnraw", "VNYMR", 3875, 5),
        ("hand_2023_thumatti.vnraw", "VNYMR", 12114, 0),
        ("drive_2022_rahul.vnraw", "VNYMR", 17282, 0),
        ("wrongtype_VNYIA_2023_gopi.vnraw", "VNYIA", 5294, 0),
        ("F00379.vnbin", "FA 14 003E 003A", 8895, 0),
        ("F00379.logger_mixed_stream", "FA 14 003E 003A", 8895, 2),
    ],
)
def test_recordings(recordings: Path, name: str, messages: str, valid: int, rejected: int) -> None:
    data = gzip.decompress((recordings / "vn100" / f"{name}.gz").read_bytes())
    for how in ("whole", "4"):
        deframer = Deframer()
        frames = receive_quickly(deframer, data, how)
        assert (deframer.counters.valid, deframer.counters.rejected) == (valid, rejected)
        decoded = [decode(frame) for frame in frames]
        names = {result.layout.name for result in decoded if isinstance(result, Measurement)}
        assert (len(decoded), names) == (valid, {messages})
        assert all(isinstance(result, Measurement) for result in decoded)


def receive_quickly(deframer: Deframer, data: bytes, how: str) -> list[Sentence | Packet]:
    frames = [frame for piece in pieces(data, how) for frame in deframer.feed(piece)]
    counters = deframer.counters
    assert counters.fed_bytes == counters.valid_bytes + counters.skipped_bytes + deframer.pending
    return frames


def test_the_rotation_matrix_is_body_to_ned_row_by_row(recordings: Path) -> None:
    """What the manual leaves open, settled by a real device: R_nb = Rz(yaw) Ry(pitch) Rx(roll)."""
    data = gzip.decompress((recordings / "vn100" / "F00379.vnbin.gz").read_bytes())
    packets = [frame for frame in Deframer().feed(data) if isinstance(frame, Packet)]
    values = np.array([decode(packet).values for packet in packets[::100]])
    names = [column.name for column in packets[0].layout.columns]
    ypr = values[:, names.index("yaw_rad") :][:, :3]
    R_nb = values[:, names.index("dcm_00") :][:, :9].reshape(-1, 3, 3)
    assert names[names.index("dcm_00") + 1] == "dcm_01"
    expected_nb = Rotation.from_euler("ZYX", ypr).as_matrix()
    assert np.abs(R_nb - expected_nb).max() < 1e-6
