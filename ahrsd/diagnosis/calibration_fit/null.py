"""The null: calibration and noise that explain a recording best.

`descent` finds the lowest cost from where it is set down.  The cold start descends on a thinned
track (`coarse`) from a sphere, from no iron and from a linear fit with the gyro, with the gyro's
noise inflated 30, 10, 3, 1 times: a short memory forgives a wrong bias and soft iron.  Where none
of these explains the data nor two agree, it begins anew at 100 times.  Where that noise
turns up more field than the magnetometer's own, the size of the field says where the iron is, by a
valley too narrow to be followed in straight steps: there it begins at the ellipsoid of the
readings, as it is.

A Gaussian prior (`prior`) keeps what the motion does not show.

Noise by innovation likelihood: the filter's gain is a function of sigma_gyro / sigma_mag, the
scale follows from the mean square.  sigma_gyro is never more than CAP times what the gyro's own
differences say: free, it swallows every drift of the gyro.  For the same reason the bias wanders
only when the likelihood says so, and not faster than WALK_CAP.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Baseline
from ahrsd.diagnosis.calibration_fit import noise_fit
from ahrsd.diagnosis.calibration_fit.coarse import group_size, thinned
from ahrsd.diagnosis.calibration_fit.descent import FitProblem, NullFit, descended
from ahrsd.diagnosis.calibration_fit.prior import (
    TURNED,
    ellipsoid,
    prior_of,
    repetition_of,
    sphere_centre,
    turned,
)
from ahrsd.diagnosis.calibration_fit.thin import turned_up
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.model import NullModel
from ahrsd.diagnosis.track import NothingToFit, Spec, Track
from ahrsd.estimator import chain
from ahrsd.estimator.chain import linear_start
from ahrsd.samples import Array

#: inflations of the gyro's noise by which a cold start descends, and most steps at each; where no
#: start of the first comes to what explains the data, from a shorter memory and with more steps
_LADDERS = (((30.0, 10.0, 3.0), 2), ((100.0, 30.0, 10.0, 3.0), 6))
_FEWEST = 15  # steps that a fit needs
_SHORTEST_RUN = 8  # samples of a run that the linear start can use
_STEPS = 60  # most; a fit ends where it has converged
_REESTIMATE = 0.3  # normalised innovation (log) beyond which the noise is found from the beginning
_GOOD = 1.5  # normalised innovation of a start that needs no rival
_WORTH = 10.0  # by which a further start's cost must be lower
_FARTHEST_GAUSS = 3.0  # hard iron of a start: beyond, the start is nonsense


def fit_null(
    track: Track,
    spec: Spec | None = None,
    start: NullModel | None = None,
    *,
    noise: bool = True,
    walk: bool = True,
) -> NullFit:
    """Fit calibration and noise to a track.

    start: begin there (a fit of nearly the same data) instead of cold
    noise: estimate what the spec leaves open; else keep the noise of `start`
    walk:  let the gyro's bias wander where the data say so

    NothingToFit where there is nothing to fit to (`unusable`).
    """
    reason = unusable(track)
    if reason:
        raise NothingToFit(reason)
    known = spec or Spec()
    problem = FitProblem(track, prior_of(track))
    if start is None:
        start = noise_fit.estimated(
            run_filter(track, cold_start(track, known), sensitive=False), known, walk=walk
        )
    fit = descended(problem, start, _STEPS)
    prior = problem.prior.sharper(repetition_of(fit.filtered))
    if prior is not problem.prior:
        problem = replace(problem, prior=prior)
        fit = descended(problem, start, _STEPS)
    if not noise:
        return fit
    if abs(np.log(fit.filtered.normalised_innovation)) > _REESTIMATE:
        again = noise_fit.estimated(fit.filtered, known, walk=walk)
        fit = descended(problem, again, _STEPS)
    again = noise_fit.rescaled(fit.filtered, known)
    if noise_fit.alike(again, fit.model):
        return fit
    return descended(problem, again, _STEPS)


def unusable(track: Track) -> str | None:
    """Why there is nothing that a calibration could be fitted to; None where there is."""
    if track.usual_gauss == 0.0:
        return "the magnetometer has no readings: nothing can be said about the field"
    steps = np.isfinite(track.dt_s) & np.isfinite(track.mag_b_gauss).all(axis=1)
    if np.count_nonzero(steps) < _FEWEST:
        return f"samples that follow another one: {np.count_nonzero(steps)}, {_FEWEST} are needed"
    return None


def cold_start(track: Track, spec: Spec) -> NullModel:
    """A model to begin from, without knowing anything but the track."""
    size = group_size(track)
    coarse = thinned(track, size)
    first = noise_fit.first_guess(track, spec)
    # a row's rate is the mean of its samples': their noise averages
    quiet = first.sigma_gyro_rad_s / np.sqrt(size)
    problem = FitProblem(coarse, prior_of(track))
    best: NullFit | None = None
    base = replace(first, gyro_bias_rad_s=problem.prior.mean[8:])
    by_size = _by_size(coarse, replace(base, sigma_gyro_rad_s=quiet))
    if by_size is not None:
        best = descended(problem, by_size, _STEPS)
        if best.filtered.normalised_innovation < _GOOD:
            return _of_noise(best.model, first)
    starts = _starts(coarse, base)
    for ladder, model in itertools.product(_LADDERS, starts):
        fit = _loosely(problem, model, quiet, *ladder)
        agreed = best is not None and abs(fit.cost - best.cost) < _WORTH
        if best is None or fit.cost < best.cost - _WORTH:
            best = fit
        if agreed or fit.filtered.normalised_innovation < _GOOD:
            break
    return _of_noise(first if best is None else best.model, first)


def _of_noise(model: NullModel, like: NullModel) -> NullModel:
    """A model with the noise of another one."""
    mag, gyro = like.sigma_mag_gauss, like.sigma_gyro_rad_s
    return replace(model, sigma_mag_gauss=mag, sigma_gyro_rad_s=gyro)


def _by_size(track: Track, base: NullModel) -> NullModel | None:
    """Where the field's size says more than its turns do, the iron that keeps it constant."""
    mag = track.mag_b_gauss[np.isfinite(track.mag_b_gauss).all(axis=1)]
    found = ellipsoid(mag) if turned_up(track, base) > 1.0 else None
    if found is None or not _believable(*found):
        return None
    return replace(base, soft_iron=found[0], hard_iron_gauss=found[1])


