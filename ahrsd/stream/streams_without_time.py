"""The time of streams that carry none: how often messages come, and what the attitude says.

Registers 6 and 7 are the type and rate of the ASCII message, and of nothing else. A binary output
has its own rate in its own register: 75, 76 or 77 with the same groups and fields, 800 Hz over the
divisor (vn100-protocol 4.4). Two outputs with the same fields and different rates say nothing.

Arrivals say a rate over some seconds only: a USB adapter delivers several messages at once. They
are asked where no register says it, and whether what a register says is what comes (`RateWatch`):
registers may have been changed since they were read, and other models divide another rate. Lost
messages make the mean rate too low; the step between those that came tells (`lost_messages`).

**The device's own attitude.** Between two messages the attitude turns by the vector v = log(R_k^T
R_(k+1)), and the gyro says the mean rate w over the same step; v = w dt. Two things follow:

* The rate (`rate_of`): dt is the slope of v against w. Its median over the pairs that turned enough
  is robust against the attitude filter's corrections, against lost messages and against noise.
* Messages that are missing without a trace in the bytes (`TurnWatch`): a host that reads too slowly
  loses whole lines. One step then turns several times further than the rate can explain. Measured
  on real recordings: 65 such steps in two walks whose logger lost a quarter of the lines, none in
  seven others (tests/stream/test_time_from_attitude.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ahrsd import so3
from ahrsd.samples import Array
from ahrsd.stream.lost_messages import FASTEST, step_of
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.messages import MESSAGES, BinaryLayout, Layout, binary_layout
from drivers.vn100.registers import ASYNC_OUTPUT_RATES_HZ, BINARY_OUTPUTS, SAMPLE_RATE_HZ

# -- Rates by registers and arrivals ---------------------------------------------------------------


RegisterValues = Mapping[int, tuple[float | int | str, ...]]

_TYPE, _RATE = 6, 7
_REGISTER_SNAP = 0.02
_LEAST_ARRIVALS, _MOST_ARRIVALS, _LEAST_SPAN_S = 100, 2000, 2.0
_WATCHED, _WATCHED_S = 100, 4.0
_DIFFERS = 0.15  # an adapter's bunches are far below, another divisor is above
_WINDOWS = 2
_MOST_DIVISOR = 16  # of binary packets; slower ones have rates so close that any one is near
UNSURE = "the mean of arrival times; messages may be missing, as no regular step explains them"
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


def long_enough(arrivals_s: Sequence[float]) -> bool:
    """Whether so many messages arrived over such a time that their rate can be estimated."""
    count = len(arrivals_s)
    span_s = arrivals_s[-1] - arrivals_s[0] if count else 0.0
    if count < _LEAST_ARRIVALS or span_s <= 0.0:
        return False
    return span_s >= _LEAST_SPAN_S or count >= _MOST_ARRIVALS


def rate_of_arrivals(
    layout: Layout, arrivals_s: Sequence[float], lost: Sequence[int], ends: bool = False
) -> tuple[float, str] | None:
    """Hz by the arrivals of messages, and in words whether they are sure of it.

    None while they say too little. A rate that the device offers is taken for it where it is
    within 2 %.

    lost: messages that were lost before each, as far as is known; ends: whether no more come
    """
    if not long_enough(arrivals_s):
        return None
    mean_hz = _mean_rate(arrivals_s, lost)
    step_s, sure = step_of(arrivals_s, lost, _offered_steps(layout, mean_hz))
    if not step_s > 0.0:
        return None
    if not sure and not ends and len(arrivals_s) < _MOST_ARRIVALS:
        return None
    return offered_rate(layout, 1.0 / step_s), "arrival times" if sure else UNSURE


def _mean_rate(arrivals_s: Sequence[float], lost: Sequence[int]) -> float:
    return (len(lost) - 1 + sum(lost[1:])) / (arrivals_s[-1] - arrivals_s[0])


def _offered_steps(layout: Layout, mean_hz: float) -> list[float]:
    """Steps that the device offers for this kind of message, of those near or shorter ones."""
    if not isinstance(layout, BinaryLayout):
        return [1.0 / usual for usual in ASYNC_OUTPUT_RATES_HZ[1:]]
    longest = min(math.ceil(SAMPLE_RATE_HZ / mean_hz) + 1, _MOST_DIVISOR)
    return [n / SAMPLE_RATE_HZ for n in range(max(longest // 2, 1), longest + 1)]


def offered_rate(layout: Layout, rate_hz: float) -> float:
    """The rate that the device offers for this kind of message where it is near, else `rate_hz`."""
    if isinstance(layout, BinaryLayout):
        nearest = SAMPLE_RATE_HZ / max(round(SAMPLE_RATE_HZ / rate_hz), 1)
    else:
        nearest = min(ASYNC_OUTPUT_RATES_HZ[1:], key=lambda usual: abs(usual / rate_hz - 1.0))
    return float(nearest) if abs(nearest / rate_hz - 1.0) < _REGISTER_SNAP else rate_hz


class RateWatch:
    """Whether messages come as often as is believed; see the module."""

    def __init__(self) -> None:
        self._differing: list[float] = []
        self.forget()

    def forget(self) -> None:
        """What follows does not follow on."""
        self._last_s = float("nan")
        self._count = self._same = 0
        self._arrivals: list[float] = []
        self._lost: list[int] = []

    def look(self, arrival_s: float, lost: int, rate_hz: float) -> float | None:
        """One message; the rate at which they come where that is another one, time after time."""
        self._same = self._same + 1 if arrival_s == self._last_s else 0
        if self._same > _STANDS_S * rate_hz or not self._arrivals:
            self.forget()
            self._arrivals.append(arrival_s)
            self._lost.append(0)
            self._last_s = arrival_s
            return None
        self._arrivals.append(arrival_s)
        self._lost.append(lost)
        self._count += lost
        self._last_s = arrival_s
        span_s = arrival_s - self._arrivals[0]
        count = self._count + len(self._arrivals)
        if count < _WATCHED or span_s < _WATCHED_S:
            return None
        comes_hz = (count - 1) / span_s
        if rate_hz / FASTEST < comes_hz < rate_hz * (1.0 - _DIFFERS):  # or some are lost
            step_s, sure = step_of(self._arrivals, self._lost, (1.0 / rate_hz,))
            comes_hz = 1.0 / step_s if sure else rate_hz
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


# -- Time from the attitude ------------------------------------------------------------------------


_SOURCE = "from the device's attitude against its rate"
_LEAST_RATE_RAD_S = 0.1
_MOST_TURNED_RAD = 2.0
_SPAN = 8  # messages per pair: quantisation of the printed angles matters less over several
_LEAST_PAIRS = 200
_PLENTY = 400  # pairs; then nobody needs to read on
_SPREAD = 0.15  # quartiles' distance beyond which the attitude filter is still settling
_LEAST_STRONG, _STRONG = 20, 0.99  # fewer pairs will do where they lie on one line, so correlated
_CHECK_MESSAGES = 2000
_WANTED_MESSAGES = 32000
_USUAL_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 80, 100, 200, 400, 800)
_ATTITUDE_SNAP = 0.04
_MISSING_RAD, _MISSING_RATIO = 0.015, 2.5  # a step that turned further than the rate says, by both
_LONGEST_LOSS_S = 10.0
_SPEED_S = 1.0  # memory of the speed of turning, which says how long a loss was
_ATTITUDE = ("yaw_rad", "pitch_rad", "roll_rad")
_GYROS = tuple(tuple(f"{name}_{a}_rad_s" for a in "xyz") for name in ("gyro", "uncomp_gyro"))


def attitude_columns(layout: Layout) -> list[int] | None:
    """Where yaw, pitch, roll and the rate are in a message, six numbers; None without them."""
    names = [column.name for column in layout.columns]
    for gyro in _GYROS:
        wanted = (*_ATTITUDE, *gyro)
        if all(name in names for name in wanted):
            return [names.index(name) for name in wanted]
    return None


def rate_from_attitude(
    ypr_rad: Array, gyro_rad_s: Array, least: int = _LEAST_PAIRS
) -> float | None:
    """Hz of a stream of (N, 3) yaw, pitch, roll and (N, 3) rates; None where too little turned.

    A rate within 4 % of one that the device offers is that rate.
    """
    R = so3.from_yaw_pitch_roll(*ypr_rad.T)
    dt_s = _median_step(R, gyro_rad_s, least)
    if dt_s is None and least == _LEAST_PAIRS:
        dt_s = _strong_step(R, gyro_rad_s)
    if dt_s is None or not dt_s > 0.0:
        return None
    hz = 1.0 / dt_s
    nearest = min(_USUAL_HZ, key=lambda usual: abs(np.log(usual / hz)))
    return float(nearest) if abs(nearest / hz - 1.0) < _ATTITUDE_SNAP else hz


def _median_step(R: Array, rate: Array, least: int) -> float | None:
    """Seconds per message where plenty turned."""
    if len(R) < least + _SPAN:
        return None
    v = so3.log(np.swapaxes(R[:-_SPAN], 1, 2) @ R[_SPAN:])
    middle = (rate[1:] + rate[:-1]) / 2
    w = np.lib.stride_tricks.sliding_window_view(middle, _SPAN, axis=0).mean(axis=2)
    speed = np.linalg.norm(w, axis=1)
    good = (speed > _LEAST_RATE_RAD_S) & (np.linalg.norm(v, axis=1) < _MOST_TURNED_RAD)
    if np.count_nonzero(good) < least:
        return None
    steps = np.sum(v * w, axis=1)[good] / speed[good] ** 2 / _SPAN
    low, middle_s, high = np.percentile(steps, (25, 50, 75))
    return float(middle_s) if high - low < _SPREAD * middle_s else None


def _strong_step(R: Array, rate: Array) -> float | None:
    """The same where little turned, but what did lies on one line (a bias taken off).

    The rate of a message is taken as the mean over the step that ends there: over few large steps
    that fits to 0.998 on the recording with binary packets, the mean of both ends to 0.97.
    """
    if len(R) < _LEAST_PAIRS:
        return None
    v = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])
    w = rate[1:] - np.median(rate, axis=0)
    if np.count_nonzero(np.linalg.norm(w, axis=1) > _LEAST_RATE_RAD_S) < _LEAST_STRONG:
        return None
    vv, vw, ww = np.sum(v * v), np.sum(v * w), np.sum(w * w)
    return float(vw / ww) if vw > _STRONG * np.sqrt(vv * ww) else None


def rate_of(chunks: Iterable[bytes]) -> tuple[float, str] | None:
    """Rate and how it was found, for bytes whose messages carry attitude, rate and no time.

    None where the messages carry time, or too little turned. Reads no further than it must.
    """
    deframer = Deframer()
    rows: list[list[float]] = []
    layout: Layout | None = None
    columns: list[int] | None = None
    check = _CHECK_MESSAGES
    for chunk in chunks:
        for frame in deframer.feed(chunk):
            event = decode(frame)
            if not isinstance(event, Measurement):
                continue
            if columns is None:
                if any(column.name == "time_startup_s" for column in event.layout.columns):
                    return None
                columns, layout = attitude_columns(event.layout), event.layout
            if columns is not None and event.layout is layout:
                rows.append([event.values[k] for k in columns])
        if len(rows) >= check:
            if (rate := _rate(rows, _PLENTY)) is not None:
                return rate, _SOURCE
            check *= 2
        if len(rows) >= _WANTED_MESSAGES:
            break
    rate = _rate(rows, _LEAST_PAIRS)
    return None if rate is None else (rate, _SOURCE)


def _rate(rows: list[list[float]], least: int) -> float | None:
    if not rows:
        return None
    table = np.array(rows)
    table = table[np.isfinite(table).all(axis=1)]
    return rate_from_attitude(table[:, :3], table[:, 3:], least) if len(table) else None


class TurnWatch:
    """Sees where messages are missing; see the module. What it says does not depend on chunks."""

    def __init__(self) -> None:
        self.places = 0
        self.missing = 0
        self._last: Array | None = None
        self._speed_rad_s = 0.0

    def forget(self) -> None:
        """The next message does not follow the last one."""
        self._last = None

    def look(
        self,
        ypr_rad: Array,
        gyro_rad_s: Array,
        step_s: float,
        known: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.int64]:
        """Estimated numbers of messages (N,) that are missing before each of N messages.

        known: (N,) true where it is known how many are missing; nothing is estimated there
        """
        table = np.hstack([ypr_rad, gyro_rad_s])
        if self._last is None:
            self._last = table[0]
        table = np.concatenate([self._last[None], table])
        self._last = table[-1]
        speed = np.sqrt(np.sum(table[:, 3:] ** 2, axis=1))
        said = np.maximum(speed[1:], speed[:-1]) * step_s
        turned = _at_most(table[:, :3])
        if _jumps(turned, said).any():  # hardly ever: then look closely
            turned = _turned(table[:, :3])
        found = np.zeros(len(said), dtype=np.int64)
        jumps = _jumps(turned, said)
        if known is not None:
            jumps &= ~known
        weight = min(step_s / _SPEED_S, 1.0)
        for k, (now, jumped) in enumerate(zip(speed[1:].tolist(), jumps.tolist(), strict=True)):
            if math.isfinite(now):
                self._speed_rad_s += weight * (now - self._speed_rad_s)
            if jumped:
                steps = turned[k] / max(self._speed_rad_s * step_s, 1e-9)
                found[k] = max(1, round(min(steps, _LONGEST_LOSS_S / step_s)) - 1)
        self.places += int(np.count_nonzero(found))
        self.missing += int(found.sum())
        return found


def _jumps(turned: Array, said: Array) -> NDArray[np.bool_]:
    """Where a step turned further than the rate explains."""
    return (turned - said > _MISSING_RAD) & (turned > _MISSING_RATIO * said)


def _at_most(ypr_rad: Array) -> Array:
    """A bound of `_turned` that is cheap: the three angles' changes, one after the other."""
    change = np.abs(ypr_rad[1:] - ypr_rad[:-1])
    return np.asarray(np.minimum(change, 2.0 * np.pi - change).sum(axis=1))


def _turned(ypr_rad: Array) -> Array:
    """Angles (N - 1,) between neighbours of (N, 3) attitudes."""
    R = so3.from_yaw_pitch_roll(*ypr_rad.T)
    trace = np.einsum("nij,nij->n", R[:-1], R[1:])  # of R_k^T R_(k+1): 1 + 2 cos(angle)
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))
