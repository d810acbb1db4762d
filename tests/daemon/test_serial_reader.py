"""Data waiting for the core are bounded, and no byte that was read is dropped."""

from __future__ import annotations

import itertools
import os
import pty
import threading
from pathlib import Path

from patience import PATIENCE_S

from ahrsd.daemon.serial_link import Bytes, Inbox, Lost, SerialLink, SerialReader
from ahrsd.inputs import LinkLost, Received
from ahrsd.recording.capture import CaptureReader
from drivers.vn100.deframer import Cause
from drivers.vn100.session import SILENCE_S


class Endless:
    """A port with endless numbered lines; it blocks after `stop_at` were read."""

    def __init__(self, stop_at=10**9):
        self.numbers, self.stop_at, self.read_so_far = itertools.count(), stop_at, 0

    def read(self, wait_s):
        if self.read_so_far >= self.stop_at:
            threading.Event().wait(0.005)
            return b""
        self.read_so_far += 1
        return b"%06d\n" % next(self.numbers)


def ended(reader):
    reader._thread.join(PATIENCE_S)
    return not reader._thread.is_alive()


def test_reader_gives_up_with_a_reason_when_its_data_are_not_processed():
    inbox, port = Inbox(limit_bytes=10_000), Endless()
    reader = SerialReader(port, inbox, lambda: 7)
    assert ended(reader)
    assert 10_000 < inbox.backlog_bytes <= 10_000 + 7 + 128
    items = [inbox.get(0.0) for _ in range(port.read_so_far + 1)]
    assert items[-1] == Lost(7, f"{75 * 135} bytes wait to be worked on: reading was given up")
    assert b"".join(item.data for item in items[:-1]) == b"".join(b"%06d\n" % k for k in range(75))
    assert inbox.empty
    assert inbox.backlog_bytes == 0


def test_reader_continues_when_its_data_are_processed():
    inbox, port = Inbox(limit_bytes=500 * 135), Endless(stop_at=400)
    reader = SerialReader(port, inbox, lambda: 7)
    heard = []
    for more in (400, 800, 1200):  # three times the limit of waiting data
        port.stop_at = more
        heard += [inbox.get(5.0).data for _ in range(400)]
        assert inbox.backlog_bytes == 0
    assert heard == [b"%06d\n" % k for k in range(1200)]
    assert reader.stop()


def test_reader_that_may_wait_leaves_further_data_in_the_port():
    inbox, port = Inbox(patient_bytes=1000), Endless()
    reader = SerialReader(port, inbox, lambda: 7)
    heard = []
    for _ in range(30):  # more than it reads by itself
        heard += [inbox.get(5.0).data]
    threading.Event().wait(0.05)
    assert 1000 < inbox.backlog_bytes <= 1000 + 7 + 128
    read_so_far = port.read_so_far
    threading.Event().wait(0.05)
    assert port.read_so_far == read_so_far
    assert heard == [b"%06d\n" % k for k in range(30)]
    assert reader.stop()


def test_waiting_data_can_be_taken_at_once_without_markers():
    inbox = Inbox()
    inbox.wake()
    inbox.put(Bytes(1, b"a"))
    inbox.wake()
    inbox.put(Bytes(2, b"bc"))
    inbox.put(Lost(3, "gone"))
    assert inbox.backlog_bytes == 3 + 2 * 128
    assert inbox.rest() == [Bytes(1, b"a"), Bytes(2, b"bc")]
    assert inbox.backlog_bytes == 0
    assert inbox.get(0.0) is None


def test_core_that_falls_behind_loses_the_link_and_no_byte(live):
    behind = threading.Event()
    with live({"output": "imu"}) as daemon:
        daemon.flowing()
        inbox = daemon.daemon._inbox
        inbox.limit_bytes = 2_000

        def work_for_long(_):
            if not behind.is_set():
                behind.set()
                until = threading.Event()
                for _ in range(500):
                    if daemon.daemon._link._reader._thread.is_alive():
                        until.wait(0.02)
                inbox.limit_bytes = 1 << 20

        daemon.shell.listeners.append(work_for_long)
        daemon.until(lambda: daemon.noted("reading was given up"))
        before = daemon.core.stream.facts.samples
        daemon.until(lambda: daemon.core.stream.facts.samples > before + 20)
        daemon.stop()
    items = list(CaptureReader(daemon.capture))
    (lost,) = [k for k, item in enumerate(items) if isinstance(item, LinkLost)]
    waited = [len(item.data) + 128 for item in items[:lost] if isinstance(item, Received)]
    assert sum(waited) > 2_000
    fed = daemon.core.device_session.session.deframer.counters.fed_bytes
    assert fed == sum(len(item.data) for item in items if isinstance(item, Received))
    assert daemon.core.stream.facts.damaged == 0


class Starved:
    """A stand-in for the daemon's link: an open port whose thread does not get to read."""

    is_open = True

    def __init__(self, link):
        self.link, self.more = link, True

    def has_more(self):
        return self.more

    def close(self):
        return self.link.close()


def test_partial_message_is_kept_while_its_end_waits_to_be_read(live):
    with live({"output": "imu"}) as daemon:
        daemon.flowing()
        daemon.stop()
    one, deframer = daemon.daemon, daemon.core.device_session.session.deframer
    cut = deframer.counters.damage.get(Cause.CUT, 0)
    one._link = Starved(one._link)
    one._feed(Received(one.clock.now_ns(), b"$VNIMU,-00.1"))
    threading.Event().wait(1.5 * SILENCE_S)
    for _ in range(3):
        one._turn(0.0)
    assert deframer.pending > 0
    one._link.more = False
    one._turn(0.0)
    assert deframer.pending == 0
    assert deframer.counters.damage[Cause.CUT] == cut + 1


def test_data_in_the_port_are_seen_while_the_reader_waits(tmp_path):
    ours, theirs = pty.openpty()
    link = SerialLink(Path(os.ttyname(theirs)), 115200, lambda: 7)
    try:
        assert link.has_more() is False
        link.open(may_query=False)
        threading.Event().wait(0.02)  # the reader waits by now
        assert link.has_more() is False
        assert link._reader.stop()
        os.write(ours, b"$VN")
        assert link.has_more() is True
        link.close()
        assert link.has_more() is False
    finally:
        os.close(ours)
        os.close(theirs)
