"""The lines of the socket: one JSON object a line, both ways.

    {"ask": "status"}                                one answer, `ahrsd.status/1`
    {"ask": "explain"}                               one answer, `ahrsd.explain/1`
    {"ask": "watch", "of": ["status", "events"]}     records until the client goes

Every record that is watched has a `seq`; where a slow reader lost some, a `gap` record says which.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

SCHEMA: Final = "ahrsd.socket/1"
STATUS_SCHEMA: Final = "ahrsd.status/1"
STREAMS: Final = ("status", "events", "samples")
ASKS: Final = ("status", "explain", "watch")
LONGEST_REQUEST: Final = 4096


@dataclass(frozen=True, slots=True)
class SocketRequest:
    """What a client wants; `streams` is empty but for `watch`."""

    ask: str
    streams: frozenset[str] = frozenset()


class BadRequest(ValueError):
    """A line that is no request; the text says what is wrong and what is allowed."""


def parse_request(line: bytes) -> SocketRequest:
    """A request out of one line. Raises BadRequest, and nothing else on any bytes."""
    try:
        body = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"not a JSON object: {str(error)[:80]}") from None
    if not isinstance(body, dict):
        raise BadRequest('not a JSON object, such as {"ask": "status"}')
    ask = body.get("ask")
    if ask not in ASKS:
        raise BadRequest(f"ask = {str(ask)[:40]!r}: must be one of {', '.join(ASKS)}")
    if ask != "watch":
        return SocketRequest(ask)
    of = body.get("of", ["status", "events"])
    if not isinstance(of, list) or not of or not all(isinstance(one, str) for one in of):
        raise BadRequest(f"of: must be a list of {', '.join(STREAMS)}")
    if wrong := sorted(set(of) - set(STREAMS)):
        raise BadRequest(f"of: {wrong[0][:40]!r} is none of {', '.join(STREAMS)}")
    return SocketRequest(ask, frozenset(of))


def line_of(body: Mapping[str, object]) -> bytes:
    """One JSON line; numbers that are not finite become null, because JSON has none."""
    return json.dumps(plain(body), separators=(",", ":"), allow_nan=False).encode() + b"\n"


def plain(value: object) -> object:
    """The same with null for numbers that are not finite, lists for arrays and tuples."""
    if isinstance(value, bool | str | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Sequence):
        return [plain(one) for one in value]
    raise TypeError(f"{type(value).__name__} does not go into JSON")
