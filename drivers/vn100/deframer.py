"""Messages with a right checksum or CRC out of a stream of ASCII lines and binary packets.

Sans I/O.

Theory of operation (vn100-protocol 1.4)
========================================

**Starts.** ``$VN`` starts a line. ``FA`` starts a packet if its header is one of known layout, of
whichever model. Whatever else is between messages is noise, NMEA sentences of other devices
included.

**Candidates.** A line ends at ``\\n``, with up to two ``\\r`` before it (a port in text mode adds
one), at ``\\r`` alone where the next message begins there, or where the next line begins at once
(programs that strip line ends). It dies at ``$``, at a byte that is
not printable and at the length limit. A packet ends where its header says. A candidate that fails
is left by one byte: the next start inside of it is tried.

**Checks.** Source: UM001 "Checksum / CRC" (vn100-protocol 1.1, 1.2).

* ASCII, 2 hex digits: XOR of all bytes between ``$`` and ``*``.
* ASCII, 4 hex digits, and binary: CRC-16/XMODEM (polynomial 0x1021, initial value 0), sent with the
  high byte first, so that the CRC over data and CRC together is 0.

**Which message wins.** Behind a valid message a packet of a layout that was seen before is believed
and waited for. Anywhere else all starts are followed in parallel and the message that ends first
wins, so a false header that announces 600 bytes holds nothing up. Both rules speak of offsets in
the stream only, so how the stream is cut into chunks changes nothing.

**Damage** is counted by cause and never raised; the bytes are kept until `take_skipped`. A message
is *rejected* when its start was recognised and then its checksum, CRC or content refused it; each
such start counts once. A header with fields that no VN-100 has is recognised only behind a whole
packet with it: most of them are bytes of something else. Two lines that became one because the
bytes between were lost are one. Where a new ``$`` breaks a line off, that is one for the first, and
the second is judged by itself. A start that silence cut (`Cause.CUT`) was refused by nobody: it is
damage, but not rejected.

    fed bytes = bytes of valid messages + skipped bytes + pending        always
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections import deque
from dataclasses import dataclass, field
from enum import Enum

from drivers.vn100.messages import (
    SYNC,
    BinaryLayout,
    crc16,
    is_of_vn100,
    layout_of,
    read_header,
    size_in,
    xor8,
)

# -- Checks ----------------------------------------------------------------------------------------


_AFTER_SYNC = 0xFA00  # from here the byte FA leads to 0: lets the CRC run over a packet with its FA
_TEXT = rb"[ -#%-)+-~]"  # printable, neither $ nor *
_CHECKED = rb"\$(VN%b{3,})\*((?:[0-9A-Fa-f]{2}){1,2})" % _TEXT
# A port in text mode makes CR CR LF of CR LF; one that edits lines may leave CR alone, or nothing.
LINE = re.compile(_CHECKED + rb"(?:\r{0,2}\n|\r{0,2}(?=\$)|\r{1,2}(?=\xfa))")
LINE_AT_THE_END = re.compile(_CHECKED + rb"(?:\r{0,2}\n|\r{0,2}(?=\$)|\r{1,2}(?=\xfa|\Z))")
COMMAND_LINE = re.compile(rb"\$(VN%b{3,})\*((?:[0-9A-F]{2}){1,2}|XX)\r?\n" % _TEXT)


def packet_intact(packet: bytes) -> bool:
    """Whether the CRC of a whole binary packet, sync byte FA to last CRC byte, is right."""
    return crc_hqx(packet, _AFTER_SYNC) == 0


def line_intact(match: re.Match[bytes]) -> bool:
    """Whether the check of a line, matched by one of the two, is right.

    Two digits are the XOR, four the CRC; a host may write XX to have none.
    """
    body, check = match.groups()
    if check == b"XX":
        return True
    return (xor8(body) if len(check) == 2 else crc16(body)) == int(check, 16)


# -- Messages out of bytes -------------------------------------------------------------------------


LONGEST_LINE = 320
LONGEST_COMMAND = 256  # receive buffer of the device
KEPT_SKIPPED_BYTES = 65536  # of what nobody took; a feed's own skipped bytes are always all there
_TRUSTED_LAYOUTS = 8

_LINE_END = re.compile(rb"[^ -#%-~]")  # not printable, or $
_UNCHECKED = re.compile(rb"\$VN[A-Z]{3},[^*\r\n]*(?:\*XX)?\r*\n")
_CR, _LF = 0x0D, 0x0A
_LINE_START = rb"\$(?:\Z|V(?:\Z|N))"
_COMMAND_STARTS = re.compile(_LINE_START)
# a second group byte can only announce GNSS3
_STARTS = re.compile(_LINE_START + rb"|\xfa(?=\Z|[\x01-\x7f]|[\x80-\xff](?:\Z|\x20))")


class Cause(Enum):
    """Why bytes were skipped."""

    NOISE = "noise"  # no message begins here
    CHECKSUM = "checksum"  # of a line: wrong or missing
    CRC = "crc"  # of a packet
    BROKEN = "broken"  # a line with a $ or an unprintable byte inside
    TOO_LONG = "too long"  # a line without an end
    OVERTAKEN = "overtaken"  # a packet that waited for bytes until a message inside of it was whole
    CUT = "cut"  # the wire fell silent in the middle


REJECTIONS = frozenset(Cause) - {Cause.NOISE, Cause.CUT}


@dataclass(frozen=True, slots=True)
class Sentence:
    """A line whose checksum is right. `body`: between ``$`` and ``*``; `length` on the wire."""

    body: str
    offset: int
    length: int


@dataclass(frozen=True, slots=True)
class Packet:
    """A packet whose CRC is right. `data`: as on the wire, from FA to the CRC."""

    layout: BinaryLayout
    data: bytes
    offset: int

    @property
    def length(self) -> int:
        """Bytes on the wire."""
        return len(self.data)


Frame = Sentence | Packet


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes that are no message, `offset` counted from the first byte ever fed."""

    offset: int
    data: bytes
    cause: Cause


