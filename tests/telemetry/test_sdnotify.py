"""sd_notify over a real datagram socket."""

import socket
import time

import pytest

from ahrsd.telemetry.sd_notify import Notifier


@pytest.fixture
def manager(tmp_path, monkeypatch):
    """A service manager's socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.settimeout(0.2)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield bound


def test_ready_status_and_stopping(manager):
    notifier = Notifier()
    notifier.ready("OBSERVING")
    notifier.status("OBSERVING")  # said already
    notifier.status("waiting for the device")
    notifier.stopping()
    heard = [manager.recv(4096).decode() for _ in range(3)]
    assert heard == ["READY=1\nSTATUS=OBSERVING", "STATUS=waiting for the device", "STOPPING=1"]
    with pytest.raises(TimeoutError):
        manager.recv(4096)


def test_the_watchdog_is_fed_three_times_in_its_period(manager, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "300000")
    notifier = Notifier()
    assert notifier.period_s == pytest.approx(0.1)
    until, fed = time.monotonic() + 0.35, 0
    while time.monotonic() < until:
        notifier.feed()
        time.sleep(0.005)
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        while manager.recv(4096) == b"WATCHDOG=1":
            fed += 1
    assert 3 <= fed <= 4


def test_a_watchdog_of_another_process_is_not_ours(manager, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "300000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert Notifier().period_s == 0.0


def test_without_a_manager_or_with_a_dead_one_nothing_happens(monkeypatch, tmp_path):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    Notifier().ready("x")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    Notifier().ready("x")
    assert not (tmp_path / "gone").exists()
