"""How often messages without a time come: what the registers say, and what the arrivals say.

Registers 6 and 7 are the type and rate of the ASCII message, and of nothing else. A binary output
has its own rate in its own register: 75, 76 or 77 with the same groups and fields, 800 Hz over the
divisor (vn100-protocol 4.4). Two outputs with the same fields and different rates say nothing.

Arrivals say a rate over some seconds only: a USB adapter delivers several messages at once. They
are asked where no register says it, and whether what a register says is what comes (`RateWatch`):
registers may have been changed since they were read, and other models divide another rate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from drivers.vn100.binary import BinaryLayout, binary_layout
from drivers.vn100.fields import Layout
from drivers.vn100.registers import ASYNC_OUTPUT_RATES_HZ, BINARY_OUTPUTS, SAMPLE_RATE_HZ
from drivers.vn100.sentences import MESSAGES

RegisterValues = Mapping[int, tuple[float | int | str, ...]]

_TYPE, _RATE = 6, 7
_SNAP = 0.02
_LEAST_ARRIVALS, _MOST_ARRIVALS, _LEAST_SPAN_S = 100, 2000, 2.0
_WATCHED, _WATCHED_S = 100, 4.0
_DIFFERS = 0.15  # an adapter's bunches are far below, another divisor is above
_WINDOWS = 2
_STANDS_S = 1.0  # so much time of messages with one stamp: the host's clock stands


def rate_by_registers(layout: Layout, registers: RegisterValues) -> tuple[float, str] | None:
    """Hz of the messages of this layout, and which register says it; None where none does."""
    if isinstance(layout, BinaryLayout):
        return _binary_rate(layout, registers)
    message, kind, rate = MESSAGES.get(layout.name), registers.get(_TYPE), registers.get(_RATE)
    if message is None or not rate or not _number(rate[0]) > 0:
        return None
    if kind and kind[0] != message.output_type:
        return None
    return _number(rate[0]), f"register {_RATE}"


def _binary_rate(layout: BinaryLayout, registers: RegisterValues) -> tuple[float, str] | None:
    found: dict[float, str] = {}
    for number in BINARY_OUTPUTS:
        mode, divisor, groups, *words = registers.get(number, (0, 0, 0))
        if not (_number(mode) and _number(divisor) > 0 and _number(groups)):
            continue
        try:
            own = binary_layout(int(groups), [int(word) for word in words])
        except ValueError:
            continue  # no layout that could have been read
        if own is layout:
            said = f"register {number}: {SAMPLE_RATE_HZ} Hz / {divisor}"
            found.setdefault(SAMPLE_RATE_HZ / _number(divisor), said)
    return next(iter(found.items())) if len(found) == 1 else None


def _number(value: float | str) -> float:
    return 0.0 if isinstance(value, str) else float(value)


def rate_of_arrivals(
    layout: Layout, arrivals_s: Sequence[float], lost: Sequence[int]
) -> float | None:
    """Hz by a line through the arrivals of messages; None while they say too little.

    lost: messages that were lost before each. A rate that the device offers is taken for it where
    it is within 2 %.
    """
    count = len(arrivals_s)
    span_s = arrivals_s[-1] - arrivals_s[0] if count else 0.0
    if count < _LEAST_ARRIVALS or span_s <= 0.0:
        return None
    if span_s < _LEAST_SPAN_S and count < _MOST_ARRIVALS:
        return None
    number = np.cumsum(1.0 + np.asarray(lost, dtype=np.float64))
    number -= number.mean()
    step_s = float(number @ np.asarray(arrivals_s) / (number @ number))
    return offered_rate(layout, 1.0 / step_s) if step_s > 0.0 else None


def offered_rate(layout: Layout, rate_hz: float) -> float:
    """The rate that the device offers for this kind of message where it is near, else `rate_hz`."""
    if isinstance(layout, BinaryLayout):
        nearest = SAMPLE_RATE_HZ / max(round(SAMPLE_RATE_HZ / rate_hz), 1)
    else:
        nearest = min(ASYNC_OUTPUT_RATES_HZ[1:], key=lambda usual: abs(usual / rate_hz - 1.0))
    return float(nearest) if abs(nearest / rate_hz - 1.0) < _SNAP else rate_hz


class RateWatch:
    """Whether messages come as often as is believed; see the module."""

    def __init__(self) -> None:
        self._differing: list[float] = []
        self.forget()

    def forget(self) -> None:
        """What follows does not follow on."""
        self._first_s = self._last_s = float("nan")
        self._count = self._same = 0

    def look(self, arrival_s: float, lost: int, rate_hz: float) -> float | None:
        """One message; the rate at which they come where that is another one, time after time."""
        self._same = self._same + 1 if arrival_s == self._last_s else 0
        if self._same > _STANDS_S * rate_hz or not self._count:
            self.forget()
            self._first_s = self._last_s = arrival_s
            self._count = 1
            return None
        self._count += 1 + lost
        self._last_s = arrival_s
        span_s = arrival_s - self._first_s
        if self._count < _WATCHED or span_s < _WATCHED_S:
            return None
        comes_hz = (self._count - 1) / span_s
        self.forget()
        if abs(comes_hz / rate_hz - 1.0) < _DIFFERS:
            self._differing.clear()
            return None
        self._differing.append(comes_hz)
        if len(self._differing) < _WINDOWS:
            return None
        mean_hz = sum(self._differing) / _WINDOWS
        self._differing.clear()
        return mean_hz
