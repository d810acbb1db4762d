"""How much a piece of work asks of the interpreter: calls, the same on every machine.

One version of Python makes the same calls however busy the machine is. Processor time depends on
who else is on the cores, also as a ratio: a small piece keeps its caches where a large one loses
them. The figures in seconds are in `tests/benchmarks`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any


def counted_calls(work: Callable[[], Any]) -> tuple[int, Any]:
    """Calls of Python and of built-in functions that `work()` makes on this thread; its result."""
    count = 0

    def note(_frame: object, event: str, _argument: object) -> None:
        nonlocal count
        if event in ("call", "c_call"):
            count += 1

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        result = work()
    finally:
        sys.setprofile(before)
    return count, result
