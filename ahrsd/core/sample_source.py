"""From the device's messages to samples, and what makes it doubtful whose samples they are.

Messages become blocks of samples (`stream.assembler`) from which the user's registers are taken out
(`stream.decompensation`); silences, jumps and damage between them are told; columns of the vehicle
are put beside them and the terms that follow these taken out (`column_compensation`); samples wait
until the device has answered behind them (`unconfirmed_samples`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

from ahrsd.calibration import Affine
from ahrsd.core.column_compensation import VehicleTerms
from ahrsd.core.sensor_checks import SensorChecks
from ahrsd.core.settings import CoreSettings
from ahrsd.core.unconfirmed_samples import StreamWatch, UnconfirmedSamples
from ahrsd.evidence.values import BasisFacts
from ahrsd.samples import SampleBlock
from ahrsd.stream.assembler import Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs, user_compensation
from drivers.vn100.commands import Identity
from drivers.vn100.decode import Measurement, Undecodable, Unused
from drivers.vn100.deframer import Skipped
from drivers.vn100.registers import Values
from drivers.vn100.session import ECHOES, DeviceFault, Event, LineEchoes, Stray

T = TypeVar("T")


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
