"""What a share hands on of the device's bytes, and how it stands.

**Messages.** Device bytes into whole messages for clients, without the replies to commands.

A driver needs a whole message before it can use any of it, so handing messages on when their last
byte is there costs no time, and an answer of ours fits between any two of them. Every byte comes
out, in order and once: in a message, as damage or noise where it stood, or as a reply, which is for
whoever asked. A message that is the next one and ends with what was read, as nearly all are, comes
out before the rest of the work (`ahead`).
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.vn100.deframer import Deframer, Sentence, Skipped
from drivers.vn100.messages import COMMAND_WORDS, REGISTER_WORDS

# -- Whole messages --------------------------------------------------------------------------------


_REPLIES = REGISTER_WORDS | COMMAND_WORDS | {"VNERR"}


def is_reply(body: str) -> bool:
    """Whether a line with this body answers a command."""
    return body[:5] in _REPLIES


class MessageSplitter:
    """Of one link. `replies`: how many were kept back."""

    def __init__(self) -> None:
        self.replies = 0
        self._deframer = Deframer()
        self._held = b""  # bytes that did not come out yet
        self._base = 0  # offset of the first of them in the stream
        self._ahead = False  # the next message has come out already

    def ahead(self, chunk: bytes) -> bytes:
        """The message for the clients that these bytes complete, where that is all they do.

        `feed` must be given the same bytes next, and leaves it out. Empty says nothing.
        """
        body = self._deframer.completes(chunk)
        if body is None or is_reply(body):
            return b""
        self._ahead = True
        return self._held + chunk if self._held else chunk

    def feed(self, chunk: bytes) -> list[bytes]:
        """Take bytes, cut anywhere; whole messages, and what is none, for the clients."""
        self._held += chunk
        frames = self._deframer.feed(chunk)
        pieces = sorted([*frames, *self._deframer.take_skipped()], key=lambda it: it.offset)
        out = []
        for piece in pieces:
            length = len(piece.data) if isinstance(piece, Skipped) else piece.length
            data, self._held = self._held[:length], self._held[length:]
            self._base += length
            if isinstance(piece, Sentence) and is_reply(piece.body):
                self.replies += 1
            elif not self._ahead:
                out.append(data)
            self._ahead = False
        return out

    def silence(self) -> list[bytes]:
        """Nothing came for a while: what waits for more bytes is no message and comes out."""
        self._deframer.drop_pending()
        return self.feed(b"")


# -- How a share stands ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ShareFacts:
    """One `[[share]]`.

    send:    what it sends: measurements and answers where it is empty (a pty)
    readers: programs that have it open; None where nobody knows (udp)
    lost_bytes: of whole messages that a reader did not take in time
    turned_away: connections beyond the limit; ignored_bytes: what readers of tcp sent
    """

    name: str
    send: str = ""
    readers: int | None = 0
    lost_bytes: int = 0
    turned_away: int = 0
    ignored_bytes: int = 0
    fault: str = ""
