"""A recording next to a simulation of the user's: what both have, and what only one of them has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ahrsd.diagnosis.answer.diagnosis import (
    Contribution,
    Diagnosis,
    Drawn,
    Finding,
    Unexplained,
    Value,
    Where,
)
from ahrsd.diagnosis.answer.text import verdict
from ahrsd.diagnosis.external_simulation import align, remove_common_findings
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import Track

TIME_S = np.arange(0.0, 200.0, 0.1)
JUMP = np.array([0.02, 0.01, -0.015])


def step(onset_s, jump=JUMP, std=2e-4):
    """A step of the hard iron as a finding, and what it adds to the readings."""
    finding = Finding(
        "hard_iron_step",
        1.0,
        (),
        Where(((onset_s, 200.0),), ("x", "y", "z"), "sensor"),
        tuple(Value(f"step_{a}", float(v), std, "gauss") for a, v in zip("xyz", jump, strict=True)),
        None,
        None,
        None,
        setting={"onset_s": onset_s},
        term=0,
    )
    return finding, np.where(TIME_S[:, None] < onset_s, 0.0, 1.0) * jump


def found(*steps, unexplained=None, noise_gauss=1e-3, p_value=1e-80):
    """A diagnosis with these findings, in their order."""
    added = tuple(Contribution(one.effect, TIME_S, field, "gauss") for one, field in steps)
    none = np.zeros((len(TIME_S), 3))
    left = unexplained or Unexplained(False)
    return Diagnosis(
        recording="dive.csv",
        baseline=None,
        mismatch=bool(steps) or left.detected,
        p_value=p_value if steps or left.detected else 1.0,
        findings=tuple(replace(one, term=k) for k, (one, _) in enumerate(steps)),
        unexplained=left,
        posterior_predictive={},
        model=NullModel(np.eye(3), np.zeros(3), np.zeros(3), noise_gauss, 5e-3),
        drawn=Drawn(TIME_S, none, none, none, none, added, (), {}),
    )


def effects(one):
    return [finding.effect for finding in one.findings]


def unknown(direction, sign=1.0, frequency=0.2):
    course = tuple((float(t), float(sign * 5e-3 * np.sin(frequency * t))) for t in range(200))
    where = Where(((0.0, 200.0),), ("x", "y", "z"), "sensor", direction=direction)
    return Unexplained(True, where, size=5e-3, unit="gauss", course=course)


def test_step_that_both_have_is_no_difference_and_the_probability_says_so():
    left = remove_common_findings(found(step(60.0)), found(step(60.3, 1.01 * JUMP)), "")
    assert effects(left) == []
    assert not left.mismatch
    assert left.p_value == 1.0
    assert "hard_iron_step is in the simulation already, to the same size" in left.notes


def test_same_step_at_another_time_stays_and_the_simulation_s_is_told():
    left = remove_common_findings(found(step(60.0)), found(step(140.0)), "")
    assert effects(left) == ["hard_iron_step"]
    assert left.mismatch
    note = next(note for note in left.notes if note.startswith("hard_iron_step is in the"))
    assert "differs" in note
    assert "140.0-200.0 s" in note


def test_step_of_another_size_stays_and_the_simulation_s_size_is_told():
    left = remove_common_findings(found(step(60.0)), found(step(60.0, 2.0 * JUMP)), "")
    assert effects(left) == ["hard_iron_step"]
    assert any("but differs" in note and "step_x = 0.04" in note for note in left.notes)


def test_two_steps_are_compared_one_by_one():
    real = found(step(60.0), step(140.0))
    assert effects(remove_common_findings(real, found(step(140.0), step(60.0)), "")) == []
    left = remove_common_findings(real, found(step(140.0)), "")
    assert [finding.setting["onset_s"] for finding in left.findings] == [60.0]


def test_weak_step_whose_size_is_uncertain_is_the_same_with_another_direction():
    weak, other = step(60.0, 0.1 * JUMP, 9e-4), step(60.0, 0.1 * np.roll(JUMP, 1) ** 2 / 0.02, 9e-4)
    assert effects(remove_common_findings(found(weak), found(other), "")) == []


def test_effect_of_the_simulation_alone_gives_its_size_and_its_probability():
    left = remove_common_findings(found(), found(step(60.0), p_value=1e-9), "")
    assert left.mismatch
    assert left.p_value == 1e-9
    assert verdict(left).endswith("(p = 1e-09)")
    assert any("does not show it: step_x = 0.02" in note for note in left.notes)


@pytest.mark.parametrize(("sign", "frequency", "differs"), [(-1, 0.2, False), (1, 0.5, True)])
def test_unknown_cause_is_no_difference_if_the_simulation_has_it(sign, frequency, differs):
    real = found(unexplained=unknown((0.6, 0.0, 0.8)))
    other = found(unexplained=unknown((0.6 * sign, 0.0, 0.8 * sign), sign, frequency))
    left = remove_common_findings(real, other, "")
    assert left.unexplained.detected == left.mismatch == differs
    assert any("unknown cause" in note for note in left.notes)


def test_unknown_cause_of_the_simulation_alone_is_a_difference():
    left = remove_common_findings(found(), found(unexplained=unknown((1.0, 0.0, 0.0))), "")
    assert left.mismatch
    assert not left.unexplained.detected


def test_noise_and_soft_iron_of_both_are_told():
    real = found()
    iron = replace(real.model, soft_iron=np.diag([1.08, 1.0, 0.93]), sigma_mag_gauss=4e-3)
    (note,) = remove_common_findings(replace(real, model=iron), found(), "").notes
    assert "soft iron up to 8.00%" in note
    assert "noise of a sample: 4 mG and 5 mrad/s, of the simulation 1 mG and 5 mrad/s" in note


def turning():
    """(N, 3) rates of a motion."""
    return np.stack([np.sin(0.7 * TIME_S), np.cos(0.31 * TIME_S), np.sin(0.13 * TIME_S)], axis=1)


def track_of(rates):
    dt_s = np.diff(TIME_S, prepend=np.nan)
    return Track(TIME_S, dt_s, np.ones_like(rates), rates, None, runs=(slice(0, len(TIME_S)),))


def test_simulation_in_other_axes_is_a_difference():
    rates = turning()
    assert align(track_of(rates), track_of(rates)).other_axes == ""
    overlap = align(track_of(rates), track_of(rates[:, [1, 0, 2]] * [1.0, 1.0, -1.0]))
    assert overlap.other_axes == (
        "its +y is the recording's x, its +x is the recording's y, its -z is the recording's z"
    )
    left = remove_common_findings(found(), found(), overlap.other_axes)
    assert left.mismatch
    assert left.p_value == 0.0
    assert left.notes == (f"the simulation has other axes: {overlap.other_axes}",)


def test_negated_axis_that_hardly_turns_is_a_difference():
    """The roll of a boat: without it the two motions correlate by more than 0.9."""
    rates = turning() * [0.15, 0.05, 1.0]
    overlap = align(track_of(rates), track_of(rates * [-1.0, 1.0, 1.0]))
    assert overlap.other_axes == (
        "its -x is the recording's x, its +y is the recording's y, its +z is the recording's z"
    )
    swapped = align(track_of(rates), track_of(rates[:, [1, 0, 2]])).other_axes
    assert swapped == (
        "its +y is the recording's x, its +x is the recording's y, its +z is the recording's z"
    )


def test_opposite_cross_axis_errors_are_no_other_axes():
    noise = 0.01 * np.random.default_rng(1).normal(size=(2, len(TIME_S), 3))
    rates = turning() * [0.0, 0.1, 1.0]
    leak = np.outer(rates[:, 2], [0.03, 0.0, 0.0])
    overlap = align(track_of(rates + leak + noise[0]), track_of(rates - leak + noise[1]))
    assert overlap.other_axes == ""
    still = align(track_of(rates), track_of(turning() * [0.1, 0.1, 1.0]))
    assert still.other_axes == ""


def test_axis_that_cannot_be_told_by_its_rate_is_not_named():
    rates = turning()
    c, s = np.cos(np.radians(50.0)), np.sin(np.radians(50.0))
    turned = rates @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, -1.0]])
    words = align(track_of(rates), track_of(turned)).other_axes
    assert words == "its -z is the recording's z"
