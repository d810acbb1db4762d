"""Messages to raw samples: one stream, its clock, its gaps, the registers that were in force.

Rows of one layout are collected until a quarter of a second is together, at least four (by count,
so that the blocks do not depend on how the bytes were cut), then turned into arrays at once.

Time of a sample: the device's own TimeStartup where the message carries it; else steps of one over
the rate. Damaged messages, steps over which the device turned further than its rate can explain
(`TurnWatch`), and those whose absence shows in the arrivals of the others (`LostMessages`) count as
lost messages then, so that nothing is bridged.
The rate of such a stream is what the caller says, else what the register of this very output says
(`streams_without_time`), else what the arrival times say, else the factory's 40 Hz. Where messages
come at another rate than a register says, time after time, the arrivals are right.

How the bytes were cut into chunks changes nothing: everything here goes by the messages and by the
damage in front of each, never by what else came with them.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.evidence.values import HealthFacts
from ahrsd.printable import counted
from ahrsd.samples import Array, SampleBlock
from ahrsd.stream.alternating_sensors import describe_alternation
from ahrsd.stream.decompensation import (
    Extracted,
    Extractor,
    MissingQuantityError,
    RegisterEpochs,
    RegisterValues,
    sample_blocks,
)
from ahrsd.stream.device_clock import DeviceClock, Gap, StepClock, StreamTimeline, TimelineSteps
from ahrsd.stream.lost_messages import LostMessages
from ahrsd.stream.streams_without_time import (
    RateWatch,
    TurnWatch,
    attitude_columns,
    long_enough,
    offered_rate,
    rate_by_registers,
    rate_of_arrivals,
)
from drivers.vn100.decode import Measurement
from drivers.vn100.deframer import REJECTIONS, Cause, Skipped
from drivers.vn100.messages import BinaryLayout, Layout


class Parts:
    """Two outputs with a part each, the field in one and the rates in the other, as one message.

    They belong together by the device's time, which both carry. There is one row for each message
    with rates; a field that comes more seldom is the last one until the next. A row waits for the
    next message, as the field of the same instant may come behind its rates.
    """

    def __init__(self) -> None:
        self.layout: Layout | None = None
        self._of: dict[str, Layout] = {}
        self._field: Measurement | None = None
        self._rates: tuple[Measurement, float] | None = None
        self._taken: list[int] = []  # columns of the rates' message that the field's has not

    def offer(self, layout: Layout, missing: str) -> None:
        """A kind of message that lacks one sensor; with one that lacks the other it is whole."""
        names = [column.name for column in layout.columns]
        if _TIME not in names or missing in self._of:
            return
        self._of[missing] = layout
        if len(self._of) < len(_PARTS):
            return
        field, rates = (self._of[lacking] for lacking in _PARTS)
        held = {column.name for column in field.columns}
        self._taken = [k for k, column in enumerate(rates.columns) if column.name not in held]
        columns = field.columns + tuple(rates.columns[k] for k in self._taken)
        self.layout = Layout(f"{field.name} + {rates.name}", columns)

    def forget(self) -> None:
        """What follows does not follow on."""
        self._field = self._rates = None

    def take(self, measurement: Measurement, host_s: float) -> tuple[Measurement, float] | None:
        """One message; the row that is whole by it, and when its rates arrived."""
        if self.layout is None:
            return None
        if measurement.layout is self._of[_PARTS[0]]:
            at_once = self._rates is not None and _time(measurement) <= _time(self._rates[0])
            row = None if at_once else self._row()
            self._field = measurement
            return self._row() if at_once else row
        if measurement.layout is self._of[_PARTS[1]]:
            row = self._row()
            self._rates = (measurement, host_s)
            return row
        return None

    def _row(self) -> tuple[Measurement, float] | None:
        """The rates that wait, with the newest field."""
        field, rates, self._rates = self._field, self._rates, None
        if field is None or rates is None or self.layout is None:
            return None
        message, host_s = rates
        place = field.layout.index(_TIME)
        values = list(field.values) + [message.values[k] for k in self._taken]
        values[place or 0] = _time(message)
        return Measurement(self.layout, tuple(values), message.offset), host_s


def _time(measurement: Measurement) -> float:
    place = measurement.layout.index(_TIME)
    return measurement.values[place] if place is not None else float("nan")


@dataclass(slots=True)
class StreamFacts:
    """Counters of a stream.

    unusable: samples that were saturated or not finite
    damaged:  messages that were recognised and refused
    expected: samples that would be there had none been lost
    duration_s: steps and gaps together; time of which nobody knows the length is not in it
    """

    samples: int = 0
    unusable: int = 0
    damaged: int = 0
    expected: float = 0.0
    duration_s: float = 0.0
    layout: str = ""
    rate_hz: float = float("nan")
    rate_source: str = ""


class Gaps:
    """Gaps in order. keep: how many of the first and how many of the newest stay; None: all.

    count, length_s: of every gap, also of those that were let go
    """

    def __init__(self, keep: int | None = None) -> None:
        self.keep = keep
        self.count = 0
        self.length_s = 0.0
        self._first: list[Gap] = []
        self._newest: deque[Gap] = deque(maxlen=keep)

    def add(self, gap: Gap) -> None:
        """One more."""
        self.count += 1
        self.length_s += gap.length_s
        first = self.keep is None or len(self._first) < self.keep
        (self._first if first else self._newest).append(gap)

    @property
    def kept(self) -> list[Gap]:
        """Those that stay, oldest first."""
        return [*self._first, *self._newest]


FACTORY_RATE_HZ = 40.0
_TIME = "time_startup_s"
_PARTS = ("gyroscope", "magnetometer")  # what the message with the field lacks, and the other one
_BLOCK_S, _LEAST_ROWS, _MOST_ROWS = 0.25, 4, 256
_PAUSE_S, _PAUSE_STEPS = 0.5, 4.0  # arrivals apart by both: something was not sent or not heard
_LONGEST_PAUSE_S = (
    60.0  # a longer one may be the host's clock that was set: its length says nothing
)
_FIRST = 200  # samples that are checked for two devices in turn
_WARNED_SHARE = (
    1e-3  # of the messages; when fewer are missing by their arrivals there is no warning
)
_MESSAGE_BYTES = 120  # of $VNYMR: how many messages a longer piece of damage was
_GARBAGE_BYTES = 60  # of no text; less may have come between two whole messages
_MOST_NAMES = 64  # of messages; no VN-100 sends so many, but a damaged wire may now and then
OTHERS = "others"
_GONE = 400  # messages of other layouts without one of the stream's own
_FEW_PLACES = 3  # a jump of the device's own attitude now and then is not worth a warning


class NoSamplesError(ValueError):
    """Messages came, and none that anything can be calibrated from."""


class Stream:
    """Measurements in, `SampleBlock`s out; time is an argument, nothing is read or written.

    keep_gaps: as in `Gaps`
    """

    def __init__(
        self,
        epochs: RegisterEpochs,
        rate_hz: float | None = None,
        rate_source: str = "as given",
        *,
        keep_gaps: int | None = None,
    ) -> None:
        self.epochs = epochs
        self.clock = DeviceClock()
        self.facts = StreamFacts()
        self.all_gaps = Gaps(keep_gaps)
        self.by_layout: Counter[str] = Counter()
        self.warnings: dict[str, None] = {}
        self.refused: dict[str, MissingQuantityError] = {}
        self.not_used: dict[str, None] = {}
        self._not_used_said = ""
        self.registers: RegisterValues = {}
        self._said_rate_hz, self._said_source = rate_hz, rate_source
        self._extractor: Extractor | None = None
        self._timeline = StreamTimeline()
        self._steps: StepClock | None = None
        self._rows: list[tuple[float, ...]] = []
        self._arrivals: list[float] = []
        self._lost: list[int] = []
        self._lost_next = self._others = 0
        self._want = 1
        self._arrived_s = 0.0
        self._forgiven = False
        self._replaced = self._left_out = False
        self._attitude: list[int] | None = None
        self._turns = TurnWatch()
        self._turns_said = self._rate_warned = ""
        self._watch = RateWatch()
        self._lost_messages, self._lost_messages_warning = LostMessages(), ""
        self._waiting: tuple[list[tuple[float, ...]], list[float], list[int]] = ([], [], [])
        self._parts = Parts()
        self._first: list[Array] = []
        self._first_count = 0
        self._given_s: float | None = None
        self._given_steps, self._given_step_s, self._excused = 0, 0.0, 0

    @property
    def gaps(self) -> list[Gap]:
        """The gaps that are kept; `all_gaps` counts every one."""
        return self.all_gaps.kept

    @property
    def restarts(self) -> int:
        """How often the device's time fell."""
        return self._timeline.restarts

    def excuse_restart(self) -> None:
        """A program requested the newest restart: it is no sign of a device in trouble."""
        self._excused += 1

    @property
    def newest_s(self) -> float | None:
        """The device's newest time, also of a message that nobody could un-map."""
        return self._timeline.newest_s

    @property
    def carries_time(self) -> bool:
        """Whether the messages have the device's own time."""
        return self._extractor is not None and self._extractor.has_time

    @property
    def compensated_mag(self) -> bool:
        """Whether only the compensated field is in the stream."""
        return self._extractor is not None and self._extractor.mag_compensated

    @property
    def compensated_gyro(self) -> bool:
        """Whether only the compensated rate is in the stream."""
        return self._extractor is not None and self._extractor.gyro_compensated

    def lost(self, messages: int) -> None:
        """So many messages are missing before the next one."""
        self._lost_next += messages

    def damaged(self, piece: Skipped) -> None:
        """Bytes before the next message that were none; other devices' lines are no loss."""
        self.facts.damaged += piece.cause in REJECTIONS
        size, noise = len(piece.data), piece.cause is Cause.NOISE
        if not noise or (size >= _GARBAGE_BYTES and not piece.data.isascii()):
            tail = noise and self._lost_next > 0  # of a message that was counted
            self.lost(size // _MESSAGE_BYTES if tail else max(1, round(size / _MESSAGE_BYTES)))

    def unused(self, name: str) -> None:
        """A whole message of another model, or one with nothing that a VN-100 measures: no loss."""
        self._count(name)
        if name not in self.not_used and len(self.not_used) < _MOST_NAMES:
            self.not_used[name] = None
            told = ", ".join(self.not_used)
            self.warnings.pop(self._not_used_said, None)
            self._not_used_said = f"in the stream, but no message of a VN-100 and not used: {told}"
            self.warnings[self._not_used_said] = None

    def undecodable(self) -> None:
        """A message with a right checksum whose content is none."""
        self.facts.damaged += 1
        self.lost(1)

    def forget(self) -> None:
        """The link was away, or the output was changed: what follows does not follow on.

        It may be another message, and a worse one: a device that restarted, or another device.
        """
        self._extractor = None
        self._clear()
        self._cut()

    def _cut(self) -> None:
        self._timeline.forget()
        self._parts.forget()
        self._turns.forget()
        self._watch.forget()
        self._lost_messages.forget()
        self._arrived_s = 0.0
        if self._steps is not None:  # counted time stood still meanwhile and the host's did not
            self.clock = DeviceClock()
        self._lost_next = max(self._lost_next, 1)

    def forgive(self) -> None:
        """The output is about to be paused by us: the next gap is no loss of the link's."""
        self._forgiven = True

    def take(self, measurement: Measurement, host_s: float) -> list[SampleBlock]:
        """One message that arrived at host_s (0 for a recording without host time)."""
        layout = measurement.layout
        extractor = self._extractor
        if extractor is not None and layout is extractor.layout:
            self.by_layout[layout.name] += 1
            self._others = 0
        else:
            self._count(layout.name)
            extractor = self._accept(measurement)
            if extractor is None:
                whole = self._parts.take(measurement, host_s)
                extractor = None if whole is None else self._joined(whole[0].layout)
                if whole is None or extractor is None:
                    return []
                measurement, host_s = whole
        before = [] if extractor.has_time else self._look_at_arrival(host_s)
        self._rows.append(measurement.values)
        self._arrivals.append(host_s)
        self._lost.append(self._lost_next)
        self._lost_next = 0
        if len(self._rows) < self._want:
            return before
        self._want = self._wanted(extractor)
        return before + self._turn(ends=False) if len(self._rows) >= self._want else before

    def _look_at_arrival(self, host_s: float) -> list[SampleBlock]:
        """What an arrival says of a stream without time: a pause, and whether the rate is right.

        The samples before a pause whose length nobody knows.
        """
        before_s, self._arrived_s = self._arrived_s, host_s
        if before_s <= 0.0:
            return []
        step_s, pause_s = self._step_s(), host_s - before_s
        if pause_s > max(_PAUSE_S, _PAUSE_STEPS * step_s):
            self._watch.forget()
            if self._steps is None:
                self._clear()  # these arrivals and those to come are not on one line
            elif pause_s > _LONGEST_PAUSE_S:
                blocks = self._turn(ends=True)
                self._lost_messages.forget()
                self.lost(1)
                return blocks
        elif self._steps is not None and self._said_rate_hz is None:
            comes_hz = self._watch.look(host_s, self._lost_next, self.facts.rate_hz)
            if comes_hz is not None:
                self._correct_rate(comes_hz)
        return []

    def _step_s(self) -> float:
        """Seconds between messages as far as is known; infinite where nothing is."""
        if self._steps is not None:
            return self._steps.step_s
        if len(self._arrivals) < _LEAST_ROWS:
            return np.inf
        return (self._arrivals[-1] - self._arrivals[0]) / (len(self._arrivals) - 1)

    def _correct_rate(self, comes_hz: float) -> None:
        """The arrivals contradict the rate: what was collected by it is forgotten."""
        assert self._extractor is not None
        assert self._steps is not None
        layout, believed = self._extractor.layout, self.facts.rate_source
        rate_hz = offered_rate(layout, comes_hz)
        since_s, was_hz = self._steps.now_s, self.facts.rate_hz
        self._clear()
        self._decide(rate_hz, f"arrival times; {believed} said {was_hz:.4g} Hz")
        self._steps = StepClock(rate_hz, since_s)
        self._cut()
        facts, self._turns, self.all_gaps = self.facts, TurnWatch(), Gaps(self.all_gaps.keep)
        self._lost_messages = LostMessages()
        self.warnings.pop(self._turns_said, None)
        self.warnings.pop(self._lost_messages_warning, None)
        facts.expected, facts.duration_s = float(facts.samples), facts.samples / rate_hz
        self._replaced = facts.samples > 0

    def _count(self, name: str) -> None:
        """One message; a name too many is one of the `OTHERS`."""
        known = name in self.by_layout or len(self.by_layout) < _MOST_NAMES
        self.by_layout[name if known else OTHERS] += 1

    def _accept(self, measurement: Measurement) -> Extractor | None:
        """The first layout that has what is needed is the stream.

        A better one replaces it, and any other one where it is gone: somebody changed the output.
        """
        layout = measurement.layout
        if layout.name in self.refused:
            return None
        try:
            new = Extractor(layout)
        except MissingQuantityError as error:
            if len(self.refused) < _MOST_NAMES:
                self.refused[layout.name] = error
            self._parts.offer(layout, error.quantity)
            return None
        old = self._extractor
        if old is not None:
            self._others += 1
            if not (new.better_than(old) or self._others >= _GONE):
                return None
            self._replace(old, new)
        self._extractor, self._others = new, 0
        if new.has_time:
            self._steps = None  # the rate of what came before says nothing
        self._clear()
        self._attitude = None if new.has_time else attitude_columns(layout)
        self.facts.layout = layout.name
        self.warnings.update(dict.fromkeys(new.warnings))
        if isinstance(layout, BinaryLayout) and layout.left_out:
            fields = ", ".join(dict.fromkeys(layout.left_out))
            self.warnings[f"{layout.name}: skipped, as no VN-100 measures it: {fields}"] = None
        self._cut()
        return new

    def _joined(self, layout: Layout) -> Extractor | None:
        """Of rows that two outputs make together, unless one output alone has all."""
        old = self._extractor
        if old is None:
            self._extractor = old = Extractor(layout)
            self.facts.layout, self._steps, self._attitude = layout.name, None, None
            field, rates = layout.name.split(" + ")
            self.warnings[
                f"the field comes in {field} and the rates in {rates}: matched by their time"
            ] = None
            self.warnings.update(dict.fromkeys(old.warnings))
        return old if old.layout is layout else None

    def _replace(self, old: Extractor, new: Extractor) -> None:
        """Other quantities begin: what the old message gave must not mix with them."""
        if old.quantities == new.quantities:
            return
        for text in [text for text in self.warnings if text.startswith(old.layout.name)]:
            del self.warnings[text]
        self.warnings[f"{old.layout.name} was left out when {new.layout.name} began"] = None
        self._replaced = self.facts.samples > 0

    def take_replaced(self) -> bool:
        """Whether blocks from now on hold other quantities than those before; true once."""
        replaced, self._replaced = self._replaced, False
        return replaced

    def _clear(self) -> None:
        self._rows.clear()
        self._arrivals.clear()
        self._lost.clear()
        self._want = 1

    def _wanted(self, extractor: Extractor) -> int:
        """Rows of the next block, as known now; asked only when the last answer is reached."""
        if extractor.has_time:
            period = self._timeline.period_s
            return 16 if not np.isfinite(period) else _rows(1.0 / period)
        if self._steps is None and self._rate() is None:
            rows = len(self._rows)
            return rows + (rows // 4 if long_enough(self._arrivals) else 1)
        rate = self.facts.rate_hz
        return _rows(rate) if np.isfinite(rate) else 1

    def _rate(self, ends: bool = False) -> float | None:
        """Rate of a stream without device time, None while it must still be watched.

        ends: whether no more of it comes
        """
        said = self._said_rate_hz
        if said is not None:
            return self._decide(said, self._said_source)
        assert self._extractor is not None
        layout = self._extractor.layout
        if (found := rate_by_registers(layout, self.registers)) is not None:
            return self._decide(*found)
        if not self._arrivals or self._arrivals[-1] == 0.0:
            return self._decide(FACTORY_RATE_HZ, "assumed: the factory's rate")
        if self.epochs.now.compensation is None:
            return None  # the registers may yet be read
        arrived = rate_of_arrivals(layout, self._arrivals, self._lost, ends)
        return None if arrived is None else self._decide(*arrived)

    def _decide(self, rate_hz: float, source: str) -> float:
        self.facts.rate_hz, self.facts.rate_source = rate_hz, source
        self.warnings.pop(self._rate_warned, None)
        self._rate_warned = (
            f"{self.facts.layout} carries no time: {rate_hz:.4g} Hz ({source}); "
            "a wrong rate makes the gyro bias and the weights wrong; --rate sets that of a "
            "recording, device.configure_stream asks a device for packets with their time"
        )
        self.warnings[self._rate_warned] = None
        self._steps = StepClock(rate_hz)
        return rate_hz

    def flush(self) -> list[SampleBlock]:
        """Turn what is collected into blocks now (registers change, the link goes, the end)."""
        return self._turn(ends=True)

    def _turn(self, ends: bool) -> list[SampleBlock]:
        """The same of what can be judged; ends: all of it, whatever would come behind."""
        extractor = self._extractor
        if extractor is None or not self._rows:
            return []
        if not extractor.has_time and self._steps is None and self._rate(ends) is None:
            self._clear()  # nobody can say yet when they were
            return []
        if not self._settle(extractor, ends):
            return []
        table = np.array(self._rows, dtype=np.float64)
        extracted = extractor.extract_table(table)
        arrivals = np.array(self._arrivals)
        time_s = self._times(extracted, table)
        self._clear()
        steps = self._timeline.extend(time_s, extracted.usable)
        self._note(steps)
        host_s = self._host(time_s, arrivals)
        arrived_s = None if arrivals[-1] == 0.0 else arrivals
        found = sample_blocks(extractor, extracted, steps, host_s, self.epochs, arrived_s)
        blocks = self._unbridged(found)
        self._look_for_turns(blocks)
        if steps.keep.any():
            self._left_out = not blocks or blocks[-1].time_s[-1] != time_s[steps.keep][-1]
        self._rows, self._arrivals, self._lost = self._waiting
        self._waiting = [], [], []
        return blocks

    def _look_for_turns(self, blocks: list[SampleBlock]) -> None:
        """Whether the first samples are of one device; two on one wire send in turn."""
        if self._first_count >= _FIRST:
            return
        for block in blocks:
            self._first.append(block.raw_b_gauss)
            self._first_count += len(block)
        if self._first_count < _FIRST:
            return
        if words := describe_alternation(np.concatenate(self._first)):
            self.warnings[words] = None
        self._first.clear()

    def _settle(self, extractor: Extractor, ends: bool) -> bool:
        """What the arrivals say is missing; rows that need those behind them wait.

        False where all of them wait. Of rows with one arrival or none nothing can be said.
        """
        if extractor.has_time or self._steps is None or self._arrivals[-1] == 0.0:
            return True
        seen = self._lost_messages.look(self._arrivals, self._lost, self._steps.step_s, ends)
        count = seen.settled
        self._waiting = self._rows[count:], self._arrivals[count:], self._lost[count:]
        missing = np.cumsum(seen.lost + ~seen.used)[seen.used]  # those without a time are as lost
        self._lost = np.diff(missing, prepend=0).tolist()
        self._rows = [row for row, used in zip(self._rows, seen.used, strict=False) if used]
        self._arrivals = [at for at, used in zip(self._arrivals, seen.used, strict=False) if used]
        self._warn_of_lost_messages()
        if self._rows:
            return True
        self._rows, self._arrivals, self._lost = self._waiting
        self._waiting = [], [], []
        return False

    def _warn_of_lost_messages(self) -> None:
        lines = self._lost_messages
        total = lines.missing + self.by_layout[self.facts.layout]
        self.warnings.pop(self._lost_messages_warning, None)
        if lines.places < _FEW_PLACES or lines.missing < _WARNED_SHARE * total:
            return
        self._lost_messages_warning = (
            "messages are missing although the bytes show no gap: by the times at which the others "
            f"arrived, at {counted(lines.places, 'place')} ({100.0 * lines.missing / total:.2g} % "
            "of all are missing); these steps are not used; was the recording computer too slow?"
        )
        self.warnings[self._lost_messages_warning] = None

    def peek(self) -> list[SampleBlock]:
        """What waits for its block to be full, as far as it carries its time; changes nothing."""
        if (extractor := self._extractor) is None or not self._rows:
            return []
        extracted = extractor.extract_table(np.array(self._rows, dtype=np.float64))
        if extracted.time_s is None:
            return []
        steps = self._timeline.copied().extend(extracted.time_s, extracted.usable)
        arrivals = np.array(self._arrivals)
        host_s = self._line(steps.time_s, arrivals)
        found = sample_blocks(extractor, extracted, steps, host_s, self.epochs, arrivals)
        return [] if steps.restarts else self._unbridged(found)

    def _unbridged(self, blocks: list[SampleBlock]) -> list[SampleBlock]:
        """Samples that nobody could un-map were left out: what comes next does not follow on."""
        if blocks and self._left_out and not blocks[0].gap_before:
            dt_s = np.concatenate([[np.nan], blocks[0].dt_s[1:]])
            blocks[0] = replace(blocks[0], dt_s=dt_s, gap_before=True)
        return blocks

    def _times(self, extracted: Extracted, table: Array) -> Array:
        """Device times (N,); for a stream without, the number of messages, lost ones included."""
        if extracted.time_s is not None:
            return extracted.time_s
        assert self._steps is not None
        lost = np.array(self._lost)
        if self._attitude is not None:
            ypr, rate = np.hsplit(table[:, self._attitude], 2)
            known = lost > 0 if self._arrivals[-1] != 0.0 else None  # by arrivals: how many, too
            lost = np.maximum(lost, self._turns.look(ypr, rate, self._steps.step_s, known))
            self._say_turns()
        if not self.facts.expected:
            lost[0] = 0  # nothing came before the first one
        return self._steps.times(lost)

    def _say_turns(self) -> None:
        turns = self._turns
        if turns.places < _FEW_PLACES:
            return
        self.warnings.pop(self._turns_said, None)
        share = 100.0 * turns.missing / (turns.missing + self.by_layout[self.facts.layout])
        self._turns_said = (
            f"messages are missing although the bytes show no gap: at "
            f"{counted(turns.places, 'place')} the device turned further than its rate explains "
            f"(about {share:.0f} % of all are missing); these steps are not used; was the "
            "recording computer too slow?"
        )
        self.warnings[self._turns_said] = None

    def _host(self, time_s: Array, arrivals: Array) -> Array:
        """Host times; a recording without host time (arrivals of 0) has only the device's."""
        if arrivals[-1] == 0.0:
            return time_s
        self.clock.update(float(time_s[-1]), float(arrivals[-1]))
        return self._line(time_s, arrivals)

    def _line(self, time_s: Array, arrivals: Array) -> Array:
        line = np.minimum(self.clock.to_host(time_s), arrivals)
        return np.asarray(np.maximum.accumulate(np.where(np.isfinite(line), line, arrivals)))

    def _note(self, steps: TimelineSteps) -> None:
        facts = self.facts
        kept = int(np.count_nonzero(steps.keep))
        facts.samples += kept
        facts.unusable += len(steps.keep) - kept
        facts.expected += kept
        facts.duration_s += float(np.nansum(steps.dt_s)) + sum(gap.length_s for gap in steps.gaps)
        period = self._timeline.period_s
        if np.isfinite(period) and period > 0:
            lost = [max(gap.length_s / period - 1.0, 0.0) for gap in steps.gaps]
            if lost and self._forgiven:
                lost.remove(max(lost))
                self._forgiven = False
            facts.expected += sum(lost)
            if self._steps is None:
                facts.rate_hz, facts.rate_source = 1.0 / period, "device time"
        for gap in steps.gaps:
            self.all_gaps.add(gap)

    def given(self, block: SampleBlock) -> None:
        """Samples of a table: nothing to decode, only to count."""
        facts = self.facts
        facts.layout, facts.rate_source = "table", "time_s"
        if block.gap_before and self._given_s is not None:
            length_s = float(block.time_s[0]) - self._given_s
            self.all_gaps.add(Gap(self._given_s, length_s))
            facts.duration_s += length_s
            facts.expected += max(length_s * facts.rate_hz - 1.0, 0.0)
        self._given_s = float(block.time_s[-1])
        facts.samples += len(block)
        facts.expected += len(block)
        self._given_step_s += float(np.nansum(block.dt_s))
        self._given_steps += int(np.count_nonzero(np.isfinite(block.dt_s)))
        facts.duration_s += float(np.nansum(block.dt_s))
        if self._given_step_s > 0.0:
            facts.rate_hz = self._given_steps / self._given_step_s

    def health(self) -> HealthFacts:
        """Figures of the stream so far, for the gates."""
        facts = self.facts
        total = max(self.by_layout.total() + facts.damaged, 1)
        return HealthFacts(
            crc_error_rate=facts.damaged / total,
            drop_rate=max(1.0 - facts.samples / max(facts.expected, 1.0), 0.0),
            saturated=facts.unusable,
            negative_dt=self.restarts - self._excused,
            rate_hz=facts.rate_hz,
        )

    def check(self) -> None:
        """Raise NoSamplesError, naming what came, where messages came and none is of use."""
        if self.facts.samples or not self.by_layout:
            return
        reasons = [str(error) for error in self.refused.values()]
        if len({error.quantity for error in self.refused.values()}) > 1:
            names = " and ".join(list(self.refused)[:_FEW_PLACES])
            reasons = [
                f"field and rates come in different messages ({names}), and no time in both tells "
                "which belong together; configure VNYMR or VNIMU (register 6: 14 or 19), or a "
                "binary output with both"
            ]
        if self.not_used:
            reasons.append(f"{', '.join(self.not_used)}: nothing of it is used")
        if reasons:
            raise NoSamplesError("; ".join(reasons))


def _rows(rate_hz: float) -> int:
    """Rows of a block."""
    return max(_LEAST_ROWS, min(_MOST_ROWS, int(_BLOCK_S * rate_hz)))
