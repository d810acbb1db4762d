"""The memory of a run that lasts months: taken at the start, all of it, and then constant.

The histories are bounded, but the longest one takes an hour to fill: the process would grow for
that long, and fail for want of memory far from anybody who could help. So the heap is grown to its
final size and touched before the first sample, and glibc is told to give nothing back. Large
temporaries (the judgement of an hour of evidence) are mapped and unmapped one by one, so they leave
no holes in it.

What must not grow is watched elsewhere: tests/benchmarks/daemon/bench_soak.py counts live bytes.
"""

from __future__ import annotations

import ctypes

from ahrsd.errors import ConfigError
from ahrsd.estimator.parameters import EstimatorParameters

EVIDENCE_BYTES = 20 << 20  # an hour of segments, their tracks, small temporaries, and the holes
STEP_BYTES = 512  # one step of the estimator's window: data, directions, response
_PIECE_BYTES = 64 << 10
_MAPPED_BYTES = 256 << 10  # from this size on a block is mapped separately
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -3, -4, -8
_PAD_BYTES = 64 << 20  # step in which a heap grows that is never given back


def needed_bytes(estimator: EstimatorParameters) -> int:
    """What a run's histories take when they are full."""
    return EVIDENCE_BYTES + STEP_BYTES * estimator.window_steps


def keep_heap() -> bool:
    """Give nothing back, and map nothing by itself: for a command that is soon over.

    Arrays of tens of megabytes come and go by the hundred; mapped anew, each is zeroed by the
    kernel page by page. False, and nothing is done, where the C library is not glibc.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return False
    libc.mallopt(_M_MMAP_MAX, 0)
    libc.mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    libc.mallopt(_M_TOP_PAD, _PAD_BYTES)
    return True


def take_heap(size_bytes: int) -> bool:
    """Grow the heap by this much, for good; call it before threads are started.

    False, and nothing is done, where the C library is not glibc. Raises ConfigError where there is
    not so much.
    """
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return False
    libc.malloc.argtypes, libc.malloc.restype = [ctypes.c_size_t], ctypes.c_void_p
    libc.free.argtypes = [ctypes.c_void_p]
    libc.mallopt(_M_ARENA_MAX, 1)  # else each thread has a heap of its own
    libc.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)
    libc.mallopt(_M_TRIM_THRESHOLD, 1 << 30)
    pieces = [libc.malloc(_PIECE_BYTES) for _ in range(size_bytes // _PIECE_BYTES)]
    try:
        if None in pieces:
            megabytes = size_bytes >> 20
            raise ConfigError(
                [f"estimator.window_steps: its {megabytes} MB of memory are not there; less of it"]
            )
        for piece in pieces:
            ctypes.memset(piece, 0, _PIECE_BYTES)
    finally:
        for piece in pieces:
            libc.free(piece)
    return True
