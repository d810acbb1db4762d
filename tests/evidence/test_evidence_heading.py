"""Predicted heading differences compared with the textbook, and the heading proof with known
errors.
"""

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.evidence.collector import Envelope, heading_error_curve, worst_difference_deg
from ahrsd.evidence.coverage import turn_advice
from ahrsd.evidence.heading import SECTORS, visited_sectors

LEVEL = np.array([0.25, 0.0, 0.433])


def test_hard_iron_error_causes_a_semicircular_deviation() -> None:
    """Residual iron e along x, towards heading psi: tan(error) = e sin psi / (H + e cos psi)."""
    e = 0.01
    curve = heading_error_curve(Affine(np.eye(3), np.array([-e, 0, 0])), Affine.identity(), LEVEL)
    psi = np.radians(np.arange(0, 360, 10))
    np.testing.assert_allclose(
        curve, -np.degrees(np.arctan2(e * np.sin(psi), 0.25 + e * np.cos(psi))), atol=1e-9
    )


def test_soft_iron_error_causes_a_quadrantal_deviation() -> None:
    """Scales 1+s, 1-s on the axes: shown heading atan((1-s)/(1+s) tan psi)."""
    s = 0.02
    judged = Affine(np.diag([1 + s, 1 - s, 1.0]), np.zeros(3))
    curve = heading_error_curve(judged, Affine.identity(), LEVEL)
    psi = np.radians(np.arange(0, 360, 10))
    shown = np.arctan2((1 - s) * np.sin(psi), (1 + s) * np.cos(psi))
    expected = np.degrees(np.arctan2(np.sin(shown - psi), np.cos(shown - psi)))
    np.testing.assert_allclose(curve, expected, atol=1e-9)


def test_vertical_hard_iron_matters_only_when_tilted() -> None:
    judged, truth = Affine(np.eye(3), np.array([0, 0, 0.05])), Affine.identity()
    assert np.max(np.abs(heading_error_curve(judged, truth, LEVEL))) < 1e-9
    tilted = heading_error_curve(judged, truth, LEVEL, roll_rad=np.radians(10))
    assert np.max(np.abs(tilted)) == pytest.approx(
        np.degrees(np.arcsin(0.05 * np.sin(np.radians(10)) / 0.25)), rel=1e-3
    )


def test_declination_and_scale_do_not_matter() -> None:
    turned = np.array([0.25 * np.cos(0.3), 0.25 * np.sin(0.3), 0.433])
    big = Affine(3.0 * np.eye(3), np.zeros(3))
    np.testing.assert_allclose(heading_error_curve(big, Affine.identity(), turned), 0.0, atol=1e-9)


def test_worst_difference_uses_the_driven_tilt() -> None:
    judged, truth = Affine(np.eye(3), np.array([0, 0, 0.05])), Affine.identity()
    total, dip = float(np.linalg.norm(LEVEL)), float(np.arctan2(0.433, 0.25))
    flat = worst_difference_deg(judged, truth, Envelope(total, dip, 0.0, 0.0))
    steep = worst_difference_deg(judged, truth, Envelope(total, dip, 30.0, 0.0))
    assert flat == pytest.approx(1.4, abs=0.1)  # 5 deg of tilt each way, at the least
    assert steep == pytest.approx(6.0, abs=0.3)
    assert np.isnan(worst_difference_deg(judged, truth, Envelope(total, dip, np.nan, 0.0)))


def test_proof_has_the_size_of_a_known_error(world) -> None:
    """Flat circles; iron e along x: deviation amplitude asin(e/H), rms 1/sqrt 2 of it."""
    scene = world.Scene(roll_deg=0.5, pitch_deg=0.5)
    truth = world.truth()
    shift = 0.02
    wrong = Affine(truth.matrix, truth.offset + world.SOFT @ np.array([shift, 0.0, 0.0]))
    seen = world.evidence(scene, truth, present=wrong).proof
    amplitude = np.degrees(shift / (0.5 * np.cos(world.DIP)))
    assert seen.windows == 2
    assert seen.rms_before_deg == pytest.approx(amplitude / np.sqrt(2), rel=0.05)
    assert seen.rms_after_deg < 0.1
    assert seen.max_after_deg < 0.3
    assert seen.closure_deg < 0.2
    assert 0.8 * seen.rms_before_deg < seen.gain_lower_deg < seen.rms_before_deg


def test_closure_shows_a_gyro_scale_error(world) -> None:
    """1 % of scale is 3.6 degrees in a turn, with a perfect magnetometer."""
    block = world.Scene(roll_deg=0.5, pitch_deg=0.5).block()
    block.gyro_b_rad_s[:] = world.BIAS + 1.01 * (block.gyro_b_rad_s - world.BIAS)
    collector = world.EvidenceCollector()
    for _, part in collector.split(block):
        collector.add(part)
    seen = collector.evaluate(
        world.estimate(), world.old(), np.zeros(3), None, world.HEALTHY, world.SOUND
    )
    assert seen.proof.closure_deg == pytest.approx(3.6, abs=0.3)


def test_partial_turns_give_a_closure(world) -> None:
    """180 degrees back and forth: without a full turn in a window, the slope is used."""
    assert world.evidence(world.Scene(heading_span_deg=200.0)).proof.closure_deg < 0.5
    assert np.isnan(world.evidence(world.Scene(heading_span_deg=100.0)).proof.closure_deg)


def test_proof_is_not_affected_by_acceleration(world) -> None:
    seen = world.evidence(world.Scene(forward_m_s2=3.0)).proof
    assert seen.rms_after_deg < 0.1


def test_field_direction_replaces_gravity_when_missing(world) -> None:
    seen = world.evidence(world.Scene(accel=False))
    assert seen.motion.regime == "unknown"
    assert 0.0 < seen.proof.rms_after_deg < 0.5 < seen.proof.rms_before_deg
    assert np.isnan(seen.proof.closure_deg)


def test_coverage_counts_headings_tilts_and_regime(world) -> None:
    full = world.evidence(world.Scene()).motion
    assert (full.heading_deg, full.regime, full.turn) == (360.0, "3D", "")
    assert full.roll_deg == pytest.approx(35, abs=1.5)
    assert full.pitch_deg == pytest.approx(35, abs=1.5)
    part = world.evidence(world.Scene(heading_span_deg=100.0, roll_deg=10, pitch_deg=10)).motion
    assert part.heading_deg == pytest.approx(105, abs=15)
    assert part.regime == "partial"
    flat = world.evidence(world.Scene(roll_deg=1, pitch_deg=1)).motion
    assert flat.regime == "2D"
    still = world.evidence(world.Scene(heading_span_deg=0, roll_deg=0, pitch_deg=0)).motion
    assert still.regime == "none"


def test_turn_advice_is_the_shorter_direction() -> None:
    seen = np.ones(SECTORS, dtype=bool)
    assert turn_advice(seen, 95.0) == ""
    seen[20:32] = False  # 200 to 320 deg
    assert turn_advice(seen, 325.0) == "turn left about 120 deg more"
    assert turn_advice(seen, 195.0) == "turn right about 120 deg more"


def test_sectors_wrap_and_skip_unknown_headings() -> None:
    seen = visited_sectors(np.radians([5.0, -5.0, 725.0, np.nan]))
    assert np.flatnonzero(seen).tolist() == [0, 35]
