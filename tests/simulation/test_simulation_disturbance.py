"""Outliers, a magnet, a step and a gap; cutting an experiment into blocks."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.simulation import ScenarioSettings, simulate
from ahrsd.simulation.scenarios import Disturbances


def made(**wanted):
    return simulate(ScenarioSettings("mam", samples=1000, disturbances=Disturbances(**wanted)))


def field_difference(**wanted):
    return made(**wanted).samples.raw_b_gauss - made().samples.raw_b_gauss


def test_outliers_have_the_requested_number_and_size():
    size = np.linalg.norm(field_difference(outlier_fraction=0.1, outlier_gauss=0.2), axis=1)
    assert 60 < np.count_nonzero(size > 1e-9) < 140
    assert size[size > 1e-9] == pytest.approx(0.2)


def test_a_magnet_passes_and_leaves_nothing():
    size = np.linalg.norm(field_difference(magnet_at_s=10.0, magnet_length_s=8.0), axis=1)
    assert size.max() == pytest.approx(0.1, rel=1e-3)
    assert np.argmax(size) == pytest.approx(14.0 * 25, abs=1)
    assert size[:250].max() < 1e-12
    assert size[452:].max() < 1e-12


def test_step_stays_and_the_truth_is_that_after_it():
    step = field_difference(step_at_s=20.0, step_gauss=0.03)
    assert np.abs(step[:500]).max() < 1e-12
    assert np.linalg.norm(step[500:], axis=1) == pytest.approx(0.03)
    after = made(step_at_s=20.0).truth.hard_iron_gauss - made().truth.hard_iron_gauss
    assert after == pytest.approx(step[-1])


def test_a_gap_takes_samples_away_and_no_block_spans_it():
    gapped = made(gap_at_s=10.0, gap_length_s=2.0)
    assert len(gapped) == 1000 - 49
    assert gapped.starts == [0, 251]
    blocks = list(gapped.blocks(100))
    assert [len(b) for b in blocks] == [100, 100, 51, 100, 100, 100, 100, 100, 100, 100]
    assert [b.gap_before for b in blocks] == [True, False, False, True, *[False] * 6]
    assert np.isnan(blocks[3].dt_s[0])
    joined = np.concatenate([b.time_s for b in blocks])
    assert np.array_equal(joined, gapped.samples.time_s)
    assert np.diff(joined).max() == pytest.approx(2.0)


def test_the_first_samples_are_the_beginning():
    whole = made()
    part = whole.first(300)
    assert len(part) == 300
    assert part.starts == [0]
    assert np.array_equal(part.samples.raw_b_gauss, whole.samples.raw_b_gauss[:300])
    assert np.array_equal(part.field_b, whole.field_b[:300])


def test_invalid_fraction_is_refused():
    with pytest.raises(ValueError, match=r"outlier_fraction is 1\.5"):
        Disturbances(outlier_fraction=1.5)
