"""What a model leaves as random effects, and names held against it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tracks import experiment, track_of

from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.rules.discrepancy import beyond, discrepancy, places
from ahrsd.diagnosis.rules.regression import base
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.values import Columns


def made(samples: int = 3000) -> Track:
    return track_of(experiment("wam", motion="rov", samples=samples))


def with_field(track: Track, field: np.ndarray) -> Track:
    return replace(track, mag_b_gauss=track.mag_b_gauss + field)


def basis_of(track: Track):
    fit = fit_null(track, walk=False)
    return base(fit.context(), fit.filtered, [], 25.0)


def wandering(track: Track, size: float, seed: int = 5) -> np.ndarray:
    """A field in sensor axes with a new value every five seconds."""
    pieces = np.floor(track.time_s / 5.0).astype(int)
    values = np.random.default_rng(seed).normal(0.0, size, (pieces.max() + 1, 3))
    return values[pieces]


def step(track: Track) -> np.ndarray:
    return np.where(track.time_s >= np.median(track.time_s), 1.0, 0.0)[:, None]


def test_a_null_leaves_nothing():
    found = discrepancy(basis_of(made()))
    assert found.nats < 5.0
    assert found.noise < 1.3


def test_a_wandering_field_is_found_in_the_frame_and_of_the_size_that_it_has():
    track = made()
    found = discrepancy(basis_of(with_field(track, wandering(track, 4e-3))))
    assert found.nats > 100.0
    sensor, world, _gyro, *_ = np.exp(found.sizes)
    assert 1.5 < sensor < 6.0  # mG; the calibration takes some of it
    assert world < sensor / 2


def test_a_name_is_worth_less_beside_a_wandering_field_than_beside_noise():
    track = made()
    value = np.array([1.5e-3, -1e-3, 1e-3])
    worth = []
    for size in (0.0, 6e-3):
        basis = basis_of(with_field(track, step(track) * value + wandering(track, size)))
        columns = Columns(
            mag=np.broadcast_to(np.eye(3), (len(track), 3, 3)) * step(track)[:, :, None]
        )
        whitened = basis.whitened([columns])[0]
        known = basis.beside("step", whitened)
        worth.append(beyond(discrepancy(known), basis, whitened, np.full(3, 1e-2)))
    assert worth[0] > 30.0
    assert worth[1] < 10.0


def test_a_field_that_is_another_one_where_the_vehicle_stands_is_no_step():
    track = made()
    still = track.time_s < 20.0
    gyro = np.where(still[:, None], 0.0, track.gyro_b_rad_s)
    # the reading of the twentieth second all along, so that the sensor really stands
    mag = track.mag_b_gauss.copy()
    noise = np.random.default_rng(2).normal(0.0, 1e-3, mag.shape)
    mag[still] = mag[np.flatnonzero(~still)[0]] + noise[still]
    place = np.where(still[:, None], np.array([15e-3, -10e-3, 12e-3]), 0.0)
    basis = basis_of(replace(track, mag_b_gauss=mag + place, gyro_b_rad_s=gyro))
    rests = places(basis.context)
    inside = rests.index[still]
    assert np.mean(inside == np.bincount(inside[inside >= 0]).argmax()) > 0.9
    since = np.where(track.time_s >= 20.0, 1.0, 0.0)[:, None, None]
    whitened = basis.whitened([Columns(mag=np.eye(3) * since)])[0]
    known = basis.beside("step", whitened)
    assert beyond(discrepancy(known), basis, whitened, np.full(3, 1e-2)) < 10.0
