"""Moving the gyro in time gives the rotation between the moved instants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from effect_motion import moving

from ahrsd import so3
from ahrsd.diagnosis.delay import delayed_gyro
from ahrsd.diagnosis.delays import beyond_the_lag, usual_step
from ahrsd.diagnosis.track import Track


def attitude(t: np.ndarray) -> np.ndarray:
    """A smooth attitude: two rotations, one after the other."""
    first = so3.exp(np.outer(np.sin(1.3 * t), [0.3, -0.8, 0.4]))
    return first @ so3.exp(np.outer(np.cos(0.9 * t), [0.5, 0.2, 0.6]))


def rates(t: np.ndarray) -> np.ndarray:
    R = attitude(t)
    mean = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / np.diff(t)[:, None]
    return np.vstack([mean[:1], mean])


@pytest.mark.parametrize("tau", [0.013, 0.04, -0.027])
def test_rates_are_those_of_the_earlier_instants(tau):
    t = np.arange(0.0, 20.0, 0.02)
    dt = np.concatenate([[np.nan], np.diff(t)])
    track = Track(t, dt, np.zeros((len(t), 3)), rates(t), None, {}, (slice(0, len(t)),))
    moved = delayed_gyro(track, tau).gyro_b_rad_s
    expected = rates(t - tau)
    inner = slice(5, -5)
    before = np.abs(track.gyro_b_rad_s - expected)[inner].max()
    after = np.abs(moved - expected)[inner].max()
    assert after < 0.002 * before


def test_no_delay_is_the_same_track():
    t = np.arange(10.0)
    track = Track(t, t, np.zeros((10, 3)), np.ones((10, 3)), None, {}, (slice(0, 10),))
    assert delayed_gyro(track, 0.0) is track


def test_steps_that_are_not_alike_have_no_half():
    """With one sample in seven missing half a step is no convention that a delay could be."""
    t = 0.025 * np.arange(4000)
    dt = np.diff(t, prepend=np.nan)
    assert usual_step(dt) == pytest.approx(0.025)
    kept = np.delete(t, np.arange(3, 4000, 7))
    assert usual_step(np.diff(kept, prepend=np.nan)) is None


def test_a_low_pass_does_half_beyond_a_delay_of_what_it_does_to_the_delayed_field():
    """LP(h) - h(t - tau) of a field that turns steadily: i w tau becomes 1 / (1 + i w tau)."""
    tau, rate = 0.05, 1.5
    t = 0.02 * np.arange(2000)
    dt = np.diff(t, prepend=np.nan)
    late = np.exp(1j * rate * (t - tau))
    context, _ = moving(1, rows=len(t))
    turning = np.tile([0.0, 0.0, -rate], (len(t), 1))
    context = replace(
        context,
        track=replace(context.track, time_s=t, dt_s=dt),
        field_b=np.column_stack([late.real, late.imag, np.zeros(len(t))]),
        rate_b_rad_s=turning,
        model=replace(context.model, soft_iron=np.eye(3)),
    )
    expected = np.exp(1j * rate * t) / (1 + 1j * rate * tau) - late
    found = beyond_the_lag(context, tau).mag
    assert found is not None
    inner = slice(5, -5)
    error = np.abs(found[inner, 0, 0] + 1j * found[inner, 1, 0] - expected[inner])
    assert error.max() < 0.05 * np.abs(expected).max()
