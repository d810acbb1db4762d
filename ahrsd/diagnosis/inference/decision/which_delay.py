"""The kind of a delay: a late magnetometer, a filter, half a step of the gyro's integration."""

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
from ahrsd.diagnosis.inference.likelihood.candidates import candidate_scan
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis
from ahrsd.samples import Array


def delay_probabilities(
    all_sets: Hypotheses, best: Hypothesis, lag_s: Array, deviation_s: Array,
    library: Mapping[str, Effect],
) -> dict[str, float]:  # fmt: skip
    """Probabilities of the kinds of a delay, the largest first.

    A priori a filter is as probable as any other kind; it comes first only if the readings clearly
    show its form.  Half a step comes first only if the delay is half a step and no other.
    """
    delay_s, sigma_s = float(lag_s[0]), float(deviation_s[0])
    delay_row = cast("Effect", all_sets.component(LAG).row)
    plain = plain_delay(library, 1.0 if delay_s >= 0.0 else -1.0) or delay_row
    nats = {plain.identifier: 0.0}
    half_s = _half_step_s(all_sets)
    for row in library.values() if delay_s > 0.0 else ():
        if row.filters:
            filter_nats = _filter_log_odds(all_sets, best, delay_s)
            nats[row.identifier] = (
                filter_nats if filter_nats > priors.ODDS_REAL else min(filter_nats, 0.0)
            )
        elif row.of_step and half_s is not None:
            offset, usual = (delay_s - half_s) / sigma_s, delay_s / priors.ORDINARY_LAG_S
            nats_of_half = 0.5 * (usual**2 - offset**2)
            nats_of_half += float(np.log(priors.ORDINARY_LAG_S / sigma_s))
            nats[row.identifier] = nats_of_half + float(np.log(priors.HALF_STEP))
    total = np.logaddexp.reduce(list(nats.values()))
    probabilities = {identifier: float(np.exp(one - total)) for identifier, one in nats.items()}
    return dict(sorted(probabilities.items(), key=lambda item: -item[1]))


def _filter_log_odds(all_sets: Hypotheses, best: Hypothesis, delay_s: float) -> float:
    """Log odds of all of a delay being a filter's against none of it; -inf if it is a part.

    Nearly zero where the readings hardly show a filter's form.  Zero at most where they show more
    of it than a filter has: then it is neither of the two.
    """
    if LAG_FORM in best.keys:
        value, deviation = (float(one[0]) for one in coefficients(all_sets, best, LAG_FORM))
    else:
        form = delay_form(all_sets.made.context, delay_s)
        scan = candidate_scan(all_sets.made, best.keys, best.at)
        value, deviation = (float(one[0]) for one in scan.estimate(form))
    information = max(deviation**-2 - priors.LAG_IS_FILTER**-2, 1e-9)  # less the prior's
    filter_share = value / (deviation**2 * information)
    nats = information * (filter_share - 0.5)
    if abs(filter_share - 1.0) < max(2.0 / np.sqrt(information), priors.NEARLY_ALL):
        return nats
    return min(nats, 0.0) if filter_share > 1.0 else -np.inf


def _half_step_s(all_sets: Hypotheses) -> float | None:
    """Half of the recording's time step; None if the steps differ."""
    step_s = regular_step(all_sets.made.point.problem.recorded.dt_s)
    return None if step_s is None else step_s / 2.0


def delay_unit(all_sets: Hypotheses, effect: Effect) -> float:
    """The unit of an effect's delay in seconds."""
    half_s = _half_step_s(all_sets) if effect.of_step else None
    return 1.0 if half_s is None else half_s
