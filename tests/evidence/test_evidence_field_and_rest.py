"""Magnitude and dip of the field, stationarity, and gyro bias at rest."""

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.evidence.second_opinions import contiguous_segments, mean_rate_at_rest
from ahrsd.evidence.segments import SegmentHistory
from ahrsd.samples import SampleBlock
from ahrsd.world_field import WorldField


def model(total, dip_deg):
    dip = np.radians(dip_deg)
    field = total * np.array([np.cos(dip), 0.0, np.sin(dip)])
    return WorldField(
        field, 0.0, float(dip), total, "WMM2025", 2030.0, np.full(3, 1e-3), 1e-3, 0.003, True
    )


def test_correct_calibration_gives_the_world_field(world) -> None:
    seen = world.evidence(world.Scene(), world=model(0.5, 60.0), field_known=True)
    assert seen.field.mean_gauss == pytest.approx(0.5, rel=1e-3)
    assert seen.field.inclination_deg == pytest.approx(60.0, abs=0.2)
    assert seen.field.spread == pytest.approx(0.0007, rel=0.2)  # only noise: 0.35 of 500 mG
    assert seen.world.magnitude_error < 1e-3
    assert seen.world.inclination_error_deg < 0.2
    assert seen.field.wander_gauss < 1e-3
    assert seen.change.scale_change == 0.0


def test_wrong_position_shows_in_magnitude_and_dip(world) -> None:
    seen = world.evidence(world.Scene(), world=model(0.4, 45.0), field_known=True)
    assert seen.world.magnitude_error == pytest.approx(0.25, abs=0.01)
    assert seen.world.inclination_error_deg == pytest.approx(15.0, abs=0.3)


def test_scale_of_the_device_is_kept_without_a_known_field(world) -> None:
    present = Affine(1.2 * world.truth().matrix, world.HARD + 0.005)
    seen = world.evidence(world.Scene(), present=present)
    assert seen.world is None
    assert seen.field.mean_gauss == pytest.approx(0.6, rel=0.01)
    assert seen.change.scale_change == pytest.approx(0.0, abs=1e-9)
    given = world.evidence(world.Scene(), present=present, proposed=world.truth())
    assert given.change.scale_change == pytest.approx(1 - 1 / 1.2, rel=1e-6)


def test_temporary_magnet_increases_spread_and_wander(world) -> None:
    def bump(t):
        return 0.15 * ((t > 125) & (t < 145))[:, None] * np.array([1.0, 0.0, 0.0])

    calm, seen = world.evidence(world.Scene()), world.evidence(world.Scene(magnet=bump))
    assert calm.field.spread < 0.001 < 0.02 < seen.field.spread
    assert calm.field.max_gauss - calm.field.min_gauss < 0.005
    assert seen.field.max_gauss > 0.58
    assert seen.field.min_gauss < 0.45


def test_dip_is_not_compared_when_every_segment_was_rough(world) -> None:
    rough = world.Scene(forward_m_s2=8.0, rest_s=0.0)
    assert np.isnan(world.evidence(rough).field.inclination_wander_deg)


def test_temperature_range(world) -> None:
    block = world.Scene().block()
    block.covariates["temperature_c"][:] = np.linspace(20, 31, len(block))
    collector = world.EvidenceCollector()
    for _, part in collector.split(block):
        collector.add(part)
    seen = collector.evaluate(
        world.estimate(), world.old(), np.zeros(3), None, world.HEALTHY, world.SOUND
    )
    assert seen.field.temperature_range_c == pytest.approx(9.0, abs=0.1)  # means of ten segments
    assert np.isnan(world.evidence(world.Scene(temperature_c=None)).field.temperature_range_c)


def test_rate_at_rest_agrees_only_with_the_true_bias(world) -> None:
    good = world.evidence(world.Scene()).gyro
    assert good.rest_s == pytest.approx(18.0, abs=2.0)
    assert good.disagreement < 2.0
    assert good.sigma_share == pytest.approx(1e-4 / np.linalg.norm(world.BIAS), rel=0.1)
    off = world.BIAS + np.array([0.002, 0.0, 0.0])
    bad = world.evidence(world.Scene(), gyro_bias_rad_s=off).gyro
    assert bad.disagreement == pytest.approx(0.002 / np.hypot(1e-4, 1e-4), rel=0.1)


