"""Misfit does not average out: by hand, and where errors of all epochs are the same."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.estimator.noise import covariance_with_common_errors

NOTHING = np.zeros((2, 2)), 0.0
#: four epochs tell the first number, the last of them the second one as well
EPOCHS = np.array([np.diag([25.0, 0.0])] * 3 + [np.diag([25.0, 4.0])])
WEAK_PRIOR = 1e-9 * np.eye(2)


def covariance(temper, epochs=EPOCHS):
    return np.linalg.inv(epochs.sum(axis=0) / temper + WEAK_PRIOR)


def test_each_number_by_as_many_epochs_as_tell_it():
    """Variance of noise 1, and of what is the same in all, misfit - 1, n times."""
    found = covariance_with_common_errors(
        covariance(9.0), EPOCHS, misfit=9.0, temper=9.0, folded=NOTHING
    )
    assert found == pytest.approx(np.diag([(1 + 8 * 4) / 100, 9 / 4]), rel=1e-6)


def test_without_misfit_nothing_is_wider():
    before = covariance(1.0)
    found = covariance_with_common_errors(before, EPOCHS, misfit=1.0, temper=1.0, folded=NOTHING)
    assert np.array_equal(found, before)


def test_a_direction_that_is_wider_already_is_not_widened_again():
    """By what repeats with the attitude: 40 times the variance, of which this would make 33."""
    before = covariance(40.0)
    found = covariance_with_common_errors(before, EPOCHS, misfit=9.0, temper=40.0, folded=NOTHING)
    assert found == pytest.approx(before, rel=1e-9)


def test_epochs_that_left_count_as_if_they_were_there():
    whole = covariance_with_common_errors(
        covariance(9.0), EPOCHS, misfit=9.0, temper=9.0, folded=NOTHING
    )
    old = EPOCHS[:3].sum(axis=0), 3.0
    found = covariance_with_common_errors(
        covariance(9.0), EPOCHS[3:], misfit=9.0, temper=9.0, folded=old
    )
    assert found == pytest.approx(whole, rel=1e-9)


def test_what_is_believed_stays_where_the_data_say_little():
    """Beside a prior of 1: what they are bent by hardly moves the answer."""
    epochs = np.tile(np.diag([0.02, 0.02]), (5, 1, 1))
    before = np.linalg.inv(epochs.sum(axis=0) / 50.0 + np.eye(2))
    found = covariance_with_common_errors(before, epochs, misfit=50.0, temper=50.0, folded=NOTHING)
    assert np.diag(found) == pytest.approx([1.0, 1.0], rel=0.01)


def test_it_is_the_spread_of_answers_whose_epochs_are_bent_alike():
    """Ten thousand drawn: each epoch asks for noise of its own and for one bend of all."""
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
