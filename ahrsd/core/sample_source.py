"""Turns the device's messages into samples, and detects doubts about which device sent them.

Messages become blocks of samples (`stream.assembler`), and the user's registers are removed from
them (`stream.decompensation`). Silences, jumps and damage between samples are reported. Columns of
the vehicle are added, and the terms that follow them are subtracted (`column_compensation`).
Samples wait until the device has been confirmed after them.

**Unconfirmed samples.** A sample waits until the device has answered, after it, that it is the one
that was read. Which device sends and which registers are in force is known only when the device is
asked. Between two answers the cable may have been moved to another unit and back, or another
program may have written a register and a restart undone that: then both answers are right and the
samples between them are not. So the estimator gets a sample only after a later answer, and never a
sample between two doubts without an answer between them.

If the stream has device time, a doubt is a time that ran ahead: it may be another unit, but not a
restart (the time would fall). Earlier samples are still of the unit that answered last, unless a
doubt was open already. If the stream has no device time, silence may also be a restart: no earlier
unconfirmed sample is used.

**Doubts.** Cheap tests whether samples may be of another device, or of one that restarted.

A device that is swapped is silent for seconds, and then its clock or its readings differ. In a text
stream without device time a restart looks the same. So three events are reported: a silence of more
than a few samples, a time that runs ahead, and readings that jump further than the turn rate
explains. None proves anything: they make the daemon identify the device again.
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

# -- Doubts ----------------------------------------------------------------------------------------


SAMPLES = 5  # missing in a row
LEAST_SILENCE_S, UNKNOWN_RATE_SILENCE_S = 0.3, 2.0
JUMP_GAUSS = 0.03  # from one sample to the next, beyond the change by turning
_TURN_FACTOR = 1.5  # factor on the turn rate, for its change between samples


class StreamWatch:
    """Detects doubts; both checks return a description, empty if there is no doubt."""

    def __init__(self) -> None:
        self._heard_s: float | None = None
        self._last: tuple[float, Array] | None = None

    def resume(self, host_s: float) -> None:
        """Expect output from now on: this program paused it, or it starts anew."""
        self._heard_s, self._last = host_s, None

    def check_silence(self, host_s: float, rate_hz: float) -> str:
        """Messages came at `host_s`; `rate_hz` is nan while unknown."""
        known = np.isfinite(rate_hz) and rate_hz > 0.0
        limit_s = max(SAMPLES / rate_hz, LEAST_SILENCE_S) if known else UNKNOWN_RATE_SILENCE_S
        before_s, self._heard_s = self._heard_s, host_s
        if before_s is None or host_s - before_s <= limit_s:
            return ""
        return f"the device was silent for {host_s - before_s:.1f} s"

    def check_block(self, block: SampleBlock, rate_hz: float) -> tuple[str, bool]:
        """The doubt that these samples raise, and whether it is a jump of the readings."""
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
        turn = np.maximum(rate[1:], rate[:-1]) * np.diff(time_s)
        allowed = JUMP_GAUSS + _TURN_FACTOR * turn * np.linalg.norm(field[:-1], axis=1)
        excess = step - allowed
        worst = int(np.argmax(np.where(np.isfinite(excess), excess, -np.inf)))
        if not excess[worst] > 0.0:
            return "", False
        return f"the field's reading jumped by {1e3 * step[worst]:.0f} mG at once", True


# -- Unconfirmed samples ---------------------------------------------------------------------------


MOST_ROWS = 200_000  # that wait; a device that stops answering must not fill the memory
GROUP_S = 2.0  # examined in one task: costs less, and delays other tasks only briefly
T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting(Generic[T]):
    number: int
    block: SampleBlock
    came_s: float
    how: T


class UnconfirmedSamples(Generic[T]):
    """Blocks that wait, each with the circumstances `how` at arrival. Host times, in seconds."""

    def __init__(self) -> None:
        self._sure: deque[_Waiting[T]] = deque()  # after an answer and before the newest doubt
        self._open: deque[_Waiting[T]] = deque()  # since the newest doubt
        self._came = self._released = 0  # counters of blocks
        self._doubt_s = float("-inf")
        self._in_doubt = False  # no confirmation since the newest doubt
        self._rows = 0
        self.dropped = 0  # samples that were never confirmed
        self.span_s = 0.0  # of the samples that wait

    def hold(self, block: SampleBlock, came_s: float, how: T) -> None:
        """Add a block."""
        self._came += 1
        self._open.append(_Waiting(self._came, block, came_s, how))
        self._update_totals(block, 1)
        while self._rows > MOST_ROWS:
            self._drop(self._sure if self._sure else self._open, 1)

    def mark_doubt(self, host_s: float, *, perhaps_restarted: bool) -> None:
        """Samples from now on may be of another unit, or of one that restarted."""
        if perhaps_restarted:
            self.drop()
        elif self._in_doubt:
            self._drop(self._open)
        self._sure += self._open
        self._open.clear()
        self._doubt_s, self._in_doubt = host_s, True

    def confirm(self, asked_s: float) -> list[tuple[list[SampleBlock], T]]:
        """The device asked at `asked_s` is the one that was read, with the expected registers.

        Returns the blocks that may be used now, oldest first, in groups of about `GROUP_S` of
        samples, each with the circumstances of its last block.
        """
        if asked_s <= self._doubt_s:
            return []  # the answer may be from before the doubt
        self._in_doubt = False
        released: list[tuple[list[SampleBlock], T]] = []
        span_s = GROUP_S
        for line in (self._sure, self._open):
            while line and line[0].came_s <= asked_s:
                one = line.popleft()
                self._update_totals(one.block, -1)
                follows = one.number == self._released + 1
                block = one.block if follows else _mark_gap_before(one.block)
                self._released = one.number
                if span_s >= GROUP_S:
                    released.append(([], one.how))
                    span_s = 0.0
                group = [*released[-1][0], block]
                released[-1] = (group, one.how)
                span_s += float(np.nansum(block.dt_s))
        return released

    def drop(self) -> None:
        """Discard all waiting samples."""
        self._drop(self._sure)
        self._drop(self._open)

    def _drop(self, line: deque[_Waiting[T]], most: int | None = None) -> None:
        for _ in range(len(line) if most is None else min(most, len(line))):
            one = line.popleft()
            self.dropped += len(one.block)
            self._update_totals(one.block, -1)

    def _update_totals(self, block: SampleBlock, sign: int) -> None:
        self._rows += sign * len(block)
        self.span_s += sign * float(np.nansum(block.dt_s))
        if not self._rows:
            self.span_s = 0.0


def _mark_gap_before(block: SampleBlock) -> SampleBlock:
    """Mark a gap: the block before was not used, so the first time step is unknown."""
    if block.gap_before or not len(block):
        return block
    return replace(block, dt_s=np.concatenate([[np.nan], block.dt_s[1:]]), gap_before=True)


# -- Messages to samples ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Doubt:
    """Samples from here on may be of another device, or of one that restarted."""

    reason: str


@dataclass(frozen=True, slots=True)
class SampleWarning:
    """A message for a person about the stream or a sensor."""

    text: str


class SampleSource(Generic[T]):
    """See the module. `T`: the circumstances stored with each waiting block."""

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
        """Pass measurements and the damage between them to the stream; count other events."""
        damage = deque(skipped)
        if any(isinstance(event, Measurement) for event in found):
            silence = self._watch.check_silence(host_s, self.stream.facts.rate_hz)
            if silence and not self.stream.carries_time:  # otherwise its time shows a gap
                yield from self.stream.flush()
                yield Doubt(silence)
        for event in found:
            if isinstance(event, Measurement):
                while damage and damage[0].offset < event.offset:
                    self.stream.damaged(damage.popleft())
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
        for piece in damage:
            self.stream.damaged(piece)
        facts = self.stream.facts
        for text in self.sensors.count(facts.unusable + self.undecodable, facts.samples):
            yield SampleWarning(text)

    def take_restart(self) -> bool:
        """Whether the device's time fell since the last call, which shows a restart."""
        fell = self.time_fell
        self._restarts = self.stream.restarts
        return fell

    @property
    def time_fell(self) -> bool:
        """Whether the device's time fell and `take_restart` was not called since."""
        return self.stream.restarts > self._restarts

    @property
    def has_uptime(self) -> bool:
        """Whether the samples have the device's own time since start-up."""
        return self.stream.facts.rate_source == "device time" and not self.time_fell

    def find_suspicion(self, block: SampleBlock) -> tuple[str, bool]:
        """Why this block may be of another device, and whether the reason is a jump of readings."""
        return self._watch.check_block(block, self.stream.facts.rate_hz)

    # -- changes of the device ---------------------------------------------------------------------

    def on_output_paused(self, host_s: float) -> None:
        """The output was paused or starts anew: do not interpolate over the gap."""
        self._watch.resume(host_s)
        self.stream.forget()

    def on_output_resumed(self, host_s: float) -> None:
        """The output was interrupted for a known reason, a client's reset: expect no jump."""
        self._watch.resume(host_s)

    def set_registers(self, values: dict[int, Values], host_s: float) -> None:
        """The device applies these registers from now on: remove them from the samples."""
        self.registers = values
        compensation = Compensation.from_registers(values)
        self.epochs.begin(host_s, compensation)
        self.stream.warnings.update(dict.fromkeys(compensation.warnings))
        self.stream.registers = values

    def add_client_write(self, values: Mapping[int, Values]) -> None:
        """A client wrote these registers, which do not affect the decompensation."""
        self.registers = self.stream.registers = {**self.registers, **values}

    def mark_registers_unknown(self, host_s: float) -> None:
        """The registers in force are unknown from now on: samples are unusable meanwhile."""
        self.epochs.begin(host_s, None)

    def accept_undecompensated(self, host_s: float) -> None:
        """The device does not answer: take the stream without decompensation."""
        self.epochs.begin(host_s, Compensation.unknown())

    @property
    def present_correction(self) -> Affine:
        """The correction that the device applies to the magnetometer."""
        return user_compensation(self.registers)[0]

    def basis(self, identity: Identity | None) -> BasisFacts:
        """Facts about the origin of the samples."""
        applied = self.epochs.now.compensation
        return BasisFacts(
            registers_read=bool(self.registers),
            changed=applied is None,
            hsi_applied=applied is not None and applied.hsi is not None,
            compensated_only=self.stream.compensated_mag,
            firmware_known=identity is not None and identity.profile.writable,
        )