def test_undetermined_bias_is_judged_by_its_sigma(world) -> None:
    """It differs by 20 mrad/s within its sigma: too much to be written, but not contradicted."""
    covariance = np.diag(np.r_[np.full(9, 1e-4), np.full(3, 0.02)]) ** 2
    off = world.BIAS + np.array([0.02, 0.0, 0.0])
    seen = world.evidence(world.Scene(), gyro_bias_rad_s=off, covariance=covariance).gyro
    assert seen.disagreement == pytest.approx(1.0, abs=0.02)
    assert seen.apart_mrad_s == pytest.approx(20.0, abs=0.3)
    assert seen.sigma_mrad_s == pytest.approx(20.0)


def test_slow_steady_turn_is_not_rest(world) -> None:
    """Gyro and accelerometer do not show 0.4 deg/s; the field does."""
    scene = world.Scene(turn_s=900.0, roll_deg=0, pitch_deg=0, rest_s=0.0)
    assert world.evidence(scene).gyro.rest_s == 0.0


def test_no_agreement_without_rest(world) -> None:
    seen = world.evidence(world.Scene(rest_s=0.0)).gyro
    assert seen.rest_s == 0.0
    assert np.isnan(seen.disagreement)
    assert np.isnan(seen.sigma_share)


def rests(seconds_of_rest: float, every_s: float, phase_s: float, minutes: float = 10.0):
    """Segments of a vehicle that drives and rests at times; its bias is BIAS."""
    rate_hz, random = 25.0, np.random.default_rng(7)
    time_s = np.arange(round(60.0 * minutes * rate_hz)) / rate_hz
    still = (time_s - phase_s) % every_s < seconds_of_rest
    heading = np.cumsum(np.where(still, 0.0, 0.3)) / rate_hz
    rate = BIAS + 5e-4 * random.standard_normal((len(time_s), 3))
    rate[:, 2] += np.where(still, 0.0, 0.3)
    force = 0.005 * random.standard_normal((len(time_s), 3)) - [0.0, 0.0, 9.81]
    force += np.where(still, 0.0, 0.5)[:, None] * random.standard_normal((len(time_s), 3))
    field = np.column_stack([0.25 * np.cos(heading), -0.25 * np.sin(heading), 0 * heading + 0.4])
    field += 5e-4 * random.standard_normal((len(time_s), 3))
    dt_s = np.full(len(time_s), 1 / rate_hz)
    dt_s[0] = np.nan
    block = SampleBlock(time_s, dt_s, time_s, field, rate, force, gap_before=True)
    history = SegmentHistory()
    for _, part in history.split(block):
        history.add(part)
    history.close_segment()
    return history.segments


BIAS = np.array([0.004, -0.005, 0.002])


@pytest.mark.parametrize("phase_s", np.arange(0.0, 60.0, 1.3))
def test_rest_counts_at_any_position(phase_s: float) -> None:
    """Also if the boundary of two segments is within it."""
    found = mean_rate_at_rest(rests(6.0, 60.0, phase_s))
    assert found.duration_s >= 3.0 * 8  # 6 s a minute: five whole bins less the two outer ones
    assert found.duration_s <= 6.0 * 10
    assert np.linalg.norm(found.rate_b_rad_s - BIAS) < 4e-4


def test_duration_of_a_long_rest_is_right() -> None:
    found = mean_rate_at_rest(rests(300.0, 600.0, 100.0))
    assert found.duration_s == pytest.approx(300.0, abs=4.0)


def test_rest_before_a_restart_of_the_device_clock_does_not_count() -> None:
    segments = rests(6.0, 60.0, 10.0, minutes=4.0)
    before = mean_rate_at_rest(segments).duration_s
    assert mean_rate_at_rest([*segments, *segments]).duration_s == before


def test_gap_in_the_stream_is_not_rest() -> None:
    segments = rests(300.0, 600.0, 100.0)
    pieces = contiguous_segments(segments)
    assert [len(piece) for piece in pieces] == [len(segments)]
    assert len(contiguous_segments(segments[:5] + segments[6:])) == 2
