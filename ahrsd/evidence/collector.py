"""Takes samples; returns the evidence for or against an estimate.

Protocol with the core: split a block with `split`; `add` each part here, and give a part to the
estimator only if its role is "train". A block that lies within one slot may be passed whole, under
`role(block)`.

The evidence compares the candidate with the calibration in force, the world model, refits and the
rate at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ahrsd import so3
from ahrsd.calibration import Affine, Estimate
from ahrsd.evidence.coverage import motion_coverage
from ahrsd.evidence.heading import compare_heading_errors, gyro_heading_rad, mean_field_0
from ahrsd.evidence.second_opinions import Rest, fit_magnitude, fit_with_gyro, mean_rate_at_rest
from ahrsd.evidence.segments import (
    AttitudeTrack,
    HistoryParameters,
    Nodes,
    Role,
    SegmentHistory,
    integrate_attitude,
    join_tracks,
)
from ahrsd.evidence.values import (
    NO_PROOF,
    UNKNOWN_FIELD,
    UNKNOWN_MOTION,
    BasisFacts,
    Bools,
    ChangeFacts,
    Coverage,
    EstimateFacts,
    Evidence,
    FieldFacts,
    GyroFacts,
    HealthFacts,
    RefitFacts,
    WorldFacts,
)
from ahrsd.samples import Array, SampleBlock
from ahrsd.world_field import WorldField

# -- Predicted heading error -----------------------------------------------------------------------
#
# Heading error of one calibration if another is the truth, over all headings and tilts.
#
# With the truth (C, b), attitude R_nb and field f_n the sensor reads m = C^-1 R_nb^T f_n + b. The
# judged calibration turns m into a field; its horizontal direction in n differs by the error.


HEADINGS = 36
_LEAST_TILT_DEG = 5.0  # no vehicle stays level: judge at least up to this tilt
_MOST_TILT_DEG = 60.0


@dataclass(frozen=True, slots=True)
class Envelope:
    """Conditions for predicted errors: field (magnetic north-east-down), half-ranges of tilt."""

    total_gauss: float
    inclination_rad: float
    roll_deg: float
    pitch_deg: float

    @property
    def field_n_gauss(self) -> Array:
        """(3,) the field in magnetic north, east, down."""
        level, down = np.cos(self.inclination_rad), np.sin(self.inclination_rad)
        return self.total_gauss * np.array([level, 0.0, down])

    def tilts_rad(self) -> Array:
        """(9, 2) roll and pitch: level, and the limits of the tilt driven (at least 5 degrees)."""
        roll, pitch = np.clip([self.roll_deg, self.pitch_deg], _LEAST_TILT_DEG, _MOST_TILT_DEG)
        grid = np.array([(r, p) for r in (-roll, 0, roll) for p in (-pitch, 0, pitch)])
        return np.asarray(np.radians(grid))


def heading_error_curve(
    judged: Affine,
    truth: Affine,
    field_n_gauss: Array,
    *,
    roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
    headings: int = HEADINGS,
) -> Array:
    """(headings,) heading shown by `judged` minus true heading in degrees, at 0, 10, 20, ... deg.

    `field_n_gauss` (3,) is in the units that `truth` produces.
    """
    heading = np.linspace(0, 2 * np.pi, headings, endpoint=False)
    pitch, roll = np.full(headings, pitch_rad), np.full(headings, roll_rad)
    R_nb = so3.from_yaw_pitch_roll(heading, pitch, roll)
    raw_b_gauss = truth.undo(np.einsum("kji,j->ki", R_nb, field_n_gauss))
    seen_n = np.einsum("kij,kj->ki", R_nb, judged.apply(raw_b_gauss))
    off = np.arctan2(seen_n[:, 1], seen_n[:, 0]) - np.arctan2(field_n_gauss[1], field_n_gauss[0])
    return np.asarray(-np.degrees(np.arctan2(np.sin(off), np.cos(off))))


def worst_difference_deg(judged: Affine, truth: Affine, envelope: Envelope) -> float:
    """Largest |heading difference| over all headings and the envelope's tilts; nan if unknown."""
    curves = [
        heading_error_curve(judged, truth, envelope.field_n_gauss, roll_rad=roll, pitch_rad=pitch)
        for roll, pitch in envelope.tilts_rad().tolist()
    ]
    return float(np.max(np.abs(curves)))


# -- The candidate and the calibration in force ----------------------------------------------------

_NAN = float("nan")
_VERTICAL_SEEN_DEG = 8.0  # half-range of roll or pitch that determines the vertical
_BIAS_FLOOR_RAD_S = 3e-4  # smaller changes of the bias count as this one
_LEAST_NOISE_GAUSS = 2e-4
_FACTORY = 1e-6
_ROUGH_M_S2 = 0.5  # rms of |force| - gravity above which a segment's dip is not compared


def heading_envelope(motion: Coverage, field: FieldFacts, world: WorldField | None) -> Envelope:
    """Conditions for predicted errors: the measured field (dip from the world model if there is
    one) and the tilts driven."""
    dip = np.radians(field.inclination_deg) if world is None else world.inclination_rad
    return Envelope(field.mean_gauss, float(dip), motion.roll_deg, motion.pitch_deg)


