"""What the core needs from the configuration."""

from __future__ import annotations

from dataclasses import dataclass, field

from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.events import GateResult
from ahrsd.gates import GateLimits, Level, for_level
from ahrsd.sharing.arbiter import SharePolicy
from ahrsd.world_field import WorldField
from ahrsd.writeback.policy import WriteBackPolicy

BESIDE_KEY = "examined"  # in a capture's header where `beside` was set


@dataclass(frozen=True, slots=True)
class CalibratorSettings:
    """What the calibration needs from the configuration."""

    estimator: EstimatorParameters
    limits: GateLimits
    world_field: WorldField | None = None
    held_out: bool = True


@dataclass(frozen=True, slots=True)
class CoreSettings:
    """What the core needs from the configuration.

    output_rate_hz:  of the stream that `configure_stream` sets up
    reply_timeout_s: how long a reply may take
    stream_rate_hz, stream_rate_source: of streams without time, and how the rate is known
    keep: how many decisions, and how many of the first and of the newest gaps, are kept in memory
        for a summary; None: all, for a recording, whose length is known. Counts and hash always
        cover everything.
    columns_max_age_s: largest time between a sample and a vehicle's measurement that is used for it
    warm_start_s: maximum age of samples of an earlier run (`warm_start`); 0: none are used
    shares: the ports on which other programs find the device
    beside: the slow work is done outside the core (`estimation`), not at once
    """

    calibrator: CalibratorSettings
    policy: WriteBackPolicy = field(default_factory=WriteBackPolicy)
    output_rate_hz: float = 100.0
    reply_timeout_s: float = 0.4
    stream_rate_hz: float | None = None
    stream_rate_source: str = "as given"
    keep: int | None = None
    columns_max_age_s: float = 0.5
    beside: bool = False
    warm_start_s: float = 0.0
    shares: tuple[SharePolicy, ...] = ()

    @property
    def level(self) -> Level:
        """Which gates must pass before RAM is written; those for flash are checked at the save."""
        return Level.UNATTENDED if self.policy.approval == "auto" else Level.RAM

    def gates_of(
        self, gates: tuple[GateResult, ...]
    ) -> tuple[tuple[GateResult, ...], tuple[GateResult, ...]]:
        """The gates that must pass before RAM is written, and those before flash is written."""
        return for_level(gates, self.level), for_level(gates, Level.FLASH)
