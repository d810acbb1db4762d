"""Which delay it is: magnetometer late, gyro late, a low-pass, or half a sample of convention.

All four act as one number, tau, and only the motion's finer structure tells some of them apart.
With the delay taken out of the track exactly, each is weighed against the plain lag:

    low-pass     what A (LP_tau[h](t) - h(t - tau)) explains beyond the lag, at its full size
    half sample  tau = dt / 2 exactly: a point against the lag's decade of possible sizes
    sign         a late magnetometer and a late gyro have opposite signs; neither is early
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.calibration_fit.delay import beyond_the_lag
from ahrsd.diagnosis.effects.base import Effect
from ahrsd.diagnosis.innovation_filter.evidence import posterior
from ahrsd.diagnosis.innovation_filter.gram import solve
from ahrsd.diagnosis.rules.regression import Base
from ahrsd.samples import Array

#: effects that are a delay of the magnetometer against the gyro, and their sign
DELAYS: Mapping[str, float] = {
    "mag_time_lag": 1.0,
    "mag_low_pass": 1.0,
    "gyro_integration": 1.0,
    "gyro_time_lag": -1.0,
}
#: log prior against the plain lag: rarer, and told only where the data ask for it
RARER = {"mag_low_pass": -1.0, "gyro_integration": -2.0}


def plain(lag_s: float) -> str:
    """The plain lag of that sign."""
    return "mag_time_lag" if lag_s >= 0 else "gyro_time_lag"


def weighed(
    basis: Base,
    library: Mapping[str, Effect],
    lag_s: float,
    deviation_s: float,
    recorded_step_s: float | None,
) -> dict[str, float]:
    """Probabilities of the delays; basis: of the model with the lag taken out and its term in.

    recorded_step_s: None where the steps are not alike: then there is no half of one
    """
    name = plain(lag_s)
    scale = library[name].parameters[0].scale
    evidence = {name: 0.0}
    if lag_s > 0:
        evidence["mag_low_pass"] = _low_pass(basis, lag_s)[0]
    if lag_s > 0 and recorded_step_s is not None:
        miss = (lag_s - recorded_step_s / 2) / max(deviation_s, 1e-9)
        evidence["gyro_integration"] = float(
            0.5 * ((lag_s / scale) ** 2 - miss**2) + np.log(scale / max(deviation_s, 1e-9))
        )
    found = posterior(evidence, RARER)
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def time_constant_less_lag(basis: Base, name: str, lag_s: float) -> float:
    """By how much the time constant of a low-pass differs from the lag that fits best, seconds.

    name: group of the delay's term.  In quick turns a filter trails by less than its time constant.
    """
    return -float(_low_pass(basis, lag_s)[1][basis.groups[name]][0])


def _low_pass(basis: Base, lag_s: float) -> tuple[float, Array]:
    """Log likelihood ratio of a low-pass of that delay against the plain lag.

    And what it moves the known coefficients (q,) by.
    """
    X = basis.whitened([beyond_the_lag(basis.context, lag_s)])[0].reshape(-1)
    Z = basis.known.reshape(-1, basis.known.shape[2])
    M = solve(Z.T @ Z, (Z.T @ X)[:, None])[:, 0]
    rest = X - Z @ M
    s, G = float(rest @ basis.innovation.ravel()), float(rest @ X)
    return (s - 0.5 * G) / basis.colour, M
