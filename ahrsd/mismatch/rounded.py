"""How large the noise is of readings that come in coarse steps.

Of coarse steps the loudness is the steps' own, a twelfth of their square.  How often a reading
differs from the one before is the noise's, along a motion that is known: so large is it that
simulations differ as often as the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ahrsd.mismatch import forward
from ahrsd.mismatch.effects.base import Effect
from ahrsd.mismatch.null import NullFit
from ahrsd.mismatch.values import Noise, Term
from ahrsd.samples import Array

_SIZES = (0.01, 2.0)  # smallest and largest noise before rounding, in steps
_TOLERANCE = 0.02  # of its logarithm: how often readings differ is not known better
_SEED = 2


def before_rounding(
    fit: NullFit,
    seen: Noise,
    step_gauss: float,
    terms: Sequence[Term],
    library: Mapping[str, Effect],
) -> Noise:
    """The noise of readings before they were rounded to such steps.

    seen: with what rounding adds, which has bounds, and a colour that follows the motion: it is
    simulated, not drawn.
    """
    from scipy.optimize import brentq  # dear to import, and seldom needed

    context = fit.context()
    truth, usual = forward.truth_along(context), np.ones(len(context.track))
    usual = usual if seen.level is None else seen.level / float(np.sqrt(np.mean(seen.level**2)))

    def law(size_gauss: float) -> Noise:
        return replace(seen, level=usual * size_gauss / seen.mag_gauss)

    def beyond(log_size: float) -> float:
        made = forward.simulated(truth, terms, law(np.exp(log_size)), _SEED, library)
        return differing(made.mag_b_gauss, step_gauss) - often

    often = differing(context.track.mag_b_gauss, step_gauss)
    low, high = (float(np.log(part * step_gauss)) for part in _SIZES)
    if beyond(low) >= 0.0:
        return law(float(np.exp(low)))
    if beyond(high) <= 0.0:
        return law(float(np.exp(high)))
    return law(float(np.exp(brentq(beyond, low, high, xtol=_TOLERANCE))))


def differing(mag_b_gauss: Array, step_gauss: float) -> float:
    """Share of the numbers of readings (N, 3) that differ from the reading before."""
    return float(np.mean(np.abs(np.diff(mag_b_gauss, axis=0)) > step_gauss / 2))
