"""Which calibration a share applies, and the uncertainty of its heading, as conditions change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cabled_run import BIAS, IRON, estimate

from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock
from ahrsd.telemetry.feeds import QUALIFIED, REGISTERS, ChoiceFacts, Chooser
from ahrsd.writeback.composition import compose
from ahrsd.writeback.states import State

ONE = Affine.identity().to_register()
FACTORY = {23: ONE, 25: ONE, 84: ONE, 26: (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)}
PROPOSAL = compose(estimate(), FACTORY)
WRITTEN = {**FACTORY, **PROPOSAL.new}
NOW = ChoiceFacts("unit", FACTORY, State.QUALIFIED, PROPOSAL, estimate(), trusted=True)


def block(raw, registers):
    """One sample at rest with this raw field."""
    nothing = np.zeros((1, 3))
    times = np.zeros(1)
    return SampleBlock(times, times, times, np.array([raw]), np.array([BIAS]), nothing)


def test_registers_are_used_without_a_known_heading_before_an_estimate():
    nothing = replace(NOW, state=State.OBSERVING, proposal=None, estimate=None)
    found = Chooser(qualified=True).choose(nothing)
    assert (found.by, found.candidate, found.heading_sigma_deg) == (REGISTERS, None, None)
    mag, gyro, _ = found.vectors(block([0.2, 0.1, 0.4], FACTORY))
    assert mag[0].tolist() == pytest.approx([0.2, 0.1, 0.4])
    assert gyro[0].tolist() == pytest.approx(BIAS.tolist())


def test_qualified_candidate_is_applied():
    found = Chooser(qualified=True).choose(NOW)
    assert (found.by, found.candidate) == (QUALIFIED, PROPOSAL.id)
    assert found.heading_sigma_deg == pytest.approx(0.05, abs=1e-3)
    mag, gyro, _ = found.vectors(block(np.array([0.24, 0.0, 0.42]) + IRON, FACTORY))
    assert mag[0].tolist() == pytest.approx([0.24, 0.0, 0.42], abs=1e-6)
    assert gyro[0].tolist() == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_candidate_is_not_applied_when_only_registers_are_requested():
    found = Chooser(qualified=False).choose(NOW)
    assert (found.by, found.candidate) == (REGISTERS, None)
    # the level part of the iron across a level field of 0.4837 cos 60 deg
    worst = np.degrees(np.arcsin(np.hypot(*IRON[:2]) / (0.4837 / 2.0)))
    assert found.heading_sigma_deg == pytest.approx(worst, rel=0.01)
    one = block([0.2, 0.1, 0.4], FACTORY)
    assert found.vectors(one)[1][0].tolist() == pytest.approx(BIAS.tolist())
    assert found.levelling_rate(one)[0].tolist() == pytest.approx([0.0] * 3, abs=1e-9)


def test_registers_are_used_after_the_candidate_was_written():
    chooser = Chooser(qualified=True)
    chooser.choose(NOW)
    found = chooser.choose(replace(NOW, registers=WRITTEN, state=State.TRIAL))
    assert found.by == REGISTERS
    assert found.heading_sigma_deg == pytest.approx(0.05, abs=1e-3)
    mag, _, _ = found.vectors(block(np.array([0.24, 0.0, 0.42]) + IRON, WRITTEN))
    assert mag[0].tolist() == pytest.approx([0.24, 0.0, 0.42], abs=1e-6)


def test_closed_gate_does_not_withdraw_the_candidate():
    chooser = Chooser(qualified=True)
    chooser.choose(NOW)
    again = replace(NOW, state=State.CANDIDATE, proposal=None)
    assert chooser.choose(again).by == QUALIFIED
    lost = replace(again, state=State.RECONCILING, estimate=None)
    assert chooser.choose(lost).by == QUALIFIED  # the same device came back
    assert chooser.choose(lost).heading_sigma_deg is None


@pytest.mark.parametrize(
    "change",
    [
        {"state": State.ROLLED_BACK},
        {"state": State.LOCKED},
        {"state": State.FAULT},
        {"trusted": False},
        {"unit": "another"},
        {"registers": {**FACTORY, 84: WRITTEN[84]}},
        {"estimate": estimate(hard_iron_gauss=np.zeros(3))},
    ],
    ids=str,
)
def test_contradiction_withdraws_the_candidate_permanently(change):
    chooser = Chooser(qualified=True)
    chooser.choose(NOW)
    later = replace(NOW, state=State.CANDIDATE, proposal=None)
    assert chooser.choose(replace(later, **change)).by == REGISTERS
    assert chooser.choose(later).by == REGISTERS


@pytest.mark.parametrize(
    "change",
    [
        {"estimate": estimate(converged=False)},
        {"estimate": estimate(heading_sigma_deg=float("inf"))},
        {"trusted": False},
    ],
    ids=str,
)
def test_unconverged_estimate_gives_no_heading_sigma(change):
    found = Chooser(qualified=True).choose(replace(NOW, **change))
    assert found.heading_sigma_deg is None


def test_vectors_are_in_the_output_frame_of_the_device():
    turned = (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # x of the vehicle is y of the sensor
    known = replace(NOW, registers={**FACTORY, 26: turned}, state=State.OBSERVING, proposal=None)
    mag, _, _ = Chooser(qualified=True).choose(known).vectors(block([0.1, 0.2, 0.3], FACTORY))
    assert mag[0].tolist() == pytest.approx([0.2, -0.1, 0.3])
