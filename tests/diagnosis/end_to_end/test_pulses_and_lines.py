"""Disturbances above the working rate: pulses and lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd import so3
from ahrsd.diagnosis.calibration_fit.gyro_at_rest import field_hardly_turns
from ahrsd.diagnosis.calibration_fit.null_fit import fit_null
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track

RATE_HZ = 40.0


@pytest.fixture(scope="module")
def undisturbed() -> Track:
    return made(Trial(seed=5, samples=7000, rate_hz=RATE_HZ)).track


@pytest.mark.slow  # a short one: the next
def test_unlogged_pulses_are_found(undisturbed: Track) -> None:
    since = (undisturbed.time_s - 0.4) % 1.37
    hit = np.where(since < 0.06, 1.0, 0.0)[:, None]
    pulsed = replace(
        undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + 2.5e-3 * hit * np.array([0.8, 0, 0.6])
    )
    found = diagnose(pulsed).findings
    assert [one.effect for one in found] == ["sync_pulses"]
    assert abs(found[0].setting["period_s"] - 1.37) < 1e-3
    assert abs(found[0].parameters[0].value - 2e-3) < 5e-4


@pytest.mark.slow
def test_smooth_pulses_are_a_single_finding() -> None:
    """Aliased by the working rate they look like the ordinary residual of real recordings.

    Modelled as a box, they leave multiples of their rate.
    """
    undisturbed = made(Trial(seed=5, samples=4500, rate_hz=RATE_HZ)).track
    part = np.minimum(((undisturbed.time_s - 0.4) % 1.0661) / 0.12, 1.0)
    swell = np.sin(np.pi * part)[:, None] ** 2
    pulsed = replace(
        undisturbed, mag_b_gauss=undisturbed.mag_b_gauss + 1e-2 * swell * np.array([0.6, 0, 0.8])
    )
    found = diagnose(pulsed)
    assert [one.effect for one in found.findings] == ["sync_pulses"]
    assert abs(found.findings[0].setting["period_s"] - 1.0661) < 1e-3
    assert not found.unexplained.detected


@pytest.mark.slow
def test_alternating_field_is_found_without_turns() -> None:
    """Without turns little is known about the field, but no gyro error makes a line."""
    still = _rocking(np.random.default_rng(5))
    assert field_hardly_turns(fit_null(still))
    wave = np.cos(2 * np.pi * 18.46 * still.time_s)[:, None] * np.array([3e-4, -4e-4, 0.0])
    found = diagnose(replace(still, mag_b_gauss=still.mag_b_gauss + wave))
    assert [one.effect for one in found.findings] == ["ac_interference"]
    assert abs(found.findings[0].setting["frequency_hz"] - 18.46) < 1e-3


@pytest.mark.slow
def test_no_line_is_found_without_turns_when_there_is_none() -> None:
    assert diagnose(_rocking(np.random.default_rng(5))).findings == ()


def _rocking(rng: np.random.Generator) -> Track:
    """Three minutes of a vehicle that rocks by about a degree and hardly turns."""
    time_s = np.arange(7200) / RATE_HZ
    angles = 0.02 * np.sin(time_s[:, None] * np.array([0.11, 0.17, 0.23]) + [0.0, 1.0, 2.0])
    R_nb = so3.exp(angles)
    turned = so3.log(np.swapaxes(R_nb[:-1], 1, 2) @ R_nb[1:]) * RATE_HZ
    gyro = np.vstack([turned[:1], turned]) + 4e-4 * rng.standard_normal((7200, 3))
    mag = np.einsum("nji,j->ni", R_nb, [0.2, 0.05, 0.45]) + 1e-3 * rng.standard_normal((7200, 3))
    dt_s = np.diff(time_s, prepend=np.nan)
    return Track(time_s, dt_s, mag, gyro, None, {}, (slice(0, 7200),))
