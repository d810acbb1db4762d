"""Cases of opened rings that were once answered wrongly, generated again from their seeds.

They are no proof, because they have been looked at; they keep what was corrected.
"""

from __future__ import annotations

import pytest
from blind_trials.world.__main__ import case_ids, make_one
from blind_trials.world.rings import orders

from ahrsd.offline.diagnose import diagnose_recording

#: ring -> cases, seed
RINGS = {
    "ring120b": (120, 3171823325885559521),
    "ring300b": (300, 7839750651448068454),
    "ring600b": (600, 5572676686222521739),
}


def answered(ring, case, folder):
    """The diagnosis of a case, and its truth."""
    cases, seed = RINGS[ring]
    number = case_ids(cases, seed).index(case)
    order = orders("full", cases, seed)[number]
    truth = make_one("full", order, [seed, number], folder / case, None)
    made = folder / case
    return diagnose_recording(made / "case.csv.gz", spec=made / "spec.json"), truth


@pytest.mark.slow  # a shorter form: test_scales, test_rivals
@pytest.mark.parametrize(
    ("case", "frame"),
    [
        ("66152208", "world"),  # a gradient without a position was a step at the first row
        ("d1e56b7a", "sensor"),  # iron with two states had an object passed by beside it
    ],
)
def test_unlogged_cause_is_unknown_without_a_finding(case, frame, tmp_path):
    found, truth = answered("ring120b", case, tmp_path)
    assert truth["kind"] in ("withheld", "outside")
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == frame


@pytest.mark.slow
def test_quantisation_is_found_without_a_false_line(tmp_path):
    found, truth = answered("ring300b", "196ca98c", tmp_path)
    (named,) = found.findings
    assert [named.effect] == truth["effects"][0]["right"]
    step = truth["effects"][0]["parameters"][0]["value"]
    assert named.parameters[0].value == pytest.approx(step, rel=1e-3)
    assert not found.unexplained.detected


@pytest.mark.slow
def test_repeated_coarse_values_are_not_a_stuck_sensor(tmp_path):
    found, _ = answered("ring600b", "f51c6850", tmp_path)
    assert [one.effect for one in found.findings] == ["mag_quantisation"]


@pytest.mark.slow
def test_bursts_are_not_attributed_to_a_passing_object(tmp_path):
    found, _ = answered("ring600b", "5f89b619", tmp_path)
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.p_value < 1e-6


@pytest.mark.slow
def test_steady_line_is_found_although_its_shifted_copies_fit_as_well(tmp_path):
    """A pump at constant speed: shifted in time, the line explains as much as before."""
    found, _ = answered("ring600b", "5d716fae", tmp_path)
    assert [one.effect for one in found.findings] == ["ac_interference", "mag_time_lag"]
    assert min(one.confidence for one in found.findings) > 0.5


@pytest.mark.slow  # a shorter form: diagnosis/innovation_filter/test_noise
@pytest.mark.parametrize("case", ["9e11d227", "ccdde21f"])
def test_noise_bursts_leave_no_unknown_cause(case, tmp_path):
    found, _ = answered("ring600b", case, tmp_path)
    assert [one.effect for one in found.findings] == ["noise_burst"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_spin_with_a_coarse_gyro_has_no_finding(tmp_path):
    """The noise of the field was once reported as a hysteresis of 30 mG."""
    found, truth = answered("ring600b", "8d9dc4b5", tmp_path)
    assert truth["kind"] == "unidentifiable"
    assert found.findings == ()
