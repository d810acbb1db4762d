"""The vertical from the device's attitude and from the specific force, where the attitude is
known.
"""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd import so3
from ahrsd.sharing.nmea import SETTLED_S, Tilt, has_heading, pitch_deg, roll_deg

RATE_HZ = 50.0


def true_up(yaw, pitch, roll):
    """Up in the body frame: minus the third row of the rotation from body to north, east, down."""
    return -so3.from_yaw_pitch_roll(yaw, pitch, roll)[:, 2, :]


def motion(seconds, accel_n=(0.0, 0.0, 0.0), first_s=0.0):
    """Times, rates and specific forces of a vehicle that rolls, pitches and turns."""
    t = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    angles = 0.3 * t, 0.3 * np.sin(0.5 * t), 0.5 * np.sin(0.7 * t + 1.0)
    R = so3.from_yaw_pitch_roll(*angles)
    step = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) * RATE_HZ
    rate = np.concatenate([step[:1], step])  # of the step that ends at the sample
    force_n = np.array(accel_n) - np.array([0.0, 0.0, 9.81])
    force = np.einsum("nji,j->ni", R, force_n)
    return first_s + t, rate, force, true_up(*angles)


def off_deg(up, true):
    return np.degrees(np.arccos(np.clip(np.sum(up * true, axis=1), -1.0, 1.0)))


def test_device_attitude_is_used_directly():
    yaw, pitch, roll = np.radians([[10.0, 200.0], [12.0, -80.0], [-25.0, 170.0]])
    nothing = np.full((2, 3), np.nan)
    up = Tilt().up(np.zeros(2), nothing, nothing, (pitch, roll))
    assert np.allclose(up, true_up(yaw, pitch, roll), atol=1e-12)
    assert np.allclose(pitch_deg(up), [12.0, -80.0])
    assert np.allclose(roll_deg(up), [-25.0, 170.0])
    assert has_heading(up).tolist() == [True, False]  # the x axis points down


def test_vertical_is_followed_in_turns_roll_and_pitch():
    t, rate, force, true = motion(30.0)
    up = Tilt().up(t, rate, force)
    settled = t >= SETTLED_S + 1.0 / RATE_HZ
    assert np.isnan(up[t < SETTLED_S - 1.0 / RATE_HZ]).all()
    assert off_deg(up[settled], true[settled]).max() < 0.3


def test_vertical_does_not_depend_on_the_block_size():
    t, rate, force, _ = motion(10.0)
    whole, tilt = Tilt().up(t, rate, force), Tilt()
    parts = [tilt.up(t[k : k + 7], rate[k : k + 7], force[k : k + 7]) for k in range(0, len(t), 7)]
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True)


def test_braking_disturbs_the_vertical_less_than_the_accelerometer():
    t, rate, force, true = motion(20.0)
    _, _, braking, _ = motion(20.0, accel_n=(-2.0, 0.0, 0.0))
    now = (t >= 12.0) & (t < 13.0)
    force[now] = braking[now]
    up = Tilt().up(t, rate, force)
    plumb = force / np.linalg.norm(force, axis=1)[:, None]
    assert off_deg(plumb, true)[now].max() > 11.0
    assert off_deg(up, true)[t > 12.0].max() < 2.5


def test_vertical_is_unknown_after_long_disturbance_and_settles_again_after_a_gap():
    t, rate, force, _ = motion(40.0)
    force[(t > 10.0)] *= 1.5  # shaken: never 1 g
    up = Tilt().up(t, rate, force)
    assert np.isfinite(up[(t > 6.0) & (t < 24.0)]).all()
    assert np.isnan(up[t > 26.0]).all()
    tilt = Tilt()
    tilt.up(*motion(10.0)[:3])
    later, *rest, _ = motion(10.0, first_s=60.0)
    again = tilt.up(later, *rest)
    assert np.isnan(again[later < 60.0 + SETTLED_S - 0.1]).all()
    assert np.isfinite(again[later > 60.0 + SETTLED_S + 0.1]).all()


@pytest.mark.parametrize("force", [np.nan, 0.0])
def test_no_vertical_without_specific_force(force):
    t, rate, _, _ = motion(10.0)
    up = Tilt().up(t, rate, np.full((len(t), 3), force))
    assert np.isnan(up).all()
    assert not has_heading(up).any()
