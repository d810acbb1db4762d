"""What systemd is told, sd_notify(3): ready, stopping, one line of status, the watchdog.

One datagram a word, never an error. The main loop feeds the watchdog after each turn, but not while
the estimator is stuck: then it is killed and restarted, while one that waits for an unplugged
device turns on and is left alone.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time


class Notifier:
    """Speaks to $NOTIFY_SOCKET; does nothing where the service manager gave none."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # Linux's abstract namespace
            self._address = "\0" + self._address[1:]
        for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        asked_us = int(os.environ.get("WATCHDOG_USEC", "0")) if for_us else 0
        #: how often the watchdog is fed, seconds; 0 where there is none
        self.period_s = asked_us * 1e-6 / 3.0
        self._next_s = 0.0
        self._status_sent = ""
        self._is_ready = False

    def ready(self, status: str) -> None:
        """The service is up: it hears a device, or waits for one. Later only the status counts."""
        if self._is_ready:
            self.status(status)
            return
        self._is_ready, self._status_sent = True, status
        self._send(f"READY=1\nSTATUS={status}")

    def status(self, status: str) -> None:
        """One line for `systemctl status`; the same line is not sent twice."""
        if status != self._status_sent:
            self._status_sent = status
            self._send(f"STATUS={status}")

    def stopping(self) -> None:
        """The service is going down and may take its time for what it puts back."""
        self._send("STOPPING=1")

    def feed(self) -> None:
        """The loop turned once more."""
        if self.period_s and (now_s := time.monotonic()) >= self._next_s:
            self._next_s = now_s + self.period_s
            self._send("WATCHDOG=1")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        with (
            contextlib.suppress(OSError),  # a manager that is gone cannot be told
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as datagram,
        ):
            datagram.connect(self._address)
            datagram.send(text.encode())
