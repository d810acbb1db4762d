"""[L]'s experiment on a recorded gyro stream."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from true_trajectory import predicted_directions

from ahrsd.recording.table import read_table
from ahrsd.simulation.scenarios import LICHLYTER, integrate, simulate_recorded


def test_first_order_integration_turns_by_twice_the_arc_tangent_of_half_the_angle():
    dt, rate = 0.1, 0.8
    q = integrate(np.tile([0.0, 0.0, rate], (11, 1)), np.full(11, dt))
    angle = 10 * 2 * np.arctan(rate * dt / 2)
    assert q[-1] == pytest.approx([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    assert np.linalg.norm(q, axis=1) == pytest.approx(np.ones(11))
    x = Rotation.from_quat(q[-1], scalar_first=True).apply([1.0, 0.0, 0.0])
    assert x == pytest.approx([np.cos(angle), np.sin(angle), 0.0])


def test_the_order_of_turns_is_that_of_the_body():
    quarter = np.tan(np.pi / 4) * 2  # first order: 2 atan(w dt / 2) = 90 deg
    rates = np.array([[9.0, 9.0, 9.0], [0, 0, quarter], [quarter, 0, 0]])
    R = Rotation.from_quat(integrate(rates, np.ones(3))[-1], scalar_first=True).as_matrix()
    # turn right by 90 deg (x to east), then roll: y, which had become -north, goes down
    assert pytest.approx([0.0, 1.0, 0.0], abs=1e-12) == R @ [1, 0, 0]
    assert pytest.approx([0.0, 0.0, 1.0], abs=1e-12) == R @ [0, 1, 0]


def test_samples_follow_the_recorded_motion():
    rng = np.random.default_rng(1)
    time_s = np.cumsum(rng.uniform(0.02, 0.05, 400))
    rate = np.column_stack([np.sin(0.7 * time_s), 0.4 * np.cos(time_s), 0.3 + 0 * time_s])
    made = simulate_recorded(time_s, rate, noise_mag_gauss=0.0)
    u = made.field_b / made.truth.field_gauss
    assert predicted_directions(made) == pytest.approx(u, abs=1e-12)
    assert made.samples.gyro_b_rad_s[1:] == pytest.approx(rate[1:], abs=4e-4)  # third order in w dt
    # no soft iron in [L]: B_k = A_k H + b
    b = LICHLYTER.pseudo_hard_iron_gauss
    assert made.samples.raw_b_gauss - made.field_b == pytest.approx(np.tile(b, (400, 1)))


@pytest.mark.parametrize(
    ("time_s", "rate", "said"),
    [
        ([0.0, 0.1, 0.1], 0.0, "time_s of row 2 does not increase"),
        ([0.0, 0.1, 0.2], np.nan, "gyro_b_rad_s of row 0 is not finite"),
    ],
)
def test_bad_streams_are_named(time_s, rate, said):
    with pytest.raises(ValueError, match=said):
        simulate_recorded(np.array(time_s), np.full((3, 3), rate))


def test_on_a_real_gyro_stream(recordings):
    table = read_table(recordings / "broad" / "21_undisturbed_fast_combined.csv.gz")
    ends = (*table.starts, len(table.rows))
    start = int(np.argmax(np.diff(ends)))
    rows = slice(ends[start], min(ends[start + 1], ends[start] + 3000))
    made = simulate_recorded(table.rows.time_s[rows], table.rows.gyro_b_rad_s[rows], seed=2)
    assert len(made) == rows.stop - rows.start
    size = np.linalg.norm(made.samples.raw_b_gauss - made.truth.hard_iron_gauss, axis=1)
    assert size.mean() == pytest.approx(made.truth.field_gauss, rel=1e-3)
    assert size.std() == pytest.approx(1e-3, rel=0.1)  # nothing but the noise
