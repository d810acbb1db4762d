"""What a recording may be at most.  Sizes are compared with these before anything is allocated.

Beyond them a file ends in one line that names the limit (docs/guide/recordings.md has them, too).
Whatever is computed of one takes one thread.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

from ahrsd.errors import RecordingError

_P = ParamSpec("_P")
_R = TypeVar("_R")

TABLE_BYTES = 512 * 1024**2  # of text, unpacked
TABLE_COLUMNS = 1000
TABLE_ROWS = 5_000_000  # 35 hours at 40 Hz, 7 hours at 200 Hz
TABLE_CELLS = 64_000_000  # numbers that are kept: 512 MB
HEADER_BYTES = 1024**2  # within which a table's column names must end
SPAN_S = 366 * 86400.0  # from the first to the last row, pauses shortened
STREAM_BYTES = 8 * 1024**3  # of a byte stream, unpacked: 4 days at 230,400 baud
GARBAGE_BYTES = 16 * 1024**2  # without one message, after which a stream is given up
BLOCK_BYTES = 64 * 1024**2  # of a capture, unpacked; ours have 256 KiB and one record


def refuse_beyond(path: object, count: float, limit: float, what: str, remedy: str) -> None:
    """Raise RecordingError where there are more than `limit` of `what`."""
    if count > limit:
        raise RecordingError(path, f"has {count:,.0f} {what}; the limit is {limit:,.0f}", remedy)


def on_one_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function, which meanwhile holds BLAS to one thread, as the command line does.

    The matrices are small: with a thread for each core OpenBLAS spends up to six times the
    processor time, and the last digits change from run to run. Who sets OPENBLAS_NUM_THREADS
    decides.
    """

    @wraps(function)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if "OPENBLAS_NUM_THREADS" in os.environ:
            return function(*args, **kwargs)
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
