"""Figures of the report: the map by regime, the contribution of each term, the gain of all
findings.
"""

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference.diagnose import diagnose


def answer(*effects, seed=3):
    one = made(Trial(seed, tuple(effects), samples=8_000, rate_hz=25.0))
    return diagnose(one.track), one


@pytest.mark.slow
def test_field_by_position_is_in_the_regime_map_before_and_not_after():
    found, _ = answer(("field_gradient", 1.0))
    maps = {one.quantity: one for one in found.regime_map}
    assert max(max(maps[f"position_{axis}_m"].before) for axis in ("north", "east", "down")) > 50.0
    assert [max(one.before) for one in found.regime_map] == sorted(
        (max(one.before) for one in maps.values()), reverse=True
    )
    after = np.concatenate([one.after for one in found.regime_map])
    # half a chi-squared of 3: mean 1.5, deviation 1.2; more than a hundred bins are correlated
    assert after.mean() == pytest.approx(1.5, abs=0.5)
    assert after.max() < 10.0
    assert len(maps["heading_deg"].after) == 12
    assert len(maps["heading_deg"].edges) == 13
    told = found.to_json()["regime_map"][0]
    assert told["before"] == list(found.regime_map[0].before)


@pytest.mark.slow
def test_figures_before_and_after_are_equal_when_nothing_is_found():
    found, _ = answer()
    assert found.validation.named == found.validation.free == 0.0
    assert all(one.before == one.after for one in found.regime_map)
    assert found.drawn.contributions == ()


@pytest.mark.slow
def test_every_finding_has_its_contribution_in_its_unit():
    found, one = answer(("hard_iron_step", 1.0), ("gyro_scale", 1.0))
    drawn = {x.effect: found.drawn.contributions[x.term] for x in found.findings}
    step, scale = drawn["hard_iron_step"], drawn["gyro_scale"]
    assert (step.effect, step.unit) == ("hard_iron_step", "gauss")
    assert (scale.effect, scale.unit) == ("gyro_scale", "rad/s")
    _, value, setting = one.truth[0]
    at = np.searchsorted(step.time_s, setting["onset_s"])
    np.testing.assert_array_equal(step.added[: at - 30], 0.0)
    later = step.added[at + 30 :]
    np.testing.assert_allclose(later, np.broadcast_to(value, later.shape), atol=1e-4)
    told = {x["effect"]: x["term"] for x in found.to_json()["findings"]}
    assert {k: found.terms[v].identifier for k, v in told.items()} == {k: k for k in told}


@pytest.mark.slow
def test_contribution_of_a_delay_has_its_full_size():
    found, _ = answer(("mag_time_lag", 3.0))  # 60 ms
    (lag,) = found.findings
    assert lag.parameters[0].value == pytest.approx(0.06, abs=2e-3)
    added = np.linalg.norm(found.drawn.contributions[lag.term].added, axis=1)
    assert added.max() > 5e-3  # half a gauss that turns by half a radian per second: 15 mG


@pytest.mark.slow
def test_held_out_gain_of_all_findings_is_between_the_largest_and_the_sum():
    """Without one of two findings the noise model absorbs a part of it."""
    found, _ = answer(("motor_current_field", 0.5), ("gyro_scale", 1.0))
    alone = [x.heldout.nll_gain_per_sample for x in found.findings]
    assert len(alone) == 2
    assert max(alone) < found.validation.named < sum(alone)
    assert found.validation.placebo == max(x.heldout.placebo_gain for x in found.findings)
    assert found.to_json()["validation"]["named"] == found.validation.named
