"""The two independent fits: they find the truth, and hold what the motion does not determine."""

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.evidence.collector import Envelope, heading_error_curve, worst_difference_deg
from ahrsd.evidence.second_opinions import fit_magnitude, fit_with_gyro
from ahrsd.evidence.segments import SegmentHistory, integrate_attitude, join_tracks

DIP = np.radians(60.0)


def nodes_of(world, scene):
    history = SegmentHistory()
    for _, part in history.split(scene.block()):
        history.add(part)
    history.close_segment()
    return join_tracks([integrate_attitude(s, world.BIAS) for s in history.segments], world.BIAS)


def worst(fit, world, tilt):
    return worst_difference_deg(fit, world.truth(), Envelope(0.5, DIP, tilt, tilt))


@pytest.mark.parametrize("fit", [fit_with_gyro, fit_magnitude])
@pytest.mark.parametrize("noise", [0.0005, 0.005])
def test_rich_motion_gives_the_truth_from_the_factory_setting(world, fit, noise) -> None:
    found = fit(nodes_of(world, world.Scene(noise_gauss=noise)), Affine.identity(), noise / 1.4)
    assert worst(found, world, 35.0) < 0.03 + 50 * noise
    np.testing.assert_allclose(found.offset, world.HARD, atol=2e-4 + 0.2 * noise)
    np.testing.assert_allclose(found.matrix, world.truth().matrix, atol=2e-3 + noise)


@pytest.mark.parametrize(("fit", "limit"), [(fit_with_gyro, 0.1), (fit_magnitude, 0.7)])
def test_level_motion_gives_the_heading_and_holds_the_vertical(world, fit, limit) -> None:
    nodes = nodes_of(world, world.Scene(roll_deg=1.0, pitch_deg=1.0))
    present = Affine(np.eye(3), np.array([0.0, 0.0, world.HARD[2]]))
    found = fit(nodes, present, 0.00035)
    assert worst(found, world, 5.0) < limit
    assert found.offset[2] == pytest.approx(world.HARD[2], abs=0.03)
    np.testing.assert_allclose(found.offset[:2], world.HARD[:2], atol=2e-3)


def test_scale_of_the_present_calibration_is_kept(world) -> None:
    nodes = nodes_of(world, world.Scene())
    for fit in (fit_with_gyro, fit_magnitude):
        found = fit(nodes, Affine(1.3 * np.eye(3), np.zeros(3)), 0.00035)
        assert np.linalg.det(found.matrix) == pytest.approx(1.3**3, rel=1e-9)


def test_noise_biases_towards_the_present_calibration_and_not_zero(world) -> None:
    """Exactly level motion: only noise and the calibration in force inform the vertical."""
    noise = 0.005
    nodes = nodes_of(world, world.Scene(noise_gauss=noise, roll_deg=0.0, pitch_deg=0.0))
    present = Affine(np.diag([1.0, 1.0, 1.2]), world.HARD)
    known = fit_with_gyro(nodes, present, noise / np.sqrt(2))
    denied = fit_with_gyro(nodes, present, 1e-5)
    shares = [f.matrix[2, 2] / f.matrix[:2, :2].trace() for f in (known, denied)]
    assert shares[0] == pytest.approx(0.6, abs=0.03)
    assert shares[1] < 0.52
    level = heading_error_curve(known, world.truth(), np.array([0.25, 0.0, 0.433]))
    assert np.max(np.abs(level)) < 0.5
    np.testing.assert_allclose(known.offset, world.HARD, atol=0.02)


def test_step_of_the_iron_between_the_halves_is_detected(world) -> None:
    def step(t):
        return 0.02 * (t > 165)[:, None] * np.array([1.0, 0.0, 0.0])

    seen = world.evidence(world.Scene(magnet=step)).refits
    assert seen.hard_iron_gauss == pytest.approx(0.02, abs=0.006)
    assert seen.halves_deg > 2.0
    assert world.evidence(world.Scene()).refits.halves_deg < 0.1


def test_halves_of_the_estimator_can_be_used(world) -> None:
    a = world.truth()
    b = Affine(a.matrix, a.offset + np.array([0.01, 0.0, 0.0]))
    seen = world.evidence(world.Scene(roll_deg=1, pitch_deg=1), halves=(a, b)).refits
    assert seen.hard_iron_gauss == pytest.approx(0.01, abs=1e-5)
    assert seen.halves_deg == pytest.approx(np.degrees(0.01 / 0.25), rel=0.2)


def test_single_segment_has_no_halves(world) -> None:
    assert np.isnan(world.evidence(world.Scene(duration_s=29.0)).refits.halves_deg)


def test_magnitude_fit_that_is_no_ellipsoid_is_refused(world) -> None:
    nodes = nodes_of(world, world.Scene(duration_s=60.0))
    rng = np.random.default_rng(3)
    nodes.raw_b_gauss[:] = rng.standard_normal(nodes.raw_b_gauss.shape)  # a ball, not a shell
    found = fit_magnitude(nodes, Affine.identity(), 1e-4)
    assert found is None or worst(found, world, 5.0) > 10.0
