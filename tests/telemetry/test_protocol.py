"""Lines of the socket: every request is answered, or refused with a reason."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ahrsd.telemetry.protocol import BadRequest, Outbox, SocketRequest, line_of, parse_request


def test_requests_are_parsed():
    assert parse_request(b'{"ask": "status"}') == SocketRequest("status")
    assert parse_request(b'{"ask":"watch","of":["samples"]}') == SocketRequest(
        "watch", frozenset({"samples"})
    )
    assert parse_request(b'{"ask":"watch"}').streams == {"status", "events"}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"", "not a JSON object"),
        (b"hello", "not a JSON object"),
        (b"[1]", "not a JSON object"),
        (b'{"ask": "stauts"}', "must be one of status, explain, watch"),
        (b'{"ask": "watch", "of": "status"}', "must be a list of"),
        (b'{"ask": "watch", "of": []}', "must be a list of"),
        (b'{"ask": "watch", "of": ["raw"]}', "'raw' is none of status, events, samples"),
        (b'{"ask": "watch", "of": [["x"]]}', "must be a list of"),
        (b"[" * 4000, "not a JSON object"),
        (b"\xff\xfe", "not a JSON object"),
    ],
)
def test_invalid_request_is_refused_with_a_reason(line, words):
    with pytest.raises(BadRequest, match=words):
        parse_request(line)


@given(st.binary(max_size=200))
def test_any_bytes_are_parsed_or_refused(line):
    try:
        assert parse_request(line).ask in ("status", "explain", "watch")
    except BadRequest as error:
        assert str(error)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_every_line_is_strict_json(value):
    line = line_of({"value": value, "array": np.array([1.0, np.nan])})
    assert line.count(b"\n") == 1
    assert json.loads(line, parse_constant=pytest.fail)["array"] == [1.0, None]


def test_full_outbox_drops_whole_records_and_reports_them():
    box = Outbox(limit_bytes=200)
    line = line_of({"record": "x", "fill": "y" * 60})
    for seq in range(1, 6):
        box.record(line, seq)
    assert box.dropped == 3
    assert box.head(10_000) == line * 2
    box.sent(len(line) * 2)
    box.record(b'{"seq":6}\n', 6)
    gap, last = (json.loads(one) for one in box.head(10_000).splitlines())
    assert gap == {"record": "gap", "seq": 6, "lost": 3, "first_seq": 3, "last_seq": 5}
    assert last == {"seq": 6}


@given(st.lists(st.tuples(st.integers(1, 90), st.integers(0, 150)), max_size=60))
def test_outbox_is_bounded_and_every_record_arrives_or_is_in_a_gap(steps):
    box, seen, limit = Outbox(limit_bytes=300), bytearray(), 300
    for seq, (size, read) in enumerate(steps, start=1):
        box.record(
            json.dumps({"record": "r", "seq": seq, "fill": "z" * size}).encode() + b"\n", seq
        )
        assert len(box) <= limit
        seen += box.head(read)
        box.sent(min(read, len(box)))
    seen += box.head(limit)
    arrived: set[int] = set()
    for line in bytes(seen).splitlines():
        record = json.loads(line)
        if record["record"] == "gap":
            span = range(record["first_seq"], record["last_seq"] + 1)
            assert record["lost"] == len(span)
            arrived |= set(span)
        else:
            arrived.add(record["seq"])
    missing = set(range(1, len(steps) + 1)) - arrived
    assert missing == set(sorted(range(1, len(steps) + 1))[len(arrived) :])  # only a tail waits
