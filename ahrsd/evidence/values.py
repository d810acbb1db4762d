"""Everything that the gates read, as one value."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from ahrsd.evidence.coverage import Coverage
from ahrsd.evidence.field import FieldFacts
from ahrsd.evidence.heading import SECTOR_DEG, HeadingProof

_NAMED = 3


@dataclass(frozen=True, slots=True)
class HealthFacts:
    """The stream as the core counted it: shares of messages and samples, counts, rate."""

    crc_error_rate: float
    drop_rate: float
    saturated: int
    negative_dt: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class BasisFacts:
    """What the samples rest on. `changed`: a compensation register changed within the window.

    stepped: hard iron or gyro bias stepped, and the estimate rests on data from before that
    """

    registers_read: bool
    changed: bool
    hsi_applied: bool
    compensated_only: bool
    firmware_known: bool
    stepped: bool = False


@dataclass(frozen=True, slots=True)
class EstimateFacts:
    """What the estimator says about itself."""

    converged: bool
    unobservable: tuple[str, ...]
    score: float
    heading_sigma_deg: float


@dataclass(frozen=True, slots=True)
class WorldFacts:
    """The corrected field against the world model at the configured position.

    magnitude_error: share of the model's total; inclination_error_deg: absolute
    """

    magnitude_error: float
    inclination_error_deg: float


@dataclass(frozen=True, slots=True)
class RefitFacts:
    """Independent fits: two halves against each other, and a gyro-free fit against the candidate.

    hard_iron_gauss: between the halves, in the vehicle's level plane; the others are the worst
    heading difference over all headings and the tilts driven.
    """

    hard_iron_gauss: float
    halves_deg: float
    second_opinion_deg: float


@dataclass(frozen=True, slots=True)
class ChangeFacts:
    """The proposed calibration by itself and against the one in force.

    eigenvalue_min: of the symmetric part of C; condition: of C; offset_gauss: |b|
    scale_change: of det(C)^(1/3) against the one in force; 0 where the world model judges the scale
    moved_unseen_gauss: hard iron's move along the vertical that the motion was too flat to see
    step_deg: worst heading change over all headings and the tilts driven
    """

    first_calibration: bool
    eigenvalue_min: float
    condition: float
    diagonal_min: float
    diagonal_max: float
    offset_gauss: float
    scale_change: float
    moved_unseen_gauss: float
    step_deg: float


@dataclass(frozen=True, slots=True)
class GyroFacts:
    """The proposed gyro bias against the mean rate at rest.

    sigma_share: sigma of that mean over the change that would be written
    disagreement: distance between the two over their combined sigma (the estimate's: at most
    0.3 mrad/s)
    """

    bias_rad_s: float
    rest_s: float
    sigma_share: float
    disagreement: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What is known about one candidate. nan: could not be measured. Units are in the names."""

    health: HealthFacts
    basis: BasisFacts
    estimate: EstimateFacts
    motion: Coverage
    field: FieldFacts
    world: WorldFacts | None
    proof: HeadingProof
    refits: RefitFacts
    change: ChangeFacts
    gyro: GyroFacts

    @property
    def position_known(self) -> bool:
        """Whether there is a world model to compare with."""
        return self.world is not None

    @property
    def motion_known(self) -> bool:
        """Whether there was motion of a kind that can be judged."""
        return self.motion.regime in {"3D", "partial", "2D"}

    @property
    def planar(self) -> bool:
        """Whether the vehicle stayed within 5 degrees of its mean tilt."""
        return self.motion.regime == "2D"

    @property
    def first_calibration(self) -> bool:
        """Whether the calibration in force is the factory's identity."""
        return self.change.first_calibration

    @property
    def user_calibrated(self) -> bool:
        """Whether somebody has calibrated before."""
        return not self.change.first_calibration

    @property
    def proof_coverage_deg(self) -> float:
        """Headings seen in the held-out windows."""
        return float(np.count_nonzero(self.proof.sectors) * SECTOR_DEG)

    @property
    def heldout_rms_before_deg(self) -> float:
        """Heading error on held-out data with the calibration in force."""
        return self.proof.rms_before_deg

    @property
    def heldout_rms_deg(self) -> float:
        """The same with the proposed one."""
        return self.proof.rms_after_deg

    @property
    def gain_deg(self) -> float:
        """Held-out rms before minus after."""
        return self.proof.rms_before_deg - self.proof.rms_after_deg

    @property
    def gain_percent(self) -> float:
        """The same over the rms before."""
        return 100.0 * self.gain_deg / max(self.proof.rms_before_deg, 1e-6)

    @property
    def spread_percent(self) -> float:
        """Standard deviation of the corrected field over its mean."""
        return 100.0 * self.field.spread

    @property
    def model_error_percent(self) -> float:
        """Corrected field against the world model; nan without a position."""
        return float("nan") if self.world is None else 100.0 * self.world.magnitude_error

    @property
    def scale_change_percent(self) -> float:
        """Change of scale against the calibration in force."""
        return 100.0 * self.change.scale_change

    @property
    def gyro_bias_deg_s(self) -> float:
        """Length of the proposed gyro bias."""
        return float(np.degrees(self.gyro.bias_rad_s))

    def unmeasured(self) -> tuple[str, ...]:
        """Paths of the numbers that are not finite ("field.spread"); judged: none may be left."""
        return tuple(path for path, value in numbers(self) if not np.isfinite(value))

    @property
    def unmeasured_count(self) -> int:
        """How many numbers are not finite."""
        return len(self.unmeasured())

    @property
    def unmeasured_names(self) -> str:
        """The first of their paths; what each needs is said by the gate that judges it."""
        paths = self.unmeasured()
        rest = f" and {len(paths) - _NAMED} more" if len(paths) > _NAMED else ""
        return ", ".join(paths[:_NAMED]) + rest


def numbers(value: object, path: str = "") -> Iterator[tuple[str, float]]:
    """Every float in a tree of dataclasses with its path."""
    if isinstance(value, float):
        yield path, value
    elif is_dataclass(value):
        for f in fields(value):
            yield from numbers(getattr(value, f.name), f"{path}.{f.name}".lstrip("."))
