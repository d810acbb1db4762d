"""Names that only stand in for something of another form are taken back: unknown, there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made
from scipy.spatial.transform import Rotation
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules import rivals
from ahrsd.diagnosis.rules.discrepancy import UNIT_GAUSS
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.regression import base, columns_of
from ahrsd.diagnosis.rules.rivals import (
    _shape,
    by_matrix,
    by_memory,
    by_mount,
    compared,
    more,
    of_another_form,
)
from ahrsd.diagnosis.rules.search import State, formed_basis_of, refitted, survey
from ahrsd.diagnosis.rules.together import projected
from ahrsd.diagnosis.track import Spec, Track


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


def test_a_mount_that_bends_is_crooked_on_the_average(track: Track) -> None:
    """A turn that grows from none is a mean turn and a change: neither alone is likely."""
    share = np.linspace(0.0, 1.0, len(track))[:, None]
    fit = fit_null(turned(track, share * np.array([3e-3, -2e-3, 2.5e-3])), walk=False)
    basis = base(fit.context(), fit.filtered, [], 25.0)
    mount, change = basis.whitened([by_mount(basis.context), by_matrix(basis.context)])
    mean, changed, both = compared(basis, UNIT_GAUSS * mount, UNIT_GAUSS * change, 1.0)
    bending = UNIT_GAUSS * np.concatenate([mount, change], axis=2)
    _, form, _ = compared(basis, UNIT_GAUSS * mount, bending, 1.0)
    assert form > max(mean, changed) + 7.0
    assert form == pytest.approx(both, rel=0.02)


def test_a_mount_that_stays_crooked_is_held_against_no_other_that_stays(track: Track) -> None:
    """The name itself is a matrix that stays: amid a rest that form would always be likelier."""
    state = named(turned(track, np.full((len(track), 3), 3e-3)), "mag_gyro_misalignment")
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rivals, "_rivals", lambda *given, **_: asked.append(given[2].shape[2]))
        of_another_form(state, formed_basis_of(state), (), beside=True)
    widths = [by(formed_basis_of(state).context).mag.shape[2] for by in (by_mount, by_matrix)]
    assert widths == [9, 27]
    assert asked[-1] == 27
    assert asked.count(36) == 1  # by the rate


def test_a_field_that_goes_with_the_heading_is_no_curved_reading(track: Track) -> None:
    """A turret that turns against the heading: the fourth harmonic, in the vehicle's own axes."""
    R_nb = fit_null(track, walk=False).context().R_nb
    yaw = Rotation.from_matrix(R_nb).as_euler("ZYX")[:, :1]
    field = np.cos(4 * yaw) * np.array([0.6, -0.8, 0.0]) + np.sin(4 * yaw) * np.array([0, 0.6, 0.8])
    turret = replace(track, mag_b_gauss=track.mag_b_gauss + 1.5e-3 * field)
    told, form, both = held_against_shape(turret, "mag_cross_axis")
    assert form > told + more(told)
    assert both < form + 7.0
    curved = made(Trial(11, (("mag_cross_axis", 2.0),), samples=7500)).track
    told, form, _ = held_against_shape(curved, "mag_cross_axis")
    assert told > 100.0
    assert form < told + more(told)


def held_against_shape(track: Track, name: str) -> tuple[float, float, float]:
    """Nats of a name, of a field by the field's direction, and of both."""
    problem, cold = problem_of(track, Spec(), {name: EFFECTS[name]}, LIMITS)
    seen = survey(State(problem, fit_null(problem.track, problem.spec, cold, walk=False)))
    (one,) = seen.candidates
    mine = columns_of(seen.basis, [one])[name] * one.scale
    return compared(seen.basis, mine, _shape(seen.basis), 1.0)


def named(track: Track, name: str) -> State:
    """The state with this name for what is in the recording."""
    problem, cold = problem_of(track, Spec(), {name: EFFECTS[name]}, LIMITS)
    start = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    return refitted(start, (survey(start).judged[0],))


@pytest.mark.slow
def test_a_gyro_bias_that_comes_and_goes_is_no_pair_of_steps(track: Track) -> None:
    phase = np.clip((track.time_s - 120.0) / 40.0, 0.0, 1.0)
    bump = np.sin(np.pi * phase)[:, None] ** 2 * np.array([6e-4, -5e-4, 7e-4])
    found = diagnose(replace(track, gyro_b_rad_s=track.gyro_b_rad_s + bump))
    assert "gyro_bias_step" not in [one.effect for one in found.findings]
    assert found.unexplained.detected
    assert found.unexplained.where.frame == "gyro"


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
