"""What a term gains on parts of the recording that nothing was fitted to."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.calibration_fit.descent import FittedTerm
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.rules import findings
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.heldout import _alone, gain_of

SAMPLES = 5000


@pytest.fixture(scope="module")
def made():
    return experiment("mam", samples=SAMPLES)


@pytest.fixture(scope="module")
def track(made):
    return track_of(made)


def term_of(name, setting):
    effect = EFFECTS[name]
    scale = np.array([p.scale for p in effect.parameters])
    columns = partial(effect.columns, setting=setting)
    return FittedTerm(name, columns, np.zeros(len(scale)), 30 * scale, setting=setting), scale


def gained(track, name, setting, walk=0.0):
    """Nats of the whole recording, of the effect fitted with the calibration."""
    term, scale = term_of(name, setting)
    fit = fit_null(track, terms=(term,), walk=False)
    if walk:
        model = replace(fit.model, gyro_walk_rad_s_sqrt_s=walk)
        fit = fit_null(track, start=model, terms=fit.terms, noise=False)
    gain = gain_of(fit, 0, fit.terms[0].value, scale, wanders=walk > 0)
    return None if gain is None else gain.nats_per_sample * len(track)


def drift(track):
    return {"start_s": float(track.time_s[0]), "span_s": track.duration_s, "shape": "line"}


def test_of_a_slow_drift_is_gained_what_a_calibration_of_four_fifths_does_not_know(made, track):
    """The field's strength drifts by 2 mG, which nothing can follow.

    In the fifth at x (-0.4 to 0.4 of the recording about its middle) the other four expect -x / 4:
    it is off by 1.25 x, and by its own slope.
    """
    stronger = 2e-3 * (track.time_s - track.time_s[0]) / track.duration_s
    model = true_model(made)
    field = (track.mag_b_gauss - model.hard_iron_gauss) @ np.linalg.inv(model.soft_iron)
    along = field / np.linalg.norm(field, axis=1, keepdims=True)
    mag = track.mag_b_gauss + stronger[:, None] * along @ model.soft_iron.T
    nats = gained(replace(track, mag_b_gauss=mag), "geomagnetic_drift", drift(track))
    squares = 1.25**2 * np.mean(np.square([-0.4, -0.2, 0.0, 0.2, 0.4])) + 0.2**2 / 12
    expected = 0.5 * squares * (2e-3 / made.truth.noise_mag_gauss) ** 2 * SAMPLES
    assert nats == pytest.approx(expected, rel=0.25)  # soft and hard iron bend with it a little


def test_what_is_not_there_gains_nothing(track):
    rng = np.random.default_rng(5)
    current = np.repeat(rng.uniform(0.0, 10.0, SAMPLES // 50), 50)
    with_current = replace(track, covariates={"motor_current_a": current})
    setting = {"covariate": "motor_current_a", "reference": 0.0}
    assert -6.0 < gained(with_current, "motor_current_field", setting) < 3.0


def test_what_is_in_one_fifth_alone_is_not_known_from_the_others(track):
    late_s = float(track.time_s[0]) + 0.93 * track.duration_s
    mag = track.mag_b_gauss + np.where(track.time_s > late_s, 5e-3, 0.0)[:, None]
    stepped = replace(track, mag_b_gauss=mag)
    assert gained(stepped, "hard_iron_step", {"onset_s": late_s}) is None
    middle_s = float(track.time_s[0]) + 0.5 * track.duration_s
    mag = track.mag_b_gauss + np.where(track.time_s > middle_s, 5e-3, 0.0)[:, None]
    stepped = replace(track, mag_b_gauss=mag)
    assert gained(stepped, "hard_iron_step", {"onset_s": middle_s}) > 1000.0


def test_a_bias_that_wanders_is_held_against_one_that_stays(track):
    """The filter whose bias may walk has followed it before anything is named."""
    rng = np.random.default_rng(6)
    steps = rng.normal(size=(SAMPLES, 3)) * np.sqrt(float(np.nanmedian(track.dt_s)))
    walked = replace(track, gyro_b_rad_s=track.gyro_b_rad_s + 4e-5 * np.cumsum(steps, axis=0))
    setting = {"start_s": float(track.time_s[0]), "span_s": track.duration_s}
    stays = gained(walked, "gyro_bias_drift", setting) or 0.0  # its ends no others know
    follows = gained(walked, "gyro_bias_drift", setting, walk=4e-5)
    assert follows > 5 * max(stays, 20.0)


def test_what_a_room_hides_of_a_step_is_not_known_from_the_rest_after_it() -> None:
    """A fifth loses as much more as the noise scatters, and then others do not know it."""
    lost, won = np.array([0.0, 4.0, 3.0, 1900.0, 1.0]), np.array([0.0, 1.1e4, 1.4e4, 1.9e4, 1.1e4])
    assert not _alone(lost, won, 3, 1.0)
    assert _alone(lost, won, 3, 13.0)
    harmless = np.array([0.0, 4.0, 3.0, 60.0, 1.0])
    assert not _alone(harmless, np.array([0.0, 1.1e4, 1.4e4, 20.0, 1.1e4]), 3, 13.0)


@pytest.fixture(scope="module")
def jumped(made, track):
    """The world's field jumps by a milligauss at 90 s."""
    jump = 1e-3 * np.array([0.6, -0.5, 0.6])
    turned = np.swapaxes(fit_null(track).context().R_nb, 1, 2) @ jump
    read = turned @ true_model(made).soft_iron.T
    later = (track.time_s - track.time_s[0] > 90.0)[:, None]
    return replace(track, mag_b_gauss=track.mag_b_gauss + later * read)


@pytest.mark.slow
def test_a_field_that_jumps_is_held_out_by_the_second(jumped, track, monkeypatch):
    """The filter has followed it before a stretch is over: no stretch knows it for another one."""
    monkeypatch.setattr(findings, "gain_of", lambda *_, **__: None)
    found = diagnose(jumped)
    (step,) = found.findings
    assert step.effect == "field_step"
    assert not found.unexplained.detected
    gained = step.heldout.nll_gain_per_sample * len(track)
    assert gained == pytest.approx(500.0, rel=0.2)
    monkeypatch.setattr(findings, "LONELY_BLOCKS", 1.0)  # asked as of what shows all the time
    (again,) = diagnose(jumped).findings
    assert again.heldout.nll_gain_per_sample < 0.0
