"""What waits for one client: bounded, and honest about what did not fit.

A reader that is slow or never reads costs this many bytes and nothing else. Records that do not fit
are dropped; as soon as there is room, a `gap` record says how many and which.
"""

from __future__ import annotations

from ahrsd.telemetry.protocol import line_of

LIMIT_BYTES = 1 << 20


class Outbox:
    """Lines in order; whole lines are dropped, never parts."""

    def __init__(self, limit_bytes: int = LIMIT_BYTES) -> None:
        self.limit_bytes = limit_bytes
        self.dropped = 0  # records, since the client came
        self.lost_bytes = 0  # of what was dropped
        self._data = bytearray()
        self._gap: tuple[int, int, int] | None = None  # count, first seq, last seq

    def __len__(self) -> int:
        return len(self._data)

    def answer(self, line: bytes) -> bool:
        """An answer to a request; false where there is no room for it."""
        if len(self._data) + len(line) > self.limit_bytes:
            return False
        self._data += line
        return True

    def offer(self, message: bytes) -> None:
        """A message that nobody is told of where there is no room for it; it is counted."""
        if not self.answer(message):
            self.dropped += 1
            self.lost_bytes += len(message)

    def record(self, line: bytes, seq: int) -> None:
        """A record that is watched; dropped, and counted, where there is no room."""
        note = self._gap_line(seq)
        if len(self._data) + len(note) + len(line) > self.limit_bytes:
            count, first, _ = self._gap or (0, seq, seq)
            self._gap = (count + 1, first, seq)
            self.dropped += 1
            self.lost_bytes += len(line)
            return
        self._data += note + line
        self._gap = None

    def head(self, size: int) -> bytes:
        """The first bytes that wait."""
        return bytes(self._data[:size])

    def sent(self, size: int) -> None:
        """So many bytes are gone."""
        del self._data[:size]

    def _gap_line(self, seq: int) -> bytes:
        if self._gap is None:
            return b""
        count, first, last = self._gap
        gap = {"record": "gap", "seq": seq, "lost": count, "first_seq": first, "last_seq": last}
        return line_of(gap)
