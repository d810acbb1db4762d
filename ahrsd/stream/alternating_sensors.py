"""Messages or rows of several sensors in turn: the field jumps each time and comes back."""

from __future__ import annotations

import numpy as np

from ahrsd.printable import counted
from ahrsd.samples import Array

_MOST_SENSORS = 8
_APART = 5.0  # times the step between readings of one sensor


def describe_alternation(field_gauss: Array) -> str:
    """In words, where the field (N, 3) is the same again after a few rows, and not in between.

    Without anything that tells the sensors apart it may be one sensor near a current, too. Empty
    where it is not so.
    """
    jump = float(np.median(np.linalg.norm(np.diff(field_gauss, axis=0), axis=1)))
    for count in range(2, _MOST_SENSORS + 1):
        again = np.median(np.linalg.norm(field_gauss[count:] - field_gauss[:-count], axis=1))
        if jump > _APART * again:
            return (
                f"the field jumps by {1e3 * jump:.3g} mG from row to row and is the same again "
                f"after {counted(count, 'row')}: these are the rows of "
                f"{counted(count, 'sensor')} in turn, of which only one may be kept, or an "
                "alternating current is near"
            )
    return ""
