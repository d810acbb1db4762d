"""The socket with the real daemon and an emulated device."""

import json
import socket
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import replace

import pytest
from patience import PATIENCE_S

from ahrsd.errors import DeviceError
from ahrsd.telemetry.protocol import SCHEMA, line_of
from ahrsd.telemetry.public import Public
from ahrsd.telemetry.unix_socket import MOST_CLIENTS, DaemonConnection, SocketServer
from ahrsd.telemetry.words import status_lines


@pytest.fixture
def served(live, tmp_path):
    """A live daemon at 100 Hz with its socket."""
    daemon = live(device={"configure_stream": True, "rate_hz": 100.0})
    public = Public(time.monotonic())
    public.open_socket(tmp_path / "socket", tmp_path)
    daemon.shell.listeners.append(public.event)
    daemon.daemon._telemetry = public
    with daemon:
        yield daemon, tmp_path / "socket"
    public.close()


class Asking:
    """A program that uses the socket directly, as in any language."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(PATIENCE_S)
        self.socket.connect(str(path))
        self.lines = self.socket.makefile("rb")
        assert self.record()["schema"] == SCHEMA

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.lines.close()
        self.socket.close()

    def say(self, data):
        self.socket.sendall(data)

    def record(self):
        return json.loads(self.lines.readline())


def until_status(path):
    """The first status with samples."""
    for _ in range(100):
        with DaemonConnection(path) as asked:
            try:
                status = asked.ask("status")
            except DeviceError:
                status = None
        if status is not None and status["stream"]["samples"] > 100:
            return status
        time.sleep(0.1)
    raise AssertionError("no samples within 10 s")


def test_status_explain_and_watch_of_a_running_daemon(served):
    live, path = served
    status = until_status(path)
    assert status["schema"] == "ahrsd.status/1"
    assert status["device"]["serial"] == live.core.device_session.identity.serial
    assert status["stream"]["rejected"] == 0
    assert status["mode"] == "observe"
    assert any(line.startswith("device: VN-100") for line in status_lines(status))
    with DaemonConnection(path) as asked:
        explained = asked.ask("explain")
    assert explained["state"] == "OBSERVING"
    assert "the mode is observe; stage or commit may write" in explained["others"]
    assert explained["next"].startswith("drive two full circles")
    with DaemonConnection(path) as asked:
        records = asked.watch(("samples",))
        assert next(records) == {"watching": ["samples"]}
        some = [next(records) for _ in range(20)]
    assert [one["seq"] for one in some] == list(range(some[0]["seq"], some[0]["seq"] + 20))
    times = [t for one in some for t in one["time_s"]]
    assert times == sorted(times)
    assert all(len(one["raw_b_gauss"]) == len(one["time_s"]) for one in some)


def test_blocked_readers_lose_no_sample(served):
    live, path = served
    until_status(path)
    with ExitStack() as sleepers:
        for _ in range(8):
            one = sleepers.enter_context(socket.socket(socket.AF_UNIX))
            one.connect(str(path))
            one.sendall(b'{"ask": "watch", "of": ["status", "events", "samples"]}\n')
        before = live.samples
        live.until(lambda: live.samples >= before + 300, 60.0)
        facts = replace(live.core.stream.facts)
    assert live.core.stream.gaps == []
    assert facts.damaged == 0
    assert facts.samples == pytest.approx(facts.expected, abs=1.0)


def test_invalid_request_is_answered_and_the_connection_stays_open(tmp_path):
    server = SocketServer(tmp_path / "s")
    try:
        with Asking(tmp_path / "s") as asked:
            asked.say(b'nonsense\n{"ask":"status"}\n')
            assert "not a JSON object" in asked.record()["error"]
            assert "only just begun" in asked.record()["error"]
            asked.say(b"x" * 5000)
            assert asked.record()["error"] == "a line of over 4096 bytes"
    finally:
        server.close()
    assert not (tmp_path / "s").exists()


def test_too_many_clients_and_a_second_daemon_are_refused(tmp_path):
    path = tmp_path / "s"
    server = SocketServer(path)
    try:
        assert path.stat().st_mode & 0o777 == 0o660
        held = [DaemonConnection(path) for _ in range(MOST_CLIENTS)]
        with pytest.raises(DeviceError, match="clients are connected already"):
            DaemonConnection(path)
        for one in held:
            one.__exit__()
        with pytest.raises(FileExistsError, match="another daemon serves here"):
            SocketServer(path)
    finally:
        server.close()


def test_socket_of_a_dead_daemon_is_replaced(tmp_path):
    path = tmp_path / "s"
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    server = SocketServer(path)
    with DaemonConnection(path):
        server.close()


def test_missing_daemon_is_a_one_line_error(tmp_path):
    with pytest.raises(DeviceError, match=r"no daemon answers .*; is `ahrsd run` running"):
        DaemonConnection(tmp_path / "none")


def test_slow_reader_gets_a_gap_record(tmp_path):
    server = SocketServer(tmp_path / "s", limit_bytes=20_000)
    try:
        with Asking(tmp_path / "s") as asked:
            asked.say(b'{"ask": "watch", "of": ["status"]}\n')
            assert asked.record() == {"watching": ["status"]}
            for number in range(600):
                server.status({"number": number, "fill": "x" * 2000})
                time.sleep(0.0005)
            until = time.monotonic() + PATIENCE_S
            while server.dropped == 0 and time.monotonic() < until:
                time.sleep(0.01)
            seqs, gaps = [], []
            while not gaps:
                record = asked.record()
                (gaps if record["record"] == "gap" else seqs).append(record)
                server.status({"number": -1})
    finally:
        server.close()
    assert gaps[0]["first_seq"] == seqs[-1]["seq"] + 1
    assert gaps[0]["lost"] == gaps[0]["last_seq"] - gaps[0]["first_seq"] + 1
    assert json.dumps(seqs[0])  # plain values


def test_disconnecting_clients_do_not_stop_the_server(tmp_path):
    server = SocketServer(tmp_path / "s")
    try:
        server.status({"number": 0})
        for number in range(400):
            with Asking(tmp_path / "s") as asked:
                asked.say(b'{"ask": "watch", "of": ["status"]}\n')
                assert asked.record() == {"watching": ["status"]}
                asked.say(b'{"ask": "status"}\n')
                server.status({"number": number})
            server.status({"number": number})
        with DaemonConnection(tmp_path / "s") as asked:
            assert asked.ask("status") == {"number": 399}
    finally:
        server.close()


def test_daemon_that_ends_before_reading_a_request_is_reported_as_ended(tmp_path):
    """The kernel reports that end of a connection as a reset."""
    with closing(socket.socket(socket.AF_UNIX)) as listening:
        listening.bind(str(tmp_path / "socket"))
        listening.listen()

        def greet_and_end():
            connection, _ = listening.accept()
            connection.sendall(line_of({"schema": SCHEMA}))
            assert connection.recv(1, socket.MSG_PEEK)  # asked, and never read
            connection.close()

        daemon = threading.Thread(target=greet_and_end)
        daemon.start()
        has_ended = pytest.raises(DeviceError, match=r"socket: the daemon has ended$")
        with DaemonConnection(tmp_path / "socket") as asking, has_ended:
            next(asking.watch(("status",)))
        daemon.join()
