"""From the device's messages to samples, and what makes it doubtful whose samples they are.

Messages become blocks of samples (`stream.assembler`) from which the user's registers are taken out
(`stream.decompensation`); silences, jumps and damage between them are told; columns of the vehicle
are put beside them and the terms that follow these taken out (`column_compensation`); samples wait
until the device has answered behind them.

**Samples wait** until the device has said, after them, that it is the one that was read. Who sends
and which registers act is known only at the moments at which the device is asked. Between two of
them the cable may have been moved to another unit and back, or another program may have written a
register that a restart took away again: then both answers are right and the samples between them
are not. So the estimator is given a sample only after an answer that came behind it, and never one
from between two doubts of which nobody was asked anything.

A doubt in a stream with the device's own time is a time that ran ahead: it may be another unit, no
restart (its time would fall). What came before it is still of the unit that answered last, unless a
doubt was there already. In a stream without that time a silence may be a restart as well: nothing
from before it counts.

**Doubts.** Whether what comes now may be of another device, or of one that restarted: cheap to
suspect.

A device that is swapped is silent for seconds, and then its clock or its readings are elsewhere; in
a text stream without device time a restart looks the same. So a silence of more than a few samples,
a time that runs ahead and readings that jump further than the rate of turn explains are told. None
of them proves anything: they make the daemon ask the device who it is.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.core.column_compensation import VehicleTerms
from ahrsd.core.sensor_checks import SensorChecks
from ahrsd.core.settings import CoreSettings
from ahrsd.evidence.values import BasisFacts
from ahrsd.samples import Array, SampleBlock
from ahrsd.stream.assembler import Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs, user_compensation
from drivers.vn100.commands import Identity
from drivers.vn100.decode import Measurement, Undecodable, Unused
from drivers.vn100.deframer import Skipped
from drivers.vn100.registers import Values
from drivers.vn100.session import ECHOES, DeviceFault, Event, LineEchoes, Stray

# -- What makes it doubtful ------------------------------------------------------------------------


SAMPLES = 5  # missing in a row
LEAST_SILENCE_S, UNKNOWN_RATE_SILENCE_S = 0.3, 2.0
JUMP_GAUSS = 0.03  # from one sample to the next, beyond what turning explains
_TURN = 1.5  # times the rate of turn, for what it changes between samples


class StreamWatch:
    """See the module; both methods return what was seen, empty where there was nothing."""

    def __init__(self) -> None:
        self._heard_s: float | None = None
        self._last: tuple[float, Array] | None = None

    def resumed(self, host_s: float) -> None:
        """The output was paused by ourselves, or begins anew: from now on it ought to come."""
        self._heard_s, self._last = host_s, None

    def heard(self, host_s: float, rate_hz: float) -> str:
        """Messages came at `host_s`; the rate is nan while nobody knows it."""
        known = np.isfinite(rate_hz) and rate_hz > 0.0
        limit_s = max(SAMPLES / rate_hz, LEAST_SILENCE_S) if known else UNKNOWN_RATE_SILENCE_S
        before_s, self._heard_s = self._heard_s, host_s
        if before_s is None or host_s - before_s <= limit_s:
            return ""
        return f"the device was silent for {host_s - before_s:.1f} s"

    def block(self, block: SampleBlock, rate_hz: float) -> tuple[str, bool]:
        """Samples; and whether it is the readings that jumped."""
        if not len(block):
            return "", False
        period_s = 1.0 / rate_hz if np.isfinite(rate_hz) and rate_hz > 0.0 else np.inf
        last, self._last = self._last, (float(block.time_s[-1]), block.raw_b_gauss[-1].copy())
        time_s, field = block.time_s, block.raw_b_gauss
        rate = np.linalg.norm(block.gyro_b_rad_s, axis=1)
        if last is not None:
            step_s = float(time_s[0]) - last[0]
            if step_s > (SAMPLES + 0.5) * period_s:
                return f"its time ran ahead by {step_s:.1f} s", False
            time_s, field = np.r_[last[0], time_s], np.vstack([last[1], field])
            rate = np.r_[rate[:1], rate]
        if len(time_s) < 2:
            return "", False
        step = np.linalg.norm(np.diff(field, axis=0), axis=1)
        turned = np.maximum(rate[1:], rate[:-1]) * np.diff(time_s)
        allowed = JUMP_GAUSS + _TURN * turned * np.linalg.norm(field[:-1], axis=1)
        beyond = step - allowed
        worst = int(np.argmax(np.where(np.isfinite(beyond), beyond, -np.inf)))
        if not beyond[worst] > 0.0:
            return "", False
        return f"the field's reading jumped by {1e3 * step[worst]:.0f} mG at once", True


# -- Samples that wait -----------------------------------------------------------------------------


MOST_ROWS = 200_000  # that wait; a device that answers nothing any more must not fill the memory
GROUP_S = 2.0  # examined in one go: it costs less, and nothing waits for it for long
T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting(Generic[T]):
    number: int
    block: SampleBlock
    came_s: float
    how: T


class UnconfirmedSamples(Generic[T]):
    """Blocks, each with `how` things stood when it came. Times are the host's, in seconds."""

    def __init__(self) -> None:
        self._sure: deque[_Waiting[T]] = deque()  # an answer before them, and a doubt behind
        self._open: deque[_Waiting[T]] = deque()  # since the newest doubt
        self._came = self._released = 0  # numbers of the newest blocks
        self._doubt_s = float("-inf")
        self._in_doubt = False  # nothing was confirmed since the newest doubt
        self._rows = 0
        self.dropped = 0  # samples that nobody vouched for
        self.span_s = 0.0  # of the samples that wait

    def hold(self, block: SampleBlock, came_s: float, how: T) -> None:
        """A block came."""
        self._came += 1
        self._open.append(_Waiting(self._came, block, came_s, how))
        self._count(block, 1)
        while self._rows > MOST_ROWS:
            self._drop(self._sure if self._sure else self._open, 1)

    def doubt(self, host_s: float, *, perhaps_restarted: bool) -> None:
        """What comes from now on may be of another unit, or of one that restarted."""
        if perhaps_restarted:
            self.drop()
        elif self._in_doubt:
            self._drop(self._open)
        self._sure += self._open
        self._open.clear()
        self._doubt_s, self._in_doubt = host_s, True

    def confirm(self, asked_s: float) -> list[tuple[list[SampleBlock], T]]:
        """The device that was asked then is the one that was read, and holds what it ought to.

        Returns the blocks that may be used now, oldest first, in groups of about `GROUP_S` of
        samples, with how things stood when the last one of the group came.
        """
        if asked_s <= self._doubt_s:
            return []  # it may have answered before the doubt
        self._in_doubt = False
        released: list[tuple[list[SampleBlock], T]] = []
        span_s = GROUP_S
        for line in (self._sure, self._open):
            while line and line[0].came_s <= asked_s:
                one = line.popleft()
                self._count(one.block, -1)
                follows = one.number == self._released + 1
                block = one.block if follows else _after_a_gap(one.block)
                self._released = one.number
                if span_s >= GROUP_S:
                    released.append(([], one.how))
                    span_s = 0.0
                group = [*released[-1][0], block]
                released[-1] = (group, one.how)
                span_s += float(np.nansum(block.dt_s))
        return released

    def drop(self) -> None:
        """Nothing of what waits may be used."""
        self._drop(self._sure)
        self._drop(self._open)

    def _drop(self, line: deque[_Waiting[T]], most: int | None = None) -> None:
        for _ in range(len(line) if most is None else min(most, len(line))):
            one = line.popleft()
            self.dropped += len(one.block)
            self._count(one.block, -1)

    def _count(self, block: SampleBlock, sign: int) -> None:
        self._rows += sign * len(block)
        self.span_s += sign * float(np.nansum(block.dt_s))
        if not self._rows:
            self.span_s = 0.0


