"""What a share forwards of the device's bytes, and its status.

**Messages.** Splits device bytes into whole messages for clients, without replies to commands.

A driver needs a whole message before it can use any of it, so forwarding a message when its last
byte arrives costs no time, and an answer of ours fits between any two messages. Every byte is
accounted for in order and once: in a message, as damage or noise at its place, or in a reply, which
goes to the client that sent the command. If the next message ends with the bytes just read, as
nearly all do, it is forwarded before the rest of the work (`completed_message`).
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.vn100.deframer import Deframer, Sentence, Skipped
from drivers.vn100.messages import COMMAND_WORDS, REGISTER_WORDS

# -- Whole messages --------------------------------------------------------------------------------


_REPLIES = REGISTER_WORDS | COMMAND_WORDS | {"VNERR"}


def is_reply(body: str) -> bool:
    """Whether a line with this body is the reply to a command."""
    return body[:5] in _REPLIES


class MessageSplitter:
    """Splits the bytes of one link. `replies`: number of replies left out."""

    def __init__(self) -> None:
        self.replies = 0
        self._deframer = Deframer()
        self._pending = b""  # bytes not yet returned
        self._base = 0  # their offset in the stream
        self._sent_ahead = False  # the next message was returned by `completed_message`

    def completed_message(self, chunk: bytes) -> bytes:
        """The message that these bytes complete, if they complete exactly one and add nothing else.

        `feed` must be given the same bytes next, and leaves that message out. Empty: undecided.
        """
        body = self._deframer.completes(chunk)
        if body is None or is_reply(body):
            return b""
        self._sent_ahead = True
        return self._pending + chunk if self._pending else chunk

    def feed(self, chunk: bytes) -> list[bytes]:
        """Take bytes, cut anywhere; returns whole messages, and damage or noise, for clients."""
        self._pending += chunk
        frames = self._deframer.feed(chunk)
        pieces = sorted([*frames, *self._deframer.take_skipped()], key=lambda it: it.offset)
        out = []
        for piece in pieces:
            length = len(piece.data) if isinstance(piece, Skipped) else piece.length
            data, self._pending = self._pending[:length], self._pending[length:]
            self._base += length
            if isinstance(piece, Sentence) and is_reply(piece.body):
                self.replies += 1
            elif not self._sent_ahead:
                out.append(data)
            self._sent_ahead = False
        return out

    def flush(self) -> list[bytes]:
        """The line was silent: return incomplete bytes, which are no message."""
        self._deframer.drop_pending()
        return self.feed(b"")


# -- Status of a share -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ShareFacts:
    """Status of one `[[share]]`.

    send:    what it sends; empty (a pty): measurements and answers
    readers: programs that have it open; None if unknown (udp)
    lost_bytes: of whole messages that a reader did not take in time
    turned_away: connections beyond the limit; ignored_bytes: bytes that readers sent over tcp
    """

    name: str
    send: str = ""
    readers: int | None = 0
    lost_bytes: int = 0
    turned_away: int = 0
    ignored_bytes: int = 0
    fault: str = ""
