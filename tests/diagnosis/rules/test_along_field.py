"""A field of a room is told from an error of the gyro by what is left along the field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.along_field import MOSTLY_SLOW, framed, in_a_field, slowness
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.regression import Base, base
from ahrsd.diagnosis.rules.unknown import Remainder, remainder
from ahrsd.diagnosis.track import Track


def basis_of(track: Track) -> Base:
    fit = fit_null(track, walk=False)
    return base(fit.context(), fit.filtered, [], 25.0)


def quiet() -> Track:
    return track_of(experiment("mam", motion="rov", samples=4000))


def in_a_room() -> Track:
    """A field of the world that is another one every ten seconds."""
    track = quiet()
    pieces = np.floor(track.time_s / 10.0).astype(int)
    field = np.random.default_rng(3).normal(0.0, 5e-3, (pieces.max() + 1, 3))[pieces]
    R_nb = fit_null(track, walk=False).context().R_nb
    return replace(track, mag_b_gauss=track.mag_b_gauss + np.einsum("nji,nj->ni", R_nb, field))


def with_a_bump() -> Track:
    """A gyro whose bias swells by 0.6 deg/s for forty seconds."""
    track = quiet()
    swell = np.exp(-(((track.time_s - 80.0) / 15.0) ** 2))[:, None] * np.array([0.7, -0.5, 0.5])
    return replace(track, gyro_b_rad_s=track.gyro_b_rad_s + 0.01 * swell)


def led_by_the_gyro(basis: Base) -> Remainder:
    left = remainder(basis, with_bins=False)
    most = 10.0 + max(one.evidence for one in left.located.values())
    gyro = replace(left.located["gyro"], evidence=most)
    return replace(left, located={**left.located, "gyro": gyro})


def test_a_room_leaves_as_much_along_the_field_and_a_gyro_nothing() -> None:
    assert slowness(basis_of(in_a_room())) > MOSTLY_SLOW
    assert abs(slowness(basis_of(with_a_bump()))) < 0.5 * MOSTLY_SLOW
    assert abs(slowness(basis_of(quiet()))) < 0.1


def test_a_course_of_the_gyro_that_explains_more_of_a_room_is_told_of_the_world() -> None:
    basis = basis_of(in_a_room())
    before = led_by_the_gyro(basis)
    after = in_a_field(basis, before)
    assert before.strongest.frame == "gyro"
    assert after.strongest.frame == "world"
    assert after.strongest.evidence == before.strongest.evidence
    assert framed(basis, before, LIMITS).strongest.frame == "world"


def test_an_error_of_the_gyro_stays_one() -> None:
    basis = basis_of(with_a_bump())
    left = led_by_the_gyro(basis)
    assert in_a_field(basis, left) is left
    assert framed(basis, left, LIMITS).strongest.frame == "gyro"


@pytest.mark.slow
@pytest.mark.recordings
def test_a_magnet_that_stands_in_the_room_is_an_unknown_of_the_world() -> None:
    found = diagnose(recorded("broad/28_disturbed_stationary_magnet_A"))
    assert [one.effect for one in found.findings] == ["mag_time_lag"]
    where = found.unexplained.where
    assert where is not None
    assert where.frame == "world"
    assert sum(end - begin for begin, end in where.intervals_s) < 30.0
