"""The evidence: all values that the gates read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ahrsd.samples import Array

Bools = NDArray[np.bool_]
Regime = Literal["3D", "partial", "2D", "none", "unknown"]
SECTOR_DEG = 10.0
SECTORS = round(360.0 / SECTOR_DEG)
FREE_DEG = 30.0  # of roll and of pitch, both ways: tilt above which motion counts as 3-D
_NAMED = 3
_NAN = float("nan")
CIRCLES = "drive at least two full circles in calm surroundings"


@dataclass(frozen=True, slots=True)
class HealthFacts:
    """Health of the stream: shares of messages and samples, counts, rate.

    negative_dt: how often the device's time fell without a reset that a program requested
    """

    crc_error_rate: float
    drop_rate: float
    saturated: int
    negative_dt: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class BasisFacts:
    """Origin of the samples. `changed`: a compensation register changed within the window.

    stepped: hard iron or gyro bias stepped, and the estimate uses data from before that
    """

    registers_read: bool
    changed: bool
    hsi_applied: bool
    compensated_only: bool
    firmware_known: bool
    stepped: bool = False


@dataclass(frozen=True, slots=True)
class EstimateFacts:
    """The estimator's own assessment.

    widened_by: the main contribution to the heading's sigma and what would reduce it; empty: none
    place_deg: heading error, 1 sigma, due to a field that differs by place and to the residual;
        nan: unknown
    """

    converged: bool
    unobservable: tuple[str, ...]
    score: float
    heading_sigma_deg: float
    widened_by: str = ""
    place_deg: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """Motion of the whole history.

    heading_deg: ten-degree sectors visited, times ten; roll_deg, pitch_deg: half of the range
    regime: 3D (tilts by 30 deg and more), 2D (within 5 deg of its mean tilt), partial (between),
    none (turned less than 45 deg), unknown (no accelerometer)
    turn: what is missing, e.g. "turn left about 120 deg more"; empty if nothing is
    directions: cells of `evidence.coverage` that the corrected field visited; no cells: unknown
    down_b: mean direction of down in the sensor frame, nan if unknown
    """

    heading_deg: float
    roll_deg: float
    pitch_deg: float
    regime: Regime
    turn: str
    directions: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))
    down_b: Array = field(default_factory=lambda: np.full(3, np.nan))

    @property
    def tilts(self) -> str:
        """The tilts so far, in words."""
        if not np.isfinite([self.roll_deg, self.pitch_deg]).all():
            return "tilt not known yet"
        return f"so far roll +-{self.roll_deg:.0f}, pitch +-{self.pitch_deg:.0f} deg"

    @property
    def more_tilt(self) -> str:
        """Which tilt is still missing, in words, or that none is."""
        shown = {"pitch": self.pitch_deg, "roll": self.roll_deg}
        missing = [name for name, half_range in shown.items() if not half_range >= FREE_DEG]
        if not missing:
            return f"repeat this tilt on other headings, slowly and fast ({self.tilts})"
        lean = " and ".join(missing)
        return f"{lean} by {FREE_DEG:.0f} deg if the vehicle can ({self.tilts})"


UNKNOWN_MOTION = Coverage(_NAN, _NAN, _NAN, "none", "drive: nothing has been recorded yet")


@dataclass(frozen=True, slots=True, eq=False)
class FieldFacts:
    """The corrected field; nan if unknown (dip: the stream has no accelerometer).

    spread: standard deviation over mean of the magnitude
    wander_gauss, inclination_wander_deg: largest difference of a segment from the median segment
    temperature_range_c: over the segments
    """

    mean_gauss: float
    min_gauss: float
    max_gauss: float
    spread: float
    inclination_deg: float
    wander_gauss: float
    inclination_wander_deg: float
    temperature_range_c: float


UNKNOWN_FIELD = FieldFacts(*[float("nan")] * 8)


@dataclass(frozen=True, slots=True, eq=False)
class HeadingProof:
    """Heading errors before and after on the same held-out segments, deg; nan if there are none.

    windows: held-out segments with enough turning; sectors (36,): headings visited
    closure_deg: change of the error over one full turn
    gain_lower_deg: lower end of the 95 % interval of rms before minus rms after
    """

    windows: int
    sectors: Bools
    rms_before_deg: float
    rms_after_deg: float
    max_after_deg: float
    closure_deg: float
    gain_lower_deg: float


NO_PROOF = HeadingProof(0, np.zeros(SECTORS, dtype=bool), *[float("nan")] * 5)


@dataclass(frozen=True, slots=True)
class WorldFacts:
    """The corrected field compared with the world model at the configured position.

    magnitude_error: share of the model's total; inclination_error_deg: absolute
    """

    magnitude_error: float
    inclination_error_deg: float


@dataclass(frozen=True, slots=True)
class RefitFacts:
    """Independent fits: two halves compared, and a gyro-free fit compared with the candidate.

    hard_iron_gauss: between the halves, in the vehicle's level plane; the others are the largest
    heading difference over all headings and the tilts driven.
    """

    hard_iron_gauss: float
    halves_deg: float
    second_opinion_deg: float


@dataclass(frozen=True, slots=True)
class ChangeFacts:
    """The proposed calibration, and its difference from the one in force.

    eigenvalue_min: of the symmetric part of C; condition: of C; offset_gauss: |b|
    scale_change: of det(C)^(1/3) from the one in force; 0 if the world model judges the scale
    moved_unseen_gauss: change of the hard iron along the vertical, if the motion is too flat to
        determine it
    step_deg: largest heading change over all headings and the tilts driven
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
    """The proposed gyro bias compared with the mean rate at rest.

    sigma_share: sigma of that mean over the change that would be written
    disagreement: distance between the two over their combined sigma, of the worst axis
    apart_mrad_s: that distance, of the worst axis
    sigma_mrad_s: the estimate's own sigma, of the worst axis
    """

    bias_rad_s: float
    rest_s: float
    sigma_share: float
    disagreement: float
    apart_mrad_s: float
    sigma_mrad_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """All evidence about one candidate. nan: could not be measured. Units are in the names."""

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
    def would_tell(self) -> str:
        """What makes the heading uncertain, or which motion is missing, in words."""
        return self.estimate.widened_by or f"{CIRCLES}; {self.motion.more_tilt}"

    @property
    def position_known(self) -> bool:
        """Whether there is a world model to compare with."""
        return self.world is not None

    @property
    def motion_known(self) -> bool:
        """Whether there was motion that can be judged."""
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
        """Headings visited in the held-out windows."""
        return float(np.count_nonzero(self.proof.sectors) * SECTOR_DEG)

    @property
    def heldout_rms_before_deg(self) -> float:
        """Heading error on held-out data with the calibration in force."""
        return self.proof.rms_before_deg

    @property
    def heldout_rms_deg(self) -> float:
        """Heading error on held-out data with the proposed calibration."""
        return self.proof.rms_after_deg

    @property
    def gain_deg(self) -> float:
        """Held-out rms error before minus after."""
        return self.proof.rms_before_deg - self.proof.rms_after_deg

    @property
    def gain_percent(self) -> float:
        """The gain relative to the rms before, in percent."""
        return 100.0 * self.gain_deg / max(self.proof.rms_before_deg, 1e-6)

    @property
    def spread_percent(self) -> float:
        """Standard deviation of the corrected field over its mean."""
        return 100.0 * self.field.spread

    @property
    def model_error_percent(self) -> float:
        """Magnitude error against the world model; nan without a position."""
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
        """Paths of the numbers that are not finite ("field.spread"); a gate requires none."""
        return tuple(path for path, value in numbers(self) if not np.isfinite(value))

    @property
    def unmeasured_count(self) -> int:
        """How many numbers are not finite."""
        return len(self.unmeasured())

    @property
    def unmeasured_names(self) -> str:
        """The first of their paths; the gate that judges a number says what it needs."""
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
