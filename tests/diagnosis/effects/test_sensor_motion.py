"""A mount that bends equally in all directions turns the outside field."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ahrsd.diagnosis.effects.design_matrix import GRAVITY_M_S2
from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.effects.library import EFFECTS

MOUNT = EFFECTS["flexible_mount"]


def test_trace_of_the_compliance_is_a_constant_field_in_the_world_frame():
    count, field = 50, np.array([0.2, 0.05, 0.42])
    R = Rotation.random(count, random_state=3).as_matrix()
    field_b = np.einsum("nji,j->ni", R, field)
    at = Readings(
        time_s=np.arange(count) * 0.02,
        dt_s=np.full(count, 0.02),
        mag_b_gauss=field_b,
        gyro_b_rad_s=np.zeros((count, 3)),
        accel_b_m_s2=np.einsum("nji,j->ni", R, [0.0, 0.0, GRAVITY_M_S2]),
        rate_b_rad_s=np.zeros((count, 3)),
        field_b=field_b,
        R_nb=R,
        soft_iron=np.eye(3),
        covariates={},
    )
    bent = MOUNT.simulate(at, 0.05 * np.eye(3).ravel(), {}).mag_b_gauss
    seen = np.einsum("nij,nj->ni", R, bent)
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0], seen.shape), atol=1e-12)
    assert np.linalg.norm(seen[0] - field) == pytest.approx(0.05 * np.hypot(0.2, 0.05), rel=1e-3)
    np.testing.assert_allclose(MOUNT.unseen[0], np.eye(3).ravel() / np.sqrt(3), atol=1e-15)