def _loosely(
    problem: FitProblem, model: NullModel, quiet: float, inflations: Sequence[float], steps: int
) -> NullFit:
    """Descend with less and less inflation of the gyro's noise."""
    for inflation in inflations:
        loose = replace(model, sigma_gyro_rad_s=quiet * inflation)
        model = descended(problem, loose, steps).model
    return descended(problem, replace(model, sigma_gyro_rad_s=quiet), _STEPS)


def _starts(track: Track, base: NullModel) -> list[NullModel]:
    """Calibrations to descend from, the most likely first."""
    seen = np.isfinite(track.mag_b_gauss).all(axis=1)
    mag = track.mag_b_gauss[seen]
    out = []
    out.append(replace(base, hard_iron_gauss=sphere_centre(mag)))
    out.append(base)
    well = turned(mag) > TURNED and seen.all()
    linear = linear_start(_epochs(track)) if well else None
    if linear is not None:
        A = chain.symmetric(linear[:6])
        A = A * 3 / np.trace(A)
        if _believable(A, linear[6:]):
            out.append(replace(base, soft_iron=A, hard_iron_gauss=linear[6:]))
    return out


def _believable(soft_iron: Array, hard_iron_gauss: Array) -> bool:
    near = np.linalg.norm(hard_iron_gauss) < _FARTHEST_GAUSS
    return bool(near and np.linalg.norm(soft_iron - np.eye(3)) < 1.0)


def _epochs(track: Track) -> list[chain.EpochData]:
    """Runs as the estimator's linear start takes them."""
    dt = np.nan_to_num(track.dt_s, nan=0.0)
    return [
        chain.EpochData(
            track.mag_b_gauss[run],
            track.gyro_b_rad_s[run] * dt[run, None],
            dt[run],
            np.full((run.stop - run.start, 3), np.nan),
            track.time_s[run],
            measures_first=True,
        )
        for run in track.runs
        if run.stop - run.start > _SHORTEST_RUN
    ]


def baseline(start: NullFit) -> Baseline:
    """What the null model leaves, for an answer."""
    done = start.filtered
    return Baseline(
        float(np.sqrt(np.mean(done.innovation[done.used] ** 2))),
        float(-np.mean(done.log_likelihood[done.used])),
        done.normalised_innovation,
    )
