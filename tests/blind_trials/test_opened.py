"""Cases of opened rings that were wrong once, made again by their seeds and answered.

No proof, since they were looked at; they hold what was mended.
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
def test_what_nobody_logged_is_an_unknown_without_a_name(case, frame, tmp_path):
    found, truth = answered("ring120b", case, tmp_path)
    assert truth["kind"] in ("withheld", "outside")
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == frame


@pytest.mark.slow
def test_coarse_steps_are_named_and_nothing_rings_beside_them(tmp_path):
    found, truth = answered("ring300b", "196ca98c", tmp_path)
    (named,) = found.findings
    assert [named.effect] == truth["effects"][0]["right"]
    step = truth["effects"][0]["parameters"][0]["value"]
    assert named.parameters[0].value == pytest.approx(step, rel=1e-3)
    assert not found.unexplained.detected


@pytest.mark.slow
def test_coarse_steps_that_repeat_are_not_stuck(tmp_path):
    found, _ = answered("ring600b", "f51c6850", tmp_path)
    assert [one.effect for one in found.findings] == ["mag_quantisation"]


@pytest.mark.slow
def test_bursts_have_no_name_of_something_that_passes(tmp_path):
    found, _ = answered("ring600b", "5f89b619", tmp_path)
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.p_value < 1e-6


@pytest.mark.slow
def test_a_steady_line_is_named_though_its_copies_are_itself(tmp_path):
    """A pump that runs evenly: moved in time, a line explains as much as before."""
    found, _ = answered("ring600b", "5d716fae", tmp_path)
    assert [one.effect for one in found.findings] == ["ac_interference", "mag_time_lag"]
    assert min(one.confidence for one in found.findings) > 0.5


@pytest.mark.slow  # a shorter form: diagnosis/innovation_filter/test_noise
@pytest.mark.parametrize("case", ["9e11d227", "ccdde21f"])
def test_bursts_of_noise_leave_no_unknown(case, tmp_path):
    found, _ = answered("ring600b", case, tmp_path)
    assert [one.effect for one in found.findings] == ["noise_burst"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_a_spin_with_a_coarse_gyro_names_nothing(tmp_path):
    """The field's own noise was hysteresis of 30 mG."""
    found, truth = answered("ring600b", "8d9dc4b5", tmp_path)
    assert truth["kind"] == "unidentifiable"
    assert found.findings == ()
