"""Many settings at once are judged as each of them alone."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.diagnosis.innovation_filter.evidence import log_bayes
from ahrsd.diagnosis.innovation_filter.score import total_score
from ahrsd.diagnosis.rules.choices import choices


def settings(rng, width, count=40):
    """Columns of every strength down to none, projected; sums of squares before that."""
    X = rng.standard_normal((count, 60, width)) * 10.0 ** rng.uniform(-3, 3, (count, 1, width))
    X[0] = 0.0
    G = np.swapaxes(X, 1, 2) @ X
    s = np.swapaxes(X, 1, 2) @ rng.standard_normal(60) + 4.0 * np.einsum("kii->ki", G) ** 0.5
    return G, s * rng.choice([-1.0, 1.0], (count, 1)), 3.0 * np.einsum("kii->ki", G)


@pytest.mark.parametrize("width", [1, 3, 9])
def test_evidence_of_many_settings_is_that_of_each(width):
    rng = np.random.default_rng(width)
    G, s, power = settings(rng, width)
    scale = 10.0 ** rng.uniform(-2, 0, width)
    many = choices(G, s, power, scale, 0.3)
    each = [total_score(*one, scale, 0.3) for one in zip(G, s, power, strict=True)]
    assert {what.rank for what in each} >= {0, width}
    assert many.seen.sum(axis=1).tolist() == [what.rank for what in each]
    assert many.log_bayes(1.7) == pytest.approx([log_bayes(what, 1.7) for what in each])
    below = [np.any(w.value <= -2 * np.sqrt(np.diag(w.covariance))) and w.rank > 0 for w in each]
    assert many.below_zero(2.0).tolist() == below
    assert 0 < sum(below) < len(below)
