"""NMEA 0183 sentences, whole lines; checksums as published or computed in the test."""

from __future__ import annotations

from functools import reduce
from operator import xor

import pytest

from ahrsd.sharing.nmea import Transducer, attitude_transducers, hdm, xdr


def checked(line: bytes) -> str:
    """What is between $ and *, of a line whose frame, length and checksum are right."""
    assert line.startswith(b"$") and line.endswith(b"\r\n") and len(line) <= 82
    body, _, check = line[1:-2].partition(b"*")
    assert check.decode() == f"{reduce(xor, body):02X}"
    return body.decode()


def test_heading_sentence_equals_the_published_example():
    assert hdm(93.8) == b"$HCHDM,093.8,M*2B\r\n"  # of gpsd's list of sentences


def test_unknown_heading_is_an_empty_field():
    assert hdm(None) == b"$HCHDM,,M*07\r\n"


@pytest.mark.parametrize(
    ("heading_deg", "printed"),
    [(0.0, "000.0"), (359.94, "359.9"), (359.96, "000.0"), (359.99, "000.0"), (360.0, "000.0"),
     (-0.01, "000.0"), (-90.0, "270.0"), (7.26, "007.3"), (725.0, "005.0")],
)  # fmt: skip
def test_heading_format_is_ddd_d_and_never_360(heading_deg, printed):
    assert checked(hdm(heading_deg)) == f"HCHDM,{printed},M"


def test_pitch_roll_and_temperature():
    line = xdr(attitude_transducers(1.44, -0.26, 24.6))
    assert line == b"$YXXDR,A,1.4,D,PITCH,A,-0.3,D,ROLL,C,24.6,C,TEMP*2D\r\n"
    assert checked(line) == "YXXDR,A,1.4,D,PITCH,A,-0.3,D,ROLL,C,24.6,C,TEMP"


def test_unknown_values_are_empty_and_missing_sensors_left_out():
    assert checked(xdr(attitude_transducers(None, None, None))) == "YXXDR,A,,D,PITCH,A,,D,ROLL"
    assert checked(xdr(attitude_transducers(-0.04, 179.96, -40.0))) == (
        "YXXDR,A,0.0,D,PITCH,A,180.0,D,ROLL,C,-40.0,C,TEMP"
    )


def test_longest_line_fits():
    assert len(xdr(attitude_transducers(-90.0, -180.0, -100.0))) <= 82


def test_transducer_sentence_equals_the_published_example():
    fields = [Transducer("C", 23.15, "C", "WTHI")]
    assert checked(xdr(fields)) == "YXXDR,C,23.1,C,WTHI"
