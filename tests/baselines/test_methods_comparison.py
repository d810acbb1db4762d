"""Halves of a recording, the spread on what was not seen, and the picture of the table."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from simulation import HARD_IRON, UNIT_SOFT_IRON, blocks, simulate

from ahrsd.baselines import calibrate_with
from ahrsd.baselines.registry import PIECES, ComparisonRow, halves, spread_of
from ahrsd.report.accuracy_figures import write_methods_figure


@pytest.fixture(scope="module")
def cut():
    return blocks(simulate(n=3000).data, (700, 1, 1299, 1000), gaps=(2,))


def test_the_halves_hold_every_sample_once_and_alternate(cut):
    even, odd = halves(cut)
    seen = np.concatenate([block.time_s for half in (even, odd) for block in half])
    assert np.array_equal(np.sort(seen), np.concatenate([block.time_s for block in cut]))
    first = cut[0].time_s[0]
    for k, half in ((0, even), (1, odd)):
        for block in half:
            pieces = np.floor((block.time_s - first) / (3000 * 0.04 / PIECES) + 1e-9).astype(int)
            assert set(pieces % 2) == {k}


def test_nothing_is_bridged(cut):
    for half in halves(cut):
        begins = [block for block in half if block.gap_before]
        assert len(begins) >= PIECES // 2
        assert all(np.isnan(block.dt_s[0]) for block in begins)
        for one, other in pairwise(half):
            if not other.gap_before:
                assert other.time_s[0] - one.time_s[-1] == pytest.approx(0.04)


def test_truth_has_the_spread_of_the_noise_at_any_scale(cut):
    true = spread_of([cut], [(UNIT_SOFT_IRON, HARD_IRON)])
    assert 0.001 < true < 0.004  # 1 mG in 0.47 G
    assert spread_of([cut], [(7 * UNIT_SOFT_IRON, HARD_IRON)]) == pytest.approx(true)
    even, odd = halves(cut)
    both = spread_of([even, odd], [(UNIT_SOFT_IRON, HARD_IRON), (3 * UNIT_SOFT_IRON, HARD_IRON)])
    assert both == pytest.approx(true, rel=0.05)
    assert spread_of([cut], [(None, np.zeros(3))]) > 20 * true


def test_fit_of_one_half_is_judged_by_the_other():
    data = simulate(n=6000, faster=3.0).data
    even, odd = halves(blocks(data, (6000,)))
    answers = [calibrate_with("ellipsoid", half) for half in (even, odd)]
    assert all(answer.converged for answer in answers)
    unseen = spread_of([odd, even], [(a.soft_iron, a.hard_iron_gauss) for a in answers])
    assert unseen < 0.01


def test_the_picture_is_drawn_with_failures_in_words(tmp_path):
    good = ComparisonRow(
        "magyc", np.eye(3), np.array([0.1, -0.2, 0.3]), np.zeros(3), True, "", 0.01, 0.02
    )
    rows = [
        good,
        replace(good, method="np", hard_iron_gauss=np.array([0.1, 0.2, 90.0]), held_out=None),
        ComparisonRow(
            "twostep", None, None, None, False, "needs the field's magnitude: " + 40 * "long "
        ),
    ]
    write_methods_figure(tmp_path / "all.png", "All", rows)
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")
    write_methods_figure(tmp_path / "none.png", "None", rows[2:])
    assert (tmp_path / "none.png").stat().st_size > 1000
