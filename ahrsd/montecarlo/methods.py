"""The methods that a Monte Carlo knows: ours, whole and as a stream, and the published ones.

The published ones are given what each needs and a simulation knows: the attitude, the field in the
world and its magnitude (`magfactor3`, `twostep`, [L]'s) and the gyro bias (`magical-ls`). The name
of a method that uses the gyro may end in "+savgol": readings smoothed by a Savitzky-Golay filter
first, as the authors' notebooks do.
"""

from __future__ import annotations

from collections.abc import Callable

from ahrsd.baselines import METHODS, MethodError, MethodSettings, calibrate_with
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.montecarlo.accuracy import MethodAnswer
from ahrsd.simulation import Experiment

Batch = Callable[[Experiment], MethodAnswer]

OURS = "magyc"
STREAM = "magyc-stream"
SMOOTHED = "+savgol"
_BLOCK = 1000


def known_methods() -> tuple[str, ...]:
    """Ids of all methods, ours first."""
    return (OURS, STREAM, *METHODS)


def is_known(name: str) -> bool:
    """Whether it is an id, or one of a method that uses the gyro with "+savgol"."""
    plain = name.removesuffix(SMOOTHED)
    smoothable = plain in METHODS and "gyro" in METHODS[plain].needs
    return smoothable if plain != name else name in known_methods()


def batch_method(name: str) -> Batch:
    """What answers from a whole experiment; raises MethodError where it has no answer."""
    if name == OURS:
        return _ours
    return lambda experiment: _published(name, experiment)


def _ours(experiment: Experiment) -> MethodAnswer:
    estimator = Estimator(at_once=WHOLE)
    for block in experiment.blocks(_BLOCK):
        estimator.add(block)
    estimate = estimator.finish()
    if estimate is None:
        raise MethodError("no estimate")
    return MethodAnswer.of(estimate)


def present(estimator: Estimator) -> MethodAnswer:
    """What a stream's estimator says now.  MethodError before its first estimate."""
    estimate = estimator.estimate()
    if estimate is None:
        raise MethodError("no estimate yet")
    return MethodAnswer.of(estimate)


def _published(name: str, experiment: Experiment) -> MethodAnswer:
    plain = name.removesuffix(SMOOTHED)
    truth = experiment.truth
    result = calibrate_with(
        plain,
        list(experiment.blocks(_BLOCK)),
        settings=MethodSettings(
            known_gyro_bias_rad_s=truth.gyro_bias_rad_s,
            derivative="savgol" if plain != name else "median",
        ),
        R_nb=experiment.R_nb,
        field_n_gauss=experiment.R_nb[0] @ experiment.field_b[0],
        field_norm_gauss=truth.field_gauss,
    )
    if not result.converged:
        raise MethodError(result.reason)
    return MethodAnswer(result.soft_iron, result.hard_iron_gauss, result.gyro_bias_rad_s)
