"""Samples in, evidence for or against an estimate out.

The protocol with the core: cut a block with `parts`; `add` each part here, and give it to the
estimator only where its role is "train". A block that lies within one slot may be passed whole,
under `role(block)`.
"""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.evidence import comparison
from ahrsd.evidence.coverage import coverage
from ahrsd.evidence.heading import field_0, gyro_heading_rad, prove
from ahrsd.evidence.second_opinions import rest
from ahrsd.evidence.segments import (
    AttitudeTrack,
    HistoryParameters,
    Nodes,
    Role,
    SegmentHistory,
    nodes_at,
    track,
)
from ahrsd.evidence.values import (
    NO_PROOF,
    UNKNOWN_FIELD,
    UNKNOWN_MOTION,
    BasisFacts,
    EstimateFacts,
    Evidence,
    HealthFacts,
)
from ahrsd.samples import Array, SampleBlock
from ahrsd.world_field import WorldField

_LEAST_TURN_DEG = 60.0  # a held-out segment that turned less cannot show a heading error


class EvidenceCollector:
    """Bounded memory of the stream, and the judgement of an estimate by it.  Deterministic."""

    def __init__(self, parameters: HistoryParameters | None = None) -> None:
        self._history = SegmentHistory(parameters)
        self._tracks: dict[int, AttitudeTrack] = {}  # again when the gyro bias moves far

    def role(self, block: SampleBlock) -> Role:
        """Role of a block that is about to be added (that of its first sample)."""
        return self._history.role(block)

    def parts(self, block: SampleBlock) -> list[tuple[Role, SampleBlock]]:
        """The block in pieces that lie within one slot each, with their roles.

        A piece has `gap_before` where the piece before it had the other role.
        """
        return self._history.parts(block)

    def add(self, block: SampleBlock) -> None:
        """Remember a block, held out or not."""
        self._history.add(block)

    def finish(self) -> None:
        """End of the stream: count the segment that is still open."""
        self._history.interrupt()

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
        """Judge `proposed` by what is remembered.

        `proposed`: default is the estimate's correction, in the scale of `present` where the
        field is not known (det A = 1 is a convention; what is written keeps the device's scale).
        `halves`: corrections from two disjoint halves of the data; without them they are fitted
        here. `present_gyro_bias_rad_s` (3,) is what register 84 takes off now.
        """
        judged = proposed or comparison.proposed_by(estimate, present)
        nodes = self._nodes(estimate.gyro_bias_rad_s)
        motion, field, proof = UNKNOWN_MOTION, UNKNOWN_FIELD, NO_PROOF
        if nodes is not None:
            heading_rad = gyro_heading_rad(nodes, field_0(nodes, judged))
            motion = coverage(nodes, heading_rad, judged)
            field = comparison.field_facts(nodes, judged)
            proof = prove(nodes, heading_rad, judged, present, _LEAST_TURN_DEG)
        envelope = comparison.envelope(motion, field, world)
        still = rest(self._history.segments)
        return Evidence(
            health=health,
            basis=basis,
            estimate=_facts(estimate),
            motion=motion,
            field=field,
            world=comparison.against_world(field, world),
            proof=proof,
            refits=comparison.refits(
                nodes, judged, present, estimate, where=envelope, halves=halves
            ),
            change=comparison.change(nodes, judged, present, motion, where=envelope, world=world),
            gyro=comparison.gyro(estimate, present_gyro_bias_rad_s, still),
        )

    def _nodes(self, bias_b_rad_s: Array) -> Nodes | None:
        """Bring every segment's attitude up to date with the bias, and join them."""
        tracks = {}
        for segment in self._history.segments:
            old = self._tracks.get(segment.number)
            usable = old is not None and old.usable_for(bias_b_rad_s)
            tracks[segment.number] = old if old and usable else track(segment, bias_b_rad_s)
        self._tracks = tracks
        return nodes_at(list(tracks.values()), np.asarray(bias_b_rad_s))


def _facts(estimate: Estimate) -> EstimateFacts:
    return EstimateFacts(
        estimate.converged,
        estimate.observability.unobservable,
        float(estimate.observability.score),
        float(estimate.heading_sigma_deg),
    )
