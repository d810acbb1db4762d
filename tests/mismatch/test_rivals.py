"""Names that only stand in for something of another form are taken back: unknown, there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.spatial.transform import Rotation
from tracks import experiment, track_of

from ahrsd.mismatch.engine import diagnose
from ahrsd.mismatch.null import fit_null
from ahrsd.mismatch.regression import base
from ahrsd.mismatch.rivals import by_memory, compared
from ahrsd.mismatch.together import projected
from ahrsd.mismatch.track import Track


@pytest.fixture(scope="module")
def track() -> Track:
    return made(Trial(seed=11, samples=7500, rate_hz=25.0, scenario="wam", noise="white")).track


def turned(track: Track, angle_rad: np.ndarray) -> Track:
    """The magnetometer turned against the gyro by rotation vectors (N, 3)."""
    return replace(track, mag_b_gauss=Rotation.from_rotvec(angle_rad).apply(track.mag_b_gauss))


def test_a_mount_that_stays_crooked_has_a_name(track: Track) -> None:
    found = diagnose(turned(track, np.full((len(track), 3), 3e-3)))
    assert [one.effect for one in found.findings] == ["mag_gyro_misalignment"]
    assert not found.unexplained.detected


@pytest.mark.slow
def test_a_mount_that_bends_more_and_more_has_none(track: Track) -> None:
    share = np.linspace(0.0, 1.0, len(track))[:, None]
    found = diagnose(turned(track, share * np.array([6e-3, -4e-3, 5e-3])))
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame in ("sensor", "gyro")


@pytest.mark.slow
def test_a_mount_that_bends_fast_and_then_stays_is_no_crowd_of_names(track: Track) -> None:
    warmth = 1.0 - np.exp(-3.0 * np.linspace(0.0, 1.0, len(track)))[:, None]
    found = diagnose(turned(track, warmth * np.array([12e-3, -8e-3, 10e-3])))
    assert found.findings == ()
    assert found.unexplained.detected


def test_a_gyro_bias_that_comes_and_goes_is_no_pair_of_steps(track: Track) -> None:
    phase = np.clip((track.time_s - 120.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * phase)[:, None] ** 2 * np.array([6e-4, -5e-4, 7e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + bump))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"


@pytest.mark.parametrize("seed", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_a_gyro_that_is_off_for_a_while_is_no_object_outside(seed: int) -> None:
    """It was a field that the vehicle passed, or a jump of the field, and something else beside."""
    quiet = made(Trial(seed=seed, samples=7500, rate_hz=25.0, scenario="mam", noise="white")).track
    inside = (quiet.time_s > 150.0) & (quiet.time_s < 190.0)
    spell = inside[:, None] * np.array([-1.7e-4, 2.0e-4, 1.4e-4])
    found = diagnose(replace(quiet, gyro_b_rad_s=quiet.gyro_b_rad_s + spell))
    assert found.findings == ()
    assert found.unexplained.where.frame == "gyro"
    (begin_s, end_s), *_ = found.unexplained.where.intervals_s
    assert begin_s == pytest.approx(150.0, abs=6.0)
    assert end_s == pytest.approx(190.0, abs=6.0)


def test_a_scale_that_differs_between_the_senses_of_rotation_has_no_name(track: Track) -> None:
    added = np.abs(track.gyro_b_rad_s) * np.array([3e-3, -4e-3, 5e-3])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + added))
    assert found.findings == ()
    assert found.unexplained.detected


def test_relays_are_more_than_any_name_for_iron_with_two_states() -> None:
    track = track_of(experiment("wam", samples=3000))
    fit = fit_null(track, walk=False)
    basis = base(fit.context(), fit.filtered, [], 25.0)
    relays = basis.whitened([by_memory(basis.context)])[0]
    # one relay's field, as the innovations see it, against a course that is nearly the same
    iron = 2.0e-3 * relays[:, :, :3].sum(axis=2)
    near = iron + 0.7 * np.roll(iron, 40, axis=0)
    seen = replace(basis, innovation=basis.innovation + iron)
    name, form, both = compared(seen, near[:, :, None], 1e-3 * relays, 1.0)
    assert form > name + 7.0
    assert both < form + 7.0


def test_free_forms_are_not_made_of_the_fields_own_noise() -> None:
    """Shapes of the attitude that are nearly alike differ by the noise of the field's estimate."""
    track = track_of(experiment("wam", samples=3000))
    fit = fit_null(track, walk=False)
    basis = base(fit.context(), fit.filtered, [], 25.0)
    shape = 1e3 * basis.whitened([by_memory(basis.context)])[0][:, :, :1]
    alike = np.concatenate([shape, shape + 1e-3 * basis.innovation[:, :, None]], axis=2)
    G, s = projected(basis, alike)
    assert np.linalg.matrix_rank(G) == 1
    explained = s @ np.linalg.pinv(G, hermitian=True) @ s
    assert explained < 20.0  # the noise itself would be explained by 9000
