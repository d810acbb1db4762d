"""Misfit that does not average out: a small example, and errors common to all epochs."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.estimator.noise import covariance_with_common_errors

NOTHING = np.zeros((2, 2)), 0.0
#: four epochs determine the first parameter, the last of them the second one as well
EPOCHS = np.array([np.diag([25.0, 0.0])] * 3 + [np.diag([25.0, 4.0])])
WEAK_PRIOR = 1e-9 * np.eye(2)


def covariance(temper, epochs=EPOCHS):
    return np.linalg.inv(epochs.sum(axis=0) / temper + WEAK_PRIOR)


def test_variance_of_a_parameter_counts_the_epochs_that_determine_it():
    """Variance of the noise 1, and of the common error, misfit - 1, n times."""
    found = covariance_with_common_errors(
        covariance(9.0), EPOCHS, misfit=9.0, temper=9.0, folded=NOTHING
    )
    assert found == pytest.approx(np.diag([(1 + 8 * 4) / 100, 9 / 4]), rel=1e-6)


def test_nothing_is_widened_without_misfit():
    before = covariance(1.0)
    found = covariance_with_common_errors(before, EPOCHS, misfit=1.0, temper=1.0, folded=NOTHING)
    assert np.array_equal(found, before)


def test_direction_that_is_already_wider_is_not_widened_again():
    """Errors that repeat with the attitude gave it 40 times the variance; this rule would give
    33.
    """
    before = covariance(40.0)
    found = covariance_with_common_errors(before, EPOCHS, misfit=9.0, temper=40.0, folded=NOTHING)
    assert found == pytest.approx(before, rel=1e-9)


def test_folded_epochs_count_as_if_in_the_window():
    whole = covariance_with_common_errors(
        covariance(9.0), EPOCHS, misfit=9.0, temper=9.0, folded=NOTHING
    )
    old = EPOCHS[:3].sum(axis=0), 3.0
    found = covariance_with_common_errors(
        covariance(9.0), EPOCHS[3:], misfit=9.0, temper=9.0, folded=old
    )
    assert found == pytest.approx(whole, rel=1e-9)


def test_prior_dominated_direction_is_hardly_widened():
    """With a prior of 1, errors of the epochs hardly change the estimate."""
    epochs = np.tile(np.diag([0.02, 0.02]), (5, 1, 1))
    before = np.linalg.inv(epochs.sum(axis=0) / 50.0 + np.eye(2))
    found = covariance_with_common_errors(before, epochs, misfit=50.0, temper=50.0, folded=NOTHING)
    assert np.diag(found) == pytest.approx([1.0, 1.0], rel=0.01)


def test_covariance_is_the_spread_of_estimates_with_a_common_error():
    """Ten thousand draws: each epoch has its own noise, and all share one error."""
    rng = np.random.default_rng(1)
    n, misfit = 10_000, 5.0
    root = np.sqrt(EPOCHS.diagonal(axis1=1, axis2=2))  # (4, 2)
    noise = rng.normal(size=(n, 4, 2)) * root
    bend = np.sqrt(misfit - 1.0) * rng.normal(size=(n, 1, 2)) * root
    answers = (noise + bend).sum(axis=1) / EPOCHS.sum(axis=0).diagonal()
    said = covariance_with_common_errors(
        covariance(misfit), EPOCHS, misfit=misfit, temper=misfit, folded=NOTHING
    )
    assert answers.var(axis=0) == pytest.approx(np.diag(said), rel=0.05)
