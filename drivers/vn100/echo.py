"""Whether a line that comes in is the device's, or our own command that the wire sent back.

A half-duplex adapter, a terminal server with local echo or a port that was not set raw returns
every byte that is sent before the device's answer. The echo of a write or of a plain command reads
like its acknowledgement, so it must be told apart before anything is believed.

The echo of a read shows that the line echoes, because an answer to it would have values. From then
on the first line that equals a command is that command's echo, and only a second one its answer.
Should an echo be lost, the answer is taken for it and the command is repeated: the safe direction.
"""

from __future__ import annotations

import re
from collections import deque

_MOST_WAITING = 16  # commands whose echo may be under way
# A read whose answer has values; that of an empty user tag has none, and one with a port parameter
# ("VNRRG,06,1") reads like an answer.
_PLAIN_READ = re.compile(r"VNRRG,(?!00$)[0-9]+")


class Echo:
    """Of one link. `echoes`: whether the line was seen to echo."""

    def __init__(self) -> None:
        self.echoes = False
        self._waiting: deque[str] = deque(maxlen=_MOST_WAITING)

    def sent(self, body: str) -> None:
        """A command goes out; `body` is what is between $ and *."""
        self._waiting.append(body)

    def is_echo(self, body: str) -> bool:
        """Whether a line with this body is the echo of a command; each command has one."""
        if body not in self._waiting:
            return False
        if not self.echoes and not _PLAIN_READ.fullmatch(body):
            return False
        self.echoes = True
        while self._waiting.popleft() != body:
            pass  # an echo that was lost will not come any more
        return True

    def forget(self) -> None:
        """The link is gone; the next one may be another adapter."""
        self.echoes = False
        self._waiting.clear()
