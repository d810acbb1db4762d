"""Which commands can be constructed, and how long an answer may take."""

from __future__ import annotations

import pytest

from drivers.vn100.commands import RESUME, Read, Word, Write, reply_time_s
from drivers.vn100.messages import Reply

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("word", "arguments"),
    [("VNFWU", ()), ("VNSBL", ()), ("VNBLD", ()), ("VNMCU", ()), ("VNDBS", ()), ("VNCMD", ()),
     ("VNBOM", (1,)), ("VNASY", (2,)), ("VNASY", ()), ("VNWNV", (1,)), ("VNRRG", (23,))],
)  # fmt: skip
def test_dangerous_words_cannot_be_constructed(word, arguments):
    with pytest.raises(ValueError, match="never sent"):
        Word(word, arguments)


def test_impossible_reads_and_writes_cannot_be_constructed():
    with pytest.raises(ValueError, match="no register 99"):
        Read(99)
    with pytest.raises(ValueError, match="no port"):
        Read(23, 1)
    with pytest.raises(ValueError, match="read only"):
        Write(47, IDENTITY)
    with pytest.raises(ValueError, match="finite"):
        Write(23, (float("nan"), *IDENTITY[1:]))


def test_reply_time_grows_for_a_slow_line():
    assert reply_time_s(921600) < 0.3 < reply_time_s(115200) < 0.5 < 2.0 < reply_time_s(9600)


def test_reply_must_have_the_argument_of_the_command():
    assert RESUME.answered_by(Reply("VNASY", None, ("1",)))
    assert not RESUME.answered_by(Reply("VNASY", None, ("0",)))
    assert not RESUME.answered_by(Reply("VNKMD", None, ("1",)))
    assert Word("VNWNV").answered_by(Reply("VNWNV", None, ()))


def test_reply_must_have_the_requested_port():
    assert Read(6, 1).body == "VNRRG,06,1"
    assert Read(6, 1).answered_by(Reply("VNRRG", 6, ("14", "1")))
    assert not Read(6, 1).answered_by(Reply("VNRRG", 6, ("14",)))
    assert not Read(6, 1).answered_by(Reply("VNRRG", 6, ("14", "2")))
    assert Read(6).answered_by(Reply("VNRRG", 6, ("14",)))
