"""The emulated VN-100's transmitter: whole messages, at the pace of the baud rate.

Up to `QUEUE_BYTES` wait; a message that does not fit is dropped, and as soon as there is room error
0B says so (vn100-protocol 3.1). A message reaches the host when its last byte has left.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from drivers.vn100.emulator.faults import FaultPlan

QUEUE_BYTES = 2048
BITS_PER_BYTE = 10  # 8N1


class Transmitter:
    """Orders messages in time. Messages must be sent in order of time.

    connected: whether anybody hears them;  overflows: messages that found no room
    """

    def __init__(self, plan: FaultPlan, baud: int, overflow: Callable[[], bytes]) -> None:
        self.baud = baud
        self.overflows = 0
        self.connected = True
        self._plan = plan
        self._overflow = overflow
        self._overflowed = False
        self._free_s = 0.0  # when the last byte of the queue will have left
        self._released_s = 0.0
        self._queue: deque[tuple[float, float, int, bytes]] = deque()

    def send(self, message: bytes, now_s: float) -> None:
        """Put a message into the queue at `now_s`."""
        if self._overflowed and self._room(now_s) >= QUEUE_BYTES // 2:
            self._overflowed = False
            self._put(self._overflow(), now_s)
        if self._room(now_s) < len(message):
            self._overflowed = True
            self.overflows += 1
            return
        self._put(message, now_s)

    def empty_at_s(self, now_s: float) -> float:
        """When everything that is in the queue will have left."""
        return max(self._free_s, now_s)

    def cut(self, now_s: float) -> None:
        """Power or plug is gone: what has not arrived is lost."""
        while self._queue and self._queue[-1][0] > now_s:
            self._queue.pop()
        self._free_s = 0.0
        self._released_s = 0.0
        self._overflowed = False

    def collect(self, now_s: float) -> list[tuple[int, bytes]]:
        """Messages that have reached the host by `now_s`, as the faults left them.

        With each the baud rate at which it was sent.
        """
        arrived = []
        while self._queue and self._queue[0][0] <= now_s:
            _, sent_s, baud, message = self._queue.popleft()
            arrived.append((baud, self._plan.distort(message, sent_s)))
        return arrived

    def _room(self, now_s: float) -> float:
        waiting = max(0.0, self._free_s - now_s) * self.baud / BITS_PER_BYTE
        return QUEUE_BYTES - waiting

    def _put(self, message: bytes, now_s: float) -> None:
        if not message:
            return
        start_s = self.empty_at_s(now_s)
        self._free_s = start_s + len(message) * BITS_PER_BYTE / self.baud
        self._released_s = max(self._released_s, self._plan.release_s(self._free_s))
        if self.connected:
            self._queue.append((self._released_s, self._free_s, self.baud, message))
