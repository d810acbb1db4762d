"""Network shares as seen by readers: many, slow, disconnected, sending, or refused, and occupied
names.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import resource
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cabled_units import sentence
from free_port import free_port
from patience import PATIENCE_S

from ahrsd.config.sections import ShareSection
from ahrsd.daemon.shares import MOST_READERS, NetworkShares, Shares
from ahrsd.errors import ConfigError

TEXT = sentence("VNYMR,+006.271,+000.031,-002.000,+0.2,-0.1,+0.4,+0.1,-0.2,-9.8,+0.1,+0.2,+0.3")


def free(kind: socket.SocketKind = socket.SOCK_STREAM) -> str:
    """An unused address."""
    return f"127.0.0.1:{free_port(kind)}"


def place(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    return host, int(port)


def until(what: Callable[[], object]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def read(reader: socket.socket, wanted: int, longest_s: float = PATIENCE_S) -> bytes:
    reader.settimeout(0.05)
    got, end_s = b"", time.monotonic() + longest_s
    while len(got) < wanted and time.monotonic() < end_s:
        with contextlib.suppress(TimeoutError):
            piece = reader.recv(1 << 16)
            if not piece:
                break
            got += piece
    return got


class Served:
    """One tcp share."""

    def __init__(self) -> None:
        self.address = free()
        share = ShareSection(tcp=self.address)
        self.shares = Shares([share], print, time.monotonic_ns)

    @property
    def facts(self):
        return self.shares.facts()[0]

    def connected(self, buffer: int | None = None) -> socket.socket:
        before = self.facts.readers
        one = socket.socket()
        if buffer is not None:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        one.connect(place(self.address))
        until(lambda: self.facts.readers == before + 1)
        return one


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    yield served
    served.shares.close()


def test_every_reader_gets_all_messages_and_no_answers_to_others(served):
    one, two = served.connected(), served.connected()
    served.shares.heard(TEXT[:20])
    served.shares.heard(TEXT[20:] + sentence("VNRRG,23,1") + bytes(range(40)) + TEXT)
    served.shares.heard(b"")
    wanted = TEXT + bytes(range(40)) + TEXT
    assert read(one, len(wanted)) == read(two, len(wanted)) == wanted
    one.close()
    two.close()


def test_message_is_forwarded_at_once(served):
    one = served.connected()
    for _ in range(20):
        begun_s = time.monotonic()
        served.shares.heard(TEXT)
        assert read(one, len(TEXT)) == TEXT
        assert time.monotonic() - begun_s < 0.5  # on a busy machine; typically 0.1 ms
    one.close()


def test_blocked_reader_loses_only_its_own_messages_and_they_are_counted(served):
    idle, reader = served.connected(4096), served.connected()
    got = b""
    for _ in range(4000):
        served.shares.heard(TEXT)
        got += read(reader, len(TEXT))
    assert got == TEXT * 4000
    lost = served.facts.lost_bytes
    assert lost > 0
    kept = read(idle, len(got) - lost)
    assert kept == TEXT * (4000 - lost // len(TEXT))  # whole messages
    served.shares.heard(TEXT)
    assert read(idle, len(TEXT)) == TEXT  # and it continues
    assert served.facts.lost_bytes == lost
    idle.close()
    until(lambda: served.facts.readers == 1)
    assert served.facts.lost_bytes == lost  # also after it disconnected
    reader.close()


def test_reader_of_numbered_records_learns_which_were_lost():
    share = ShareSection(tcp=free(), send="corrected")
    shares = NetworkShares([share])
    (outlet,) = shares.places
    assert not outlet.wanted
    outlet.write([], 1, b'{"seq":0}\n')
    with socket.socket() as idle:
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        idle.connect(place(share.tcp))
        until(lambda: outlet.wanted)
        for seq in range(1, 8001):
            outlet.write([b'{"seq":%d,"more":"%s"}\n' % (seq, b"x" * 200)], seq, b"")
        got = read(idle, 1 << 30, 2.0)
        outlet.write([b'{"seq":8001}\n'], 8001, b"")
        got += read(idle, 1 << 30, 1.0)
        assert 0 < shares.facts()[0].lost_bytes < 8000 * 230
    shares.close()
    records = [json.loads(line) for line in got.splitlines()]
    assert records[0] == {"seq": 0}  # the newest record when it connected
    gaps = [record for record in records if record.get("record") == "gap"]
    seen = {record["seq"] for record in records if "record" not in record}
    lost = {seq for gap in gaps for seq in range(gap["first_seq"], gap["last_seq"] + 1)}
    assert gaps
    assert seen | lost == set(range(8002))
    assert seen & lost == set()
    assert sum(gap["lost"] for gap in gaps) == len(lost)


def test_bytes_from_a_reader_are_discarded_and_logged_once(served, caplog):
    one = served.connected()
    with caplog.at_level(logging.WARNING, "ahrsd"):
        for _ in range(3):
            one.sendall(b"$VNWRG,23,2,0,0,0,1,0,0,0,1,0,0,0*XX\r\n")
        until(lambda: served.facts.ignored_bytes == 3 * 38)
    assert caplog.text.count("thrown away") == 1
    served.shares.heard(TEXT)
    assert read(one, len(TEXT)) == TEXT
    one.close()


def test_flood_from_a_reader_is_throttled_and_others_continue(served):
    loud, reader = served.connected(), served.connected()
    loud.setblocking(False)
    begun_s, got, count = time.monotonic(), b"", 0
    while time.monotonic() - begun_s < 1.5:
        with contextlib.suppress(BlockingIOError):
            loud.send(b"x" * 65536)
        served.shares.heard(TEXT)
        count += 1
        got += read(reader, len(TEXT))
    took_s = time.monotonic() - begun_s
    assert got == TEXT * count
    assert 4096 <= served.facts.ignored_bytes <= 4096 * (took_s / 0.02 + 2)
    loud.close()
    reader.close()


def test_readers_beyond_the_limit_are_refused_and_logged_once(served, caplog):
    readers = [served.connected() for _ in range(MOST_READERS)]
    with caplog.at_level(logging.WARNING, "ahrsd"):
        for number in range(3):
            with socket.create_connection(place(served.address)) as late:
                late.settimeout(PATIENCE_S)
                assert late.recv(1) == b""
            assert served.facts.turned_away == number + 1
    assert caplog.text.count("turned away") == 1
    readers.pop().close()
    until(lambda: served.facts.readers == MOST_READERS - 1)
    readers.append(served.connected())
    served.shares.heard(TEXT)
    assert [read(reader, len(TEXT)) for reader in readers] == [TEXT] * MOST_READERS
    for reader in readers:
        reader.close()


def test_disconnected_readers_leave_no_descriptor(served):
    before = len([*Path("/proc/self/fd").iterdir()])
    for _ in range(100):
        one = served.connected()
        served.shares.heard(TEXT)
        one.close()
        until(lambda: served.facts.readers == 0)
    assert len([*Path("/proc/self/fd").iterdir()]) == before


def test_connected_readers_continue_when_descriptors_are_exhausted(served, caplog):
    one = served.connected()
    late = socket.socket()
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with caplog.at_level(logging.WARNING, "ahrsd"):
        highest = max(int(path.name) for path in Path("/proc/self/fd").iterdir())
        held = [os.dup(0) for _ in range(highest)]
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(held) + 1, before[1]))
        try:
            late.connect(place(served.address))
            until(lambda: served.facts.fault)
            served.shares.heard(TEXT)
            assert read(one, len(TEXT)) == TEXT
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
            for fd in held:
                os.close(fd)
    assert caplog.text.count("nobody can connect: Too many open files") == 1
    until(lambda: served.facts.readers == 2)
    assert served.facts.fault == ""
    late.close()
    one.close()


def test_reader_that_resets_its_connection_is_removed(served):
    one, two = served.connected(), served.connected()
    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    one.close()
    served.shares.heard(TEXT)
    until(lambda: served.facts.readers == 1)
    served.shares.heard(TEXT)
    assert read(two, 2 * len(TEXT)) == TEXT * 2
    two.close()


def test_address_is_free_after_a_run_with_readers(served):
    one = served.connected()
    served.shares.close()
    assert one.recv(1) == b""
    again = NetworkShares([ShareSection(tcp=served.address)])
    again.close()
    one.close()


def test_udp_share_sends_one_datagram_per_message():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(PATIENCE_S)
        address = f"127.0.0.1:{heard.getsockname()[1]}"
        shares = Shares([ShareSection(udp=address)], print, time.monotonic_ns)
        shares.heard(TEXT + sentence("VNRRG,23,1") + TEXT[:30])
        shares.heard(TEXT[30:])
        assert [heard.recv(4096), heard.recv(4096)] == [TEXT, TEXT]
        assert shares.facts()[0].readers is None
        shares.close()


def test_undeliverable_datagrams_are_counted_and_stop_nothing(caplog):
    nobody, nowhere = free(socket.SOCK_DGRAM), "[2001:db8::1]:5005"
    shares = NetworkShares([ShareSection(udp=nobody), ShareSection(udp=nowhere, other_hosts=True)])
    with caplog.at_level(logging.WARNING, "ahrsd"):
        for _ in range(5):
            shares.raw([TEXT])
    there, not_there = shares.facts()
    assert (there.lost_bytes, there.fault) == (0, "")
    if not_there.fault:  # sent if the machine has a default route
        assert not_there.lost_bytes == 5 * len(TEXT)
        assert caplog.text.count(not_there.fault) == 1
    shares.close()


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_share_works_over_ipv6(kind):
    try:
        shares = NetworkShares([ShareSection(**{kind: "[::1]:21019"})])
    except ConfigError:
        pytest.skip("this machine has no IPv6")
    shares.close()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        (None, "another program listens there; stop it or choose another port"),
        ("192.0.2.77:2101", "no interface of this machine has that address"),
    ],
)
def test_unusable_address_is_a_one_line_error_without_remains(tmp_path, address, words):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        address = address or f"127.0.0.1:{other.getsockname()[1]}"
        good = ShareSection(pty=tmp_path / "good")
        bad = ShareSection(tcp=address, other_hosts=True)
        with pytest.raises(ConfigError, match=re.escape(words)) as error:
            Shares([good, bad], print, time.monotonic_ns)
    assert str(error.value) == f"share.tcp = {address}: {words}"
    assert not os.path.lexists(tmp_path / "good")


def test_address_reachable_by_others_is_logged_at_the_start():
    address = free().replace("127.0.0.1", "0.0.0.0")
    shares = Shares(
        [ShareSection(tcp=address, other_hosts=True), ShareSection(udp="127.0.0.1:9")],
        print,
        time.monotonic_ns,
    )
    info, warning = shares.announced()
    assert info == (
        logging.INFO,
        f"the device is shared on tcp {address} (raw), udp 127.0.0.1:9 (raw)",
    )
    assert warning == (
        logging.WARNING,
        f"other machines can read the device at tcp {address} (other_hosts = true)",
    )
    shares.close()
