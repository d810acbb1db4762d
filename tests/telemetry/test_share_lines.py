"""Lines of `ahrsd status` about shares and transmission errors."""

from __future__ import annotations

import pytest

from ahrsd.telemetry.words import errors_line, share_lines

NOTHING = dict.fromkeys(
    ("commands", "answered", "refused", "absorbed", "dropped", "unanswered", "lost_bytes",
     "turned_away", "ignored_bytes"), 0,
) | {"fault": ""}  # fmt: skip


@pytest.mark.parametrize(
    ("share", "line"),
    [
        ({"port": "/run/vn100", "open": False, "send": ""}, "/run/vn100 not open, 0 commands"),
        (
            {"port": "/p", "open": True, "send": "", "commands": 7, "refused": 2, "lost_bytes": 90},
            "/p in use, 7 commands, 2 refused, 90 bytes lost by a reader that is too slow",
        ),
        (
            {"port": "tcp 127.0.0.1:2101", "open": True, "send": "raw", "readers": 1},
            "tcp 127.0.0.1:2101 raw, 1 reader",
        ),
        (
            {"port": "tcp [::1]:1", "open": True, "send": "corrected", "readers": 16,
             "turned_away": 3, "ignored_bytes": 40},
            "tcp [::1]:1 corrected, 16 readers, 3 turned away, 40 bytes of readers thrown away",
        ),
        (
            {"port": "udp 10.0.0.255:10110", "open": True, "send": "nmea", "readers": None,
             "lost_bytes": 80, "fault": "Network is unreachable"},
            "udp 10.0.0.255:10110 nmea, sent, 80 bytes lost by a reader that is too slow, "
            "Network is unreachable",
        ),
        # of a daemon from before there were network shares
        ({"port": "/p", "open": True}, "/p in use, 0 commands"),
    ],
)  # fmt: skip
def test_share_is_one_line(share, line):
    assert share_lines({"shares": [{**NOTHING, **share}]}) == [f"share: {line}"]


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        ({}, "errors: "),
        ({"gaps": 1}, "errors: 1 gap"),
        ({"gaps": 2, "restarts": 1}, "errors: 2 gaps, 1 device restart"),
        ({"skipped_bytes": 1, "rejected": 3}, "errors: 3 rejected, 1 byte skipped"),
        ({"faults": 1}, "errors: 1 VNERR"),
    ],
)
def test_transmission_errors_are_counted_in_words(counts, line):
    none = dict.fromkeys(("rejected", "skipped_bytes", "gaps", "restarts", "faults"), 0)
    assert errors_line({"stream": none | counts}) == line
