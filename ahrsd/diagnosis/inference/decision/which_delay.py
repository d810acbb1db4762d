"""Which delay it is: a late magnetometer, a filter, half a step of the gyro's integration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.delay import regular_step
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.inference.components.effect_components import (
    LAG,
    LAG_FORM,
    delay_form,
    plain_delay,
)
from ahrsd.diagnosis.inference.decision.members import coefficients
from ahrsd.diagnosis.inference.likelihood.candidates import beside
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.samples import Array


def which_delay(
    all_sets: Hypotheses, best: Hypothesis, lag_s: Array, deviation_s: Array,
    library: Mapping[str, Effect],
) -> dict[str, float]:  # fmt: skip
    """Which delay it is, with probabilities, that which is told first.

    A filter's is as likely before the readings as any other, and told first only where its form is
    surely there; half a step's where the delay is that and no other.
    """
    tau, unsure = float(lag_s[0]), float(deviation_s[0])
    late = cast("Effect", all_sets.component(LAG).row)
    plain = plain_delay(library, 1.0 if tau >= 0.0 else -1.0) or late
    nats = {plain.identifier: 0.0}
    half_s = _half_step_s(all_sets)
    for row in library.values() if tau > 0.0 else ():
        if row.filters:
            whole = _nats_of_filter(all_sets, best, tau)
            nats[row.identifier] = whole if whole > priors.ODDS_REAL else min(whole, 0.0)
        elif row.of_step and half_s is not None:
            miss, usual = (tau - half_s) / unsure, tau / priors.ORDINARY_LAG_S
            point = 0.5 * (usual**2 - miss**2) + float(np.log(priors.ORDINARY_LAG_S / unsure))
            nats[row.identifier] = point + float(np.log(priors.HALF_STEP))
    total = np.logaddexp.reduce(list(nats.values()))
    shares = {name: float(np.exp(one - total)) for name, one in nats.items()}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def _nats_of_filter(all_sets: Hypotheses, best: Hypothesis, tau: float) -> float:
    """What the readings say for all of a delay being a filter's against none of it; -inf of a part.

    Where the readings hardly show a filter's form, next to nothing.  Nor where they have more of it
    than a filter has: then it is neither of the two.
    """
    if LAG_FORM in best.keys:
        value, deviation = (float(one[0]) for one in coefficients(all_sets, best, LAG_FORM))
    else:
        form = delay_form(all_sets.made.context, tau)
        scan = beside(all_sets.made, best.keys, best.at)
        value, deviation = (float(one[0]) for one in scan.likeliest(form))
    shown = max(deviation**-2 - priors.LAG_IS_FILTER**-2, 1e-9)  # without what was believed before
    part = value / (deviation**2 * shown)
    nats = shown * (part - 0.5)
    if abs(part - 1.0) < max(2.0 / np.sqrt(shown), priors.NEARLY_ALL):
        return nats
    return min(nats, 0.0) if part > 1.0 else -np.inf


def _half_step_s(all_sets: Hypotheses) -> float | None:
    """Half of the recording's step, None where the steps are not alike."""
    step_s = regular_step(all_sets.made.point.problem.recorded.dt_s)
    return None if step_s is None else step_s / 2.0


def delay_unit(all_sets: Hypotheses, effect: Effect) -> float:
    """Seconds of an effect's unit of delay."""
    half_s = _half_step_s(all_sets) if effect.of_step else None
    return 1.0 if half_s is None else half_s