def field_facts(nodes: Nodes, correction: Affine) -> FieldFacts:
    """Facts about the corrected field of all segments."""
    h_b = correction.apply(nodes.raw_b_gauss)
    size = np.linalg.norm(h_b, axis=1)
    sine = np.sum(h_b * nodes.down_b, axis=1) / size
    dip_deg = nodes.mean(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))
    calm = dip_deg[nodes.rough_m_s2 < _ROUGH_M_S2]
    temperatures = np.array([t.segment.temperature_c for t in nodes.tracks])
    return FieldFacts(
        mean_gauss=float(np.mean(size)),
        min_gauss=float(np.min(size)),
        max_gauss=float(np.max(size)),
        spread=float(np.std(size) / np.mean(size)),
        inclination_deg=float(np.median(calm)) if len(calm) else float("nan"),
        wander_gauss=_largest_deviation(nodes.mean(size)),
        inclination_wander_deg=_largest_deviation(calm),
        temperature_range_c=float(np.ptp(temperatures)),
    )


def _largest_deviation(values: Array) -> float:
    return float(np.max(np.abs(values - np.median(values)))) if len(values) else float("nan")


def match_scale(model: Affine, correction: Affine) -> Affine:
    """`correction` scaled to the determinant of `model`: same headings, field units of `model`."""
    scale = np.cbrt(np.linalg.det(model.matrix) / np.linalg.det(correction.matrix))
    return Affine(scale * correction.matrix, correction.offset)


def proposed_correction(estimate: Estimate, present: Affine) -> Affine:
    """The estimate's correction; in the scale of `present` if the field is not known."""
    if estimate.field_known:
        return estimate.correction
    return match_scale(present, estimate.correction)


def compare_with_world(field: FieldFacts, world: WorldField | None) -> WorldFacts | None:
    """Magnitude and dip compared with the world model; None without a position."""
    if world is None:
        return None
    return WorldFacts(
        magnitude_error=abs(field.mean_gauss / world.total_gauss - 1.0),
        inclination_error_deg=abs(field.inclination_deg - float(np.degrees(world.inclination_rad))),
    )


def refit_facts(
    nodes: Nodes | None,
    judged: Affine,
    present: Affine,
    estimate: Estimate,
    *,
    where: Envelope,
    halves: tuple[Affine, Affine] | None,
) -> RefitFacts:
    """Compare fits of two halves with each other, and the magnitude fit with the candidate."""
    if nodes is None:
        return RefitFacts(_NAN, _NAN, _NAN)
    averaged = nodes.tracks[0].segment.averaged
    sigma_gauss = max(estimate.noise_mag_gauss / np.sqrt(averaged), _LEAST_NOISE_GAUSS)
    opinion = fit_magnitude(nodes, present, sigma_gauss)
    a, b = halves or _half_fits(nodes, present, sigma_gauss)
    second = _NAN if opinion is None else worst_difference_deg(opinion, judged, where)
    if a is None or b is None:
        return RefitFacts(_NAN, _NAN, second)
    offset_difference = a.offset - b.offset
    down = _mean_down(nodes)
    return RefitFacts(
        hard_iron_gauss=float(
            np.linalg.norm(offset_difference - (offset_difference @ down) * down)
        ),
        halves_deg=worst_difference_deg(match_scale(judged, a), match_scale(judged, b), where),
        second_opinion_deg=second,
    )


def change_facts(
    nodes: Nodes | None,
    judged: Affine,
    present: Affine,
    motion: Coverage,
    *,
    where: Envelope,
    world: WorldField | None,
) -> ChangeFacts:
    """Facts about the proposed calibration, and about its change."""
    C = judged.matrix
    ratio = np.cbrt(np.linalg.det(C) / np.linalg.det(present.matrix))
    vertical_change = _NAN
    if nodes is not None and np.isfinite(motion.roll_deg):
        flat = max(motion.roll_deg, motion.pitch_deg) < _VERTICAL_SEEN_DEG
        vertical_change = (
            abs(float((judged.offset - present.offset) @ _mean_down(nodes))) if flat else 0.0
        )
    factory = np.allclose(present.matrix, np.eye(3), atol=_FACTORY) and np.allclose(
        present.offset, 0.0, atol=_FACTORY
    )
    return ChangeFacts(
        first_calibration=bool(factory),
        eigenvalue_min=float(np.linalg.eigvalsh((C + C.T) / 2)[0]),
        condition=float(np.linalg.cond(C)),
        diagonal_min=float(np.min(np.diag(C))),
        diagonal_max=float(np.max(np.diag(C))),
        offset_gauss=float(np.linalg.norm(judged.offset)),
        scale_change=float(abs(ratio - 1.0)) if world is None else 0.0,
        moved_unseen_gauss=vertical_change,
        step_deg=worst_difference_deg(present, judged, where),
    )


