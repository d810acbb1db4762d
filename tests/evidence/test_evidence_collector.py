"""The collector as the core uses it: determinism, cost, and missing data."""

import time

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.evidence.values import numbers


def evaluate(world, collector, estimate=None):
    return collector.evaluate(
        estimate or world.estimate(), world.old(), np.zeros(3), None, world.HEALTHY, world.SOUND
    )


def test_the_same_samples_give_the_same_numbers(world) -> None:
    one, two = (evaluate(world, world.collect(world.Scene())) for _ in range(2))
    assert list(numbers(one)) == list(numbers(two))
    assert len(list(numbers(one))) > 30


def test_numbers_do_not_depend_on_earlier_requests(world) -> None:
    """The attitude is integrated once with another bias; the first-order correction must not
    matter.
    """
    asked, fresh = world.collect(world.Scene()), world.collect(world.Scene())
    evaluate(
        world, asked, world.estimate(gyro_bias_rad_s=world.BIAS + np.array([5e-4, -5e-4, 5e-4]))
    )
    seen, direct = evaluate(world, asked), evaluate(world, fresh)
    for (path, a), (_, b) in zip(numbers(seen), numbers(direct), strict=True):
        assert a == pytest.approx(b, abs=5e-3, rel=5e-2), path


def test_nothing_is_known_before_the_first_segment(world) -> None:
    seen = evaluate(world, world.EvidenceCollector())
    assert seen.motion.regime == "none"
    assert seen.proof.windows == 0
    assert {"field.spread", "proof.rms_after_deg", "refits.halves_deg"} <= set(seen.unmeasured())


def test_step_is_that_between_the_registers(world) -> None:
    seen = world.evidence(world.Scene(roll_deg=1, pitch_deg=1), present=Affine.identity())
    assert seen.first_calibration
    assert seen.change.step_deg > 25.0  # 0.1 of iron on 0.25 level gauss
    assert world.evidence(world.Scene(), present=world.truth()).change.step_deg < 1e-6
    assert not world.evidence(world.Scene()).first_calibration


def test_change_of_the_vertical_counts_as_unseen_without_tilt(world) -> None:
    moved = Affine(world.truth().matrix, world.HARD + np.array([0.0, 0.0, 0.05]))
    flat = world.evidence(world.Scene(roll_deg=1, pitch_deg=1), moved)
    free = world.evidence(world.Scene(), moved)
    assert flat.change.moved_unseen_gauss == pytest.approx(0.05, abs=0.001)
    assert free.change.moved_unseen_gauss == 0.0


def test_evaluation_of_an_hour_takes_less_than_300_ms(world) -> None:
    """30 ms on the idle reference machine; ten times that is allowed on a busy one."""
    collector = world.collect(world.Scene(duration_s=3600.0))
    evaluate(world, collector)
    start = time.process_time()
    for _ in range(3):
        evaluate(world, collector)
    assert (time.process_time() - start) / 3 < 0.3
