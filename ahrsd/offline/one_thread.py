"""The library's own entry points compute on one thread, as the command line does.

The matrices are small: with a thread for each core OpenBLAS spends up to six times the processor
time, and the last digits change from run to run. Who sets OPENBLAS_NUM_THREADS decides.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_one_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function, which meanwhile holds BLAS to one thread."""

    @wraps(function)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if "OPENBLAS_NUM_THREADS" in os.environ:
            return function(*args, **kwargs)
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