@dataclass(slots=True)
class Counters:
    """Running totals. `damage`: recognised starts of messages that came to nothing, by cause.

    unchecked: lines that carry no checksum, or XX in place of one; they are among the damage
    """

    fed_bytes: int = 0
    valid_bytes: int = 0
    skipped_bytes: int = 0
    sentences: int = 0
    packets: int = 0
    unchecked: int = 0
    damage: dict[Cause, int] = field(default_factory=dict)

    @property
    def valid(self) -> int:
        """Messages with a right checksum or CRC."""
        return self.sentences + self.packets

    @property
    def rejected(self) -> int:
        """Messages that were recognised and refused; see the module."""
        return sum(number for cause, number in self.damage.items() if cause in REJECTIONS)


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A start of a message and its fate; offsets in the buffer.

    stop:    behind the last byte that belongs to it
    decided: the number of bytes of the buffer that decide its fate
    cause:   None where it is valid (then it has a frame) or more bytes are needed
    recognised: false while the start itself needs more bytes
    """

    start: int
    stop: int = 0
    decided: int = 0
    cause: Cause | None = None
    frame: Frame | None = None
    recognised: bool = True

    @property
    def waiting(self) -> bool:
        return self.cause is None and self.frame is None


class Deframer:
    """Bytes in, messages with a right checksum out; see the module.

    host_side: read what a host sends: lines only, ``*XX`` accepted as checksum (the emulator).
    """

    def __init__(self, *, host_side: bool = False) -> None:
        self.counters = Counters()
        self._line = COMMAND_LINE if host_side else LINE
        self._longest = LONGEST_COMMAND if host_side else LONGEST_LINE
        self._starts = _COMMAND_STARTS if host_side else _STARTS
        self._buffer = b""
        self._base = 0  # offset of the buffer's first byte in the stream
        self._synced = False  # the buffer begins right behind a valid message
        self._trusted: list[BinaryLayout] = []
        self._ready: list[Frame] = []
        self._skipped: deque[Skipped] = deque()
        self._kept = 0

    @property
    def pending(self) -> int:
        """Bytes that wait for more; hardly more than the longest message has."""
        return len(self._buffer)

    def feed(self, chunk: bytes) -> list[Frame]:
        """Take bytes, cut anywhere; return the messages that they complete, in order."""
        self.counters.fed_bytes += len(chunk)
        while self._kept > KEPT_SKIPPED_BYTES:
            self._kept -= len(self._skipped.popleft().data)
        frames, self._ready = self._ready, []
        self._parse(self._buffer + chunk, frames, final=False)
        return frames

    def completes(self, chunk: bytes) -> str | None:
        """Whether this chunk ends the next message, in sync: the line's body, "" of a packet.

        Then that message is all that `feed` returns for the chunk. Told at a part of its cost, and
        changes nothing; None says nothing.
        """
        if not (self._synced and chunk):
            return None
        data = self._buffer + chunk if self._buffer else chunk
        if data[0] == SYNC:
            layout = self._trusted[-1] if self._trusted else None
            if layout is None or not data.startswith(layout.header):
                return None
            whole = layout.size_in(data, 0) == len(data) and packet_intact(data)
            return "" if whole else None
        match = self._line.match(data, 0, self._longest)
        if match is None or match.end() != len(data) or not line_intact(match):
            return None
        return match[1].decode()

    def drop_pending(self) -> None:
        """The wire was silent or the port closed: what still waits for bytes is void.

        Whole messages inside of it come out of the next `feed`, which may be empty.
        """
        self._parse(self._buffer, self._ready, final=True)
        self._synced = False

    def take_skipped(self) -> list[Skipped]:
        """The bytes skipped since the last call, in order; neighbouring noise is one piece.

        Of what was not taken the newest 64 KiB stay, and all of the newest `feed`.
        """
        pieces: list[list[Skipped]] = []
        end = 0
        for piece in self._skipped:
            goes_on = piece.offset == end and piece.cause is Cause.NOISE
            if pieces and goes_on and pieces[-1][0].cause is Cause.NOISE:
                pieces[-1].append(piece)
            else:
                pieces.append([piece])
            end = piece.offset + len(piece.data)
        self._skipped.clear()
        self._kept = 0
        return [
            Skipped(first.offset, b"".join(piece.data for piece in (first, *rest)), first.cause)
            for first, *rest in pieces
        ]

    # ── in sync: message behind message ──────────────────────────────────────────────────────────

    def _parse(self, buffer: bytes, frames: list[Frame], final: bool) -> None:
        """Consume the buffer as far as its fate is certain; all of it when `final`."""
        position = 0
        while position < len(buffer):
            decided = 0
            if self._synced:
                position, decided = self._follow(buffer, position, frames)
            if position == len(buffer) or (decided > len(buffer) and not final):
                break
            winner, skipped_to = self._search(buffer, position, decided, final)
            self._synced = self._synced and skipped_to == position
            position = skipped_to
            if winner is None:
                break
            self._accept(winner)
            frames.append(winner)
            position += winner.length
        self._base += position
        self._buffer = buffer[position:]

    def _follow(self, buffer: bytes, position: int, frames: list[Frame]) -> tuple[int, int]:
        """Lines and packets of trusted layouts as long as each begins where the last one ended.

        Returns where that stops, and the end of the trusted packet there that failed or waits.
        """
        first, lines, known = position, 0, len(frames)
        base, available, longest, decided = self._base, len(buffer), self._longest, 0
        layout = self._trusted[-1] if self._trusted else None
        while position < available:
            if buffer[position] == SYNC:
                if layout is None or not buffer.startswith(layout.header, position):
                    layout = self._trusted_at(buffer, position)
                    if layout is None:
                        break
                stop = position + layout.size_in(buffer, position)
                data = buffer[position:stop]
                if stop > available or not packet_intact(data):
                    decided = stop
                    break
                frames.append(Packet(layout, data, base + position))
            else:
                match = self._line.match(buffer, position, position + longest)
                if match is None or not line_intact(match):
                    break
                stop = match.end()
                frames.append(Sentence(match[1].decode(), base + position, stop - position))
                lines += 1
            position = stop
        self.counters.sentences += lines
        self.counters.packets += len(frames) - known - lines
        self.counters.valid_bytes += position - first
        return position, decided

    def _trusted_at(self, buffer: bytes, position: int) -> BinaryLayout | None:
        return next((x for x in self._trusted if buffer.startswith(x.header, position)), None)

    # ── out of sync: every start in parallel ─────────────────────────────────────────────────────

    def _search(
        self, buffer: bytes, position: int, decided: int, final: bool
    ) -> tuple[Frame | None, int]:
        """The message that ends first, and up to where bytes were skipped: its start if there is.

        decided: the fate of the candidate at `position` was awaited up to there.
        """
        winner: _Candidate | None = None
        candidates = []
        for match in self._starts.finditer(buffer, position):
            start = match.start()
            if winner is not None and start >= winner.stop:
                break
            candidate = self._examine(buffer, start, final)
            if candidate is None:
                continue
            candidates.append(candidate)
            if candidate.frame is not None and (winner is None or candidate.stop < winner.stop):
                winner = candidate
        if winner is not None:
            until, now, otherwise = winner.start, max(winner.stop, decided), Cause.OVERTAKEN
        else:
            until = len(buffer) if final else _settled(candidates, len(buffer))
            now, otherwise = len(buffer), Cause.CUT
        before = [candidate for candidate in candidates if candidate.start < until]
        self._skip(buffer, position, until, _causes(before, now, otherwise))
        return (None if winner is None else winner.frame), until

    def _examine(self, buffer: bytes, start: int, final: bool) -> _Candidate | None:
        """What the start at `start` leads to; None where it turns out not to be one."""
        if buffer[start] != SYNC:
            return self._examine_line(buffer, start, final)
        header = read_header(buffer, start)
        if not header:
            return _Candidate(start, recognised=False)
        size = size_in(header, buffer, start)
        if not size:
            return None
        likely = is_of_vn100(header) or any(header == layout.header for layout in self._trusted)
        stop = start + size
        if stop > len(buffer):
            return _Candidate(start, recognised=likely)
        data = buffer[start:stop]
        if not packet_intact(data):
            return _Candidate(start, stop, stop, Cause.CRC) if likely else None
        frame = Packet(layout_of(header), data, self._base + start)
        return _Candidate(start, stop, stop, None, frame)

    def _examine_line(self, buffer: bytes, start: int, final: bool) -> _Candidate:
        if len(buffer) < start + 3:
            return _Candidate(start, recognised=False)
        limit = start + self._longest
        ends = final and self._line is LINE and len(buffer) < limit
        match = (LINE_AT_THE_END if ends else self._line).match(buffer, start, limit)
        if match is not None and line_intact(match):
            stop = match.end()
            frame = Sentence(match[1].decode(), self._base + start, stop - start)
            return _Candidate(start, stop, stop, None, frame)
        end = _LINE_END.search(buffer, start + 1, limit)
        stop = printed = end.start() if end is not None else limit
        while stop < min(limit, len(buffer), printed + 2) and buffer[stop] == _CR:
            stop += 1
        if stop >= limit:
            waits = len(buffer) < limit
            return _Candidate(start) if waits else _Candidate(start, limit, limit, Cause.TOO_LONG)
        if stop >= len(buffer):
            return _Candidate(start)
        if buffer[stop] == _LF:
            return _Candidate(start, stop + 1, stop + 1, Cause.CHECKSUM)
        return _Candidate(start, stop, stop + 1, Cause.BROKEN)

    # ── bookkeeping ──────────────────────────────────────────────────────────────────────────────

    def _accept(self, frame: Frame) -> None:
        if isinstance(frame, Packet):
            self.counters.packets += 1
            if frame.layout not in self._trusted:
                self._trusted = [*self._trusted[1 - _TRUSTED_LAYOUTS :], frame.layout]
        else:
            self.counters.sentences += 1
        self.counters.valid_bytes += frame.length
        self._synced = True

    def _skip(
        self, buffer: bytes, position: int, until: int, refused: list[tuple[_Candidate, Cause]]
    ) -> None:
        """Skip bytes: those of a refused message up to the next one under its cause."""
        for place, (candidate, cause) in enumerate(refused):
            self._keep(buffer, position, candidate.start, Cause.NOISE)
            stop = refused[place + 1][0].start if place + 1 < len(refused) else until
            if cause not in (Cause.OVERTAKEN, Cause.CUT):
                stop = min(stop, candidate.stop)
            self._keep(buffer, candidate.start, stop, cause)
            self.counters.damage[cause] = self.counters.damage.get(cause, 0) + 1
            if cause is Cause.CHECKSUM and _UNCHECKED.fullmatch(
                buffer, candidate.start, candidate.stop
            ):
                self.counters.unchecked += 1
            position = stop
        self._keep(buffer, position, until, Cause.NOISE)

    def _keep(self, buffer: bytes, start: int, stop: int, cause: Cause) -> None:
        if stop > start:
            self._skipped.append(Skipped(self._base + start, buffer[start:stop], cause))
            self._kept += stop - start
            self.counters.skipped_bytes += stop - start


def _settled(candidates: list[_Candidate], available: int) -> int:
    """Up to where nothing can change any more: where the first candidate that waits begins.

    While it is open whether a byte of a refused packet starts a message, the packet stays whole.
    """
    for place, candidate in enumerate(candidates):
        if candidate.waiting:
            before = candidates[place - 1] if place else candidate
            inside = before.stop > candidate.start and not candidate.recognised
            return before.start if inside else candidate.start
    return available


def _causes(
    candidates: list[_Candidate], now: int, otherwise: Cause
) -> list[tuple[_Candidate, Cause]]:
    """Why each was given up, as known when the buffer had `now` bytes; recognised ones only."""
    refused = []
    for candidate in candidates:
        if candidate.cause is not None and candidate.decided <= now:
            refused.append((candidate, candidate.cause))
        elif candidate.recognised:
            refused.append((candidate, otherwise))
    return refused