def gyro_facts(estimate: Estimate, present_b_rad_s: Array, still: Rest) -> GyroFacts:
    """Compare the estimate's gyro bias with the mean rate at rest."""
    bias = estimate.gyro_bias_rad_s
    written = max(float(np.linalg.norm(bias - present_b_rad_s)), _BIAS_FLOOR_RAD_S)
    own, apart = estimate.sigma[9:12], np.abs(bias - still.rate_b_rad_s)
    return GyroFacts(
        bias_rad_s=float(np.linalg.norm(bias)),
        rest_s=still.duration_s,
        sigma_share=still.sigma_rad_s / written,
        disagreement=float(np.max(apart / np.hypot(own, still.sigma_rad_s))),
        apart_mrad_s=1e3 * float(np.max(apart)),
        sigma_mrad_s=1e3 * float(np.max(own)),
    )


def _half_fits(
    nodes: Nodes, present: Affine, sigma_gauss: float
) -> tuple[Affine | None, Affine | None]:
    """Fits of the earlier and later half of all turning: a drift makes them differ."""
    turned = np.cumsum([t.segment.turned_rad for t in nodes.tracks])
    early: Bools = turned <= turned[-1] / 2
    first, second = nodes.select(early), nodes.select(~early)
    if first is None or second is None:
        return None, None
    return fit_with_gyro(first, present, sigma_gauss), fit_with_gyro(second, present, sigma_gauss)


def _mean_down(nodes: Nodes) -> Array:
    mean = np.mean(nodes.down_b, axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


_LEAST_TURN_DEG = 60.0  # a held-out segment that turned less cannot show a heading error


class EvidenceCollector:
    """Bounded history of the stream, by which an estimate is evaluated. Deterministic."""

    def __init__(self, parameters: HistoryParameters | None = None) -> None:
        self._history = SegmentHistory(parameters)
        self._tracks: dict[
            int, AttitudeTrack
        ] = {}  # integrated again after a large change of the gyro bias

    def role(self, block: SampleBlock) -> Role:
        """Role of a block that is to be added next: that of its first sample."""
        return self._history.role(block)

    def split(self, block: SampleBlock) -> list[tuple[Role, SampleBlock]]:
        """The block in parts that lie within one slot each, with their roles.

        A part has `gap_before` if the part before it had the other role.
        """
        return self._history.split(block)

    def add(self, block: SampleBlock) -> None:
        """Add a block, held out or not."""
        self._history.add(block)

    def finish(self) -> None:
        """End of the stream: close the open segment."""
        self._history.close_segment()

    def evaluate(
        self,
        estimate: Estimate,
        present: Affine,
        present_gyro_bias_rad_s: Array,
        world: WorldField | None,
        health: HealthFacts,
        basis: BasisFacts,
        *,
        proposed: Affine | None = None,
        halves: tuple[Affine, Affine] | None = None,
    ) -> Evidence:
        """Evaluate `proposed` on the stored history.

        `proposed`: default is the estimate's correction, in the scale of `present` if the field
        is not known (det A = 1 is a convention; the written registers keep the device's scale).
        `halves`: corrections from two disjoint halves of the data; None: they are fitted here.
        `present_gyro_bias_rad_s` (3,) is the bias that register 84 subtracts now.
        """
        judged = proposed or proposed_correction(estimate, present)
        nodes = self._nodes(estimate.gyro_bias_rad_s)
        motion, field, proof = UNKNOWN_MOTION, UNKNOWN_FIELD, NO_PROOF
        if nodes is not None:
            heading_rad = gyro_heading_rad(nodes, mean_field_0(nodes, judged))
            motion = motion_coverage(nodes, heading_rad, judged)
            field = field_facts(nodes, judged)
            proof = compare_heading_errors(nodes, heading_rad, judged, present, _LEAST_TURN_DEG)
        envelope = heading_envelope(motion, field, world)
        still = mean_rate_at_rest(self._history.segments)
        return Evidence(
            health=health,
            basis=basis,
            estimate=_estimate_facts(estimate),
            motion=motion,
            field=field,
            world=compare_with_world(field, world),
            proof=proof,
            refits=refit_facts(nodes, judged, present, estimate, where=envelope, halves=halves),
            change=change_facts(nodes, judged, present, motion, where=envelope, world=world),
            gyro=gyro_facts(estimate, present_gyro_bias_rad_s, still),
        )

    def _nodes(self, bias_b_rad_s: Array) -> Nodes | None:
        """Update every segment's attitude to this gyro bias, and join them."""
        tracks = {}
        for segment in self._history.segments:
            old = self._tracks.get(segment.number)
            usable = old is not None and old.usable_for(bias_b_rad_s)
            tracks[segment.number] = (
                old if old and usable else integrate_attitude(segment, bias_b_rad_s)
            )
        self._tracks = tracks
        return join_tracks(list(tracks.values()), np.asarray(bias_b_rad_s))


def _estimate_facts(estimate: Estimate) -> EstimateFacts:
    return EstimateFacts(
        estimate.converged,
        estimate.observability.unobservable,
        float(estimate.observability.score),
        float(estimate.heading_sigma_deg),
        estimate.widened_by,
        float(estimate.place_deg),
    )
