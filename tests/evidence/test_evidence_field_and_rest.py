"""Size and dip of the field, stationarity, and gyro bias at rest."""

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.worldfield import WorldField


def model(total, dip_deg):
    dip = np.radians(dip_deg)
    field = total * np.array([np.cos(dip), 0.0, np.sin(dip)])
    return WorldField(
        field, 0.0, float(dip), total, "WMM2025", 2030.0, np.full(3, 1e-3), 1e-3, 0.003, True
    )


def test_a_right_calibration_has_the_worlds_field(world) -> None:
    seen = world.evidence(world.Scene(), world=model(0.5, 60.0), field_known=True)
    assert seen.field.mean_gauss == pytest.approx(0.5, rel=1e-3)
    assert seen.field.inclination_deg == pytest.approx(60.0, abs=0.2)
    assert seen.field.spread == pytest.approx(0.0007, rel=0.2)  # noise alone: 0.35 of 500 mG
    assert seen.world.magnitude_error < 1e-3
    assert seen.world.inclination_error_deg < 0.2
    assert seen.field.wander_gauss < 1e-3
    assert seen.change.scale_change == 0.0


def test_the_wrong_place_shows(world) -> None:
    seen = world.evidence(world.Scene(), world=model(0.4, 45.0), field_known=True)
    assert seen.world.magnitude_error == pytest.approx(0.25, abs=0.01)
    assert seen.world.inclination_error_deg == pytest.approx(15.0, abs=0.3)


def test_without_a_known_field_the_devices_scale_is_kept(world) -> None:
    present = Affine(1.2 * world.truth().matrix, world.HARD + 0.005)
    seen = world.evidence(world.Scene(), present=present)
    assert seen.world is None
    assert seen.field.mean_gauss == pytest.approx(0.6, rel=0.01)
    assert seen.change.scale_change == pytest.approx(0.0, abs=1e-9)
    given = world.evidence(world.Scene(), present=present, proposed=world.truth())
    assert given.change.scale_change == pytest.approx(1 - 1 / 1.2, rel=1e-6)


def test_a_magnet_that_comes_and_goes_wanders(world) -> None:
    def bump(t):
        return 0.15 * ((t > 125) & (t < 145))[:, None] * np.array([1.0, 0.0, 0.0])

    calm, seen = world.evidence(world.Scene()), world.evidence(world.Scene(magnet=bump))
    assert calm.field.spread < 0.001 < 0.02 < seen.field.spread
    assert calm.field.max_gauss - calm.field.min_gauss < 0.005
    assert seen.field.max_gauss > 0.58
    assert seen.field.min_gauss < 0.45


def test_dip_is_not_compared_where_every_segment_was_rough(world) -> None:
    rough = world.Scene(forward_m_s2=8.0, rest_s=0.0)
    assert np.isnan(world.evidence(rough).field.inclination_wander_deg)


def test_temperature_range(world) -> None:
    block = world.Scene().block()
    block.covariates["temperature_c"][:] = np.linspace(20, 31, len(block))
    collector = world.EvidenceCollector()
    for _, part in collector.parts(block):
        collector.add(part)
    seen = collector.evaluate(
        world.estimate(), world.old(), np.zeros(3), None, world.HEALTHY, world.SOUND
    )
    assert seen.field.temperature_range_c == pytest.approx(9.0, abs=0.1)  # means of ten segments
    assert np.isnan(world.evidence(world.Scene(temperature_c=None)).field.temperature_range_c)


def test_rest_agrees_with_the_true_bias_and_not_with_another(world) -> None:
    good = world.evidence(world.Scene()).gyro
    assert good.rest_s == pytest.approx(18.0, abs=2.0)
    assert good.disagreement < 2.0
    assert good.sigma_share == pytest.approx(1e-4 / np.linalg.norm(world.BIAS), rel=0.1)
    off = world.BIAS + np.array([0.002, 0.0, 0.0])
    bad = world.evidence(world.Scene(), gyro_bias_rad_s=off).gyro
    assert bad.disagreement == pytest.approx(0.002 / np.hypot(1e-4, 1e-4), rel=0.1)


def test_an_estimate_that_knows_nothing_does_not_agree(world) -> None:
    covariance = np.diag(np.r_[np.full(9, 1e-4), np.full(3, 0.02)]) ** 2
    off = world.BIAS + np.array([0.02, 0.0, 0.0])
    seen = world.evidence(world.Scene(), gyro_bias_rad_s=off, covariance=covariance).gyro
    assert seen.disagreement > 50.0


def test_a_slow_steady_turn_is_no_rest(world) -> None:
    """0.4 deg/s looks still to gyro and accelerometer; the field tells."""
    scene = world.Scene(turn_s=900.0, roll_deg=0, pitch_deg=0, rest_s=0.0)
    assert world.evidence(scene).gyro.rest_s == 0.0


def test_without_rest_there_is_no_agreement(world) -> None:
    seen = world.evidence(world.Scene(rest_s=0.0)).gyro
    assert seen.rest_s == 0.0
    assert np.isnan(seen.disagreement)
    assert np.isnan(seen.sigma_share)