def _after_a_gap(block: SampleBlock) -> SampleBlock:
    """What came before it is not used: its first step is not known."""
    if block.gap_before or not len(block):
        return block
    return replace(block, dt_s=np.concatenate([[np.nan], block.dt_s[1:]]), gap_before=True)


# -- Messages to samples ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Doubt:
    """What comes from here on may be of another device, or of one that restarted."""

    reason: str


@dataclass(frozen=True, slots=True)
class SampleWarning:
    """What a person should know of the stream or of a sensor."""

    text: str


class SampleSource(Generic[T]):
    """See the module. Samples wait with a `T` each: how things stood when they came."""

    def __init__(self, settings: CoreSettings) -> None:
        self.epochs = RegisterEpochs()
        rate, source = settings.stream_rate_hz, settings.stream_rate_source
        self.stream = Stream(self.epochs, rate, source, keep_gaps=settings.keep)
        self.vehicle = VehicleTerms(self.stream.warnings.setdefault, settings.columns_max_age_s)
        self.sensors = SensorChecks()
        self.unconfirmed: UnconfirmedSamples[T] = UnconfirmedSamples()
        self.registers: dict[int, Values] = {}  # as far as they are known
        self.strays = self.undecodable = 0
        self._watch = StreamWatch()
        self._restarts = 0

    # -- messages ----------------------------------------------------------------------------------

    def take(
        self, found: list[Event], skipped: list[Skipped], host_s: float
    ) -> Iterator[SampleBlock | Doubt | SampleWarning | DeviceFault]:
        """Measurements to the stream, with what was damaged between them; the rest is counted."""
        damaged = deque(skipped)
        if any(isinstance(event, Measurement) for event in found):
            silence = self._watch.heard(host_s, self.stream.facts.rate_hz)
            if silence and not self.stream.carries_time:  # where it does, its time shows a gap
                yield from self.stream.flush()
                yield Doubt(silence)
        for event in found:
            if isinstance(event, Measurement):
                while damaged and damaged[0].offset < event.offset:
                    self.stream.damaged(damaged.popleft())
                yield from self.stream.take(event, host_s)
            elif isinstance(event, Undecodable):
                self.undecodable += 1
                self.stream.undecodable()
            elif isinstance(event, Unused):
                self.stream.unused(event.name)
            elif isinstance(event, LineEchoes):
                yield SampleWarning(ECHOES)
            elif isinstance(event, DeviceFault):
                yield event
            elif isinstance(event, Stray):
                self.strays += 1
        for piece in damaged:
            self.stream.damaged(piece)
        facts = self.stream.facts
        for text in self.sensors.count(facts.unusable + self.undecodable, facts.samples):
            yield SampleWarning(text)

    def take_restart(self) -> bool:
        """Whether the device's time fell since the last call: it restarted."""
        fell = self.time_fell
        self._restarts = self.stream.restarts
        return fell

    @property
    def time_fell(self) -> bool:
        """Whether it fell and `take_restart` has not been told."""
        return self.stream.restarts > self._restarts

    @property
    def tells_uptime(self) -> bool:
        """Whether the samples' time is the device's own since its start-up."""
        return self.stream.facts.rate_source == "device time" and not self.time_fell

    def suspicion(self, block: SampleBlock) -> tuple[str, bool]:
        """Why this block may be of another device; and whether it is the readings that jumped."""
        return self._watch.block(block, self.stream.facts.rate_hz)

    # -- what was done to the device ---------------------------------------------------------------

    def paused(self, host_s: float) -> None:
        """The output was paused by ourselves, or begins anew: nothing is bridged over that."""
        self._watch.resumed(host_s)
        self.stream.forget()

    def output_resumed(self, host_s: float) -> None:
        """The output was away for a while that is known of, a client's reset: that is no jump."""
        self._watch.resumed(host_s)

    def in_force(self, values: dict[int, Values], host_s: float) -> None:
        """The device applies these registers from now on: they are taken out of the samples."""
        self.registers = values
        compensation = Compensation.from_registers(values)
        self.epochs.begin(host_s, compensation)
        self.stream.warnings.update(dict.fromkeys(compensation.warnings))
        self.stream.registers = values

    def wrote(self, values: Mapping[int, Values]) -> None:
        """A client wrote these, which say nothing about how samples are to be taken."""
        self.registers = self.stream.registers = {**self.registers, **values}

    def in_doubt(self, host_s: float) -> None:
        """Nobody knows which registers act from now on: samples are unusable until they are."""
        self.epochs.begin(host_s, None)

    def unread(self, host_s: float) -> None:
        """The device does not answer: the stream is taken as it comes."""
        self.epochs.begin(host_s, Compensation.unknown())

    @property
    def present_correction(self) -> Affine:
        """What the device applies to the magnetometer."""
        return user_compensation(self.registers)[0]

    def basis(self, identity: Identity | None) -> BasisFacts:
        """What is known of where the samples come from."""
        applied = self.epochs.now.compensation
        return BasisFacts(
            registers_read=bool(self.registers),
            changed=applied is None,
            hsi_applied=applied is not None and applied.hsi is not None,
            compensated_only=self.stream.compensated_mag,
            firmware_known=identity is not None and identity.profile.writable,
        )
