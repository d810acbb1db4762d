"""Lost turns one by one: which rows, how many steps, and that none is made up."""

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import without_rows
from told_facts import only, value
from tracks import experiment, track_of, true_model

from ahrsd.diagnosis.data_quality.dropped_samples import (
    UNSEEN,
    JumpMeans,
    _apply_jumps,
    _RowJumps,
    count_from_all_jumps,
    find_lost_turns,
    forward_excess_evidence,
    recover_lost_steps,
    whole_step_evidence,
)
from ahrsd.diagnosis.data_quality.preparation import correct_track
from ahrsd.diagnosis.innovation_filter.innovation import run_filter

GYRO_RAD_S = 2e-4  # of a filter that believes its gyro: what is lost stays with it for long


def lossy(motion: str, share: float, sigma_gauss: float):
    """The filter's run of a track without some rows, its rate, and how many each row has lost."""
    made = experiment(motion, samples=9000, seed=3, sigma_mag=sigma_gauss)
    whole, model = track_of(made), replace(true_model(made), sigma_mag_gauss=sigma_gauss)
    model = replace(model, sigma_gyro_rad_s=GYRO_RAD_S)
    keep = np.flatnonzero(np.random.default_rng(5).random(len(whole)) > share)
    time_s = whole.time_s[: len(keep)]
    cut = replace(
        whole,
        time_s=time_s,
        dt_s=np.diff(time_s, prepend=np.nan),
        mag_b_gauss=whole.mag_b_gauss[keep],
        gyro_b_rad_s=whole.gyro_b_rad_s[keep],
        accel_b_m_s2=None,
        runs=(slice(0, len(keep)),),
    )
    lost = np.diff(keep, prepend=-1) - 1
    return run_filter(cut, model), cut.gyro_b_rad_s - model.gyro_bias_rad_s, lost


def near(rows: np.ndarray, others: np.ndarray, within: int) -> int:
    """How many of the rows have one of the others so near."""
    return sum(bool(np.any(np.abs(others - row) <= within)) for row in rows)


@pytest.mark.parametrize(("motion", "share"), [("mam", 0.01), ("lam", 0.004)])
def test_what_the_first_ones_hid_is_found_where_it_was_lost(motion: str, share: float) -> None:
    done, rate, lost = lossy(motion, share, 3e-4)
    found = recover_lost_steps(done, rate, np.zeros(len(lost), dtype=np.int64))
    rows, truth = np.flatnonzero(found.lost), np.flatnonzero(lost)
    seen = truth[found.missed[truth] < 0.5]
    assert near(rows, truth, 2) >= 0.96 * len(rows)  # 83 of 86 and 33 of 34 here
    assert near(seen, rows, 2) >= 0.9 * len(seen)  # 83 of 91 and 33 of 34 here
    assert abs(int(found.lost.sum()) - int(lost.sum())) <= 3
    assert np.mean(found.missed) < 0.2


def test_nothing_is_lost_where_nothing_was() -> None:
    done, rate, lost = lossy("mam", 0.0, 3e-4)
    assert not lost.any()
    assert not recover_lost_steps(done, rate, np.zeros(len(lost), dtype=np.int64)).lost.any()


def test_rows_without_a_reading_say_nothing_and_hide_none_elsewhere() -> None:
    done, rate, lost = lossy("mam", 0.01, 3e-4)
    mag = done.track.mag_b_gauss.copy()
    mag[4000:4200] = np.nan
    blind = run_filter(replace(done.track, mag_b_gauss=mag), done.model)
    found = recover_lost_steps(blind, rate, np.zeros(len(lost), dtype=np.int64))
    assert not found.lost[4000:4200].any()
    assert (found.missed[4000:4200] == 1.0).all()
    seen = np.flatnonzero(lost[:3900])
    assert near(seen, np.flatnonzero(found.lost), 2) >= 0.8 * len(seen)


@pytest.mark.parametrize("motion", ["mam", "lam", "wam"])
def test_turns_of_which_none_stands_out_are_known_by_all_together(motion: str) -> None:
    done, rate, lost = lossy(motion, 0.004, 3e-3)
    (fact,) = find_lost_turns(done, rate)
    assert UNSEEN in fact.setting
    assert "in all jumps together" in fact.words
    (part,) = fact.parameters
    assert part.value == pytest.approx(float(lost.mean()), abs=2 * part.std)


@pytest.mark.parametrize("motion", ["mam", "lam", "wam"])
@pytest.mark.parametrize("sigma_gauss", [3e-4, 3e-3])
def test_a_gyro_that_reads_too_little_has_lost_nothing(motion: str, sigma_gauss: float) -> None:
    done, rate, _ = lossy(motion, 0.0, sigma_gauss)
    gyro = done.model.gyro_bias_rad_s + 0.98 * rate
    slow = run_filter(replace(done.track, gyro_b_rad_s=gyro), done.model)
    assert count_from_all_jumps(done, rate) == 0.0
    assert count_from_all_jumps(slow, 0.98 * rate) == 0.0


def jumps_at(starts: list[int], step: float) -> float:
    """The surplus of means over 24 rows with jumps by so much of a lost step at some of 9000."""
    size, near = np.full(9000, 20.0), np.zeros(9000)
    for start in starts:
        near[start - 24 : start + 24] = 1.0 - np.abs(np.arange(-24, 24)) / 24.0
    z = step * size * near + np.sqrt(size) * np.random.default_rng(4).normal(size=9000)
    return forward_excess_evidence(JumpMeans(24, np.arange(9000), z, size, np.full(9000, 2.0)))[0]


def test_many_jumps_of_one_step_ahead_are_lost_turns_and_others_are_not() -> None:
    many = list(range(500, 8500, 200))
    assert jumps_at(many, 1.0) > 12.0
    assert jumps_at([], 1.0) == 0.0
    assert jumps_at(many[:3], 1.0) == 0.0  # a field that jumps
    assert jumps_at(many, 0.3) == 0.0
    assert jumps_at(many, -1.0) == 0.0


def test_a_step_that_was_counted_twice_is_taken_back_and_none_that_was_lost() -> None:
    done, rate, lost = lossy("mam", 0.004, 3e-4)
    right = recover_lost_steps(done, rate, np.zeros(len(lost), dtype=np.int64))
    rows = np.flatnonzero(right.lost)
    twice = right.lost.copy()
    twice[rows[5:25:5] + 1] += 1
    again = recover_lost_steps(done, rate, twice)
    assert np.array_equal(again.lost[rows], right.lost[rows])
    others = np.setdiff1d(np.flatnonzero(again.lost), rows)  # one, of a slow turn, here
    assert len(others) <= 1
    assert near(others, rows, 40) == 0


def test_what_may_have_been_missed_is_noise_of_the_turn() -> None:
    """As loud as turns that were lost unseen make it, along the turn and not across."""
    done, _, lost = lossy("mam", 0.03, 1e-3)
    assert done.normalised_innovation > 1.5
    expected = np.full(len(lost), float(lost.mean()))
    on_average = done.track.gyro_b_rad_s * (1.0 + expected[:, None])
    told = replace(done.track, gyro_b_rad_s=on_average, lost_turns=expected)
    seen = run_filter(told, done.model)
    assert seen.normalised_innovation == pytest.approx(1.0, abs=0.12)
    never = run_filter(replace(told, lost_turns=np.zeros(len(lost))), done.model)
    assert never.normalised_innovation > 1.4


def test_a_fact_says_how_many_it_expects_beyond_those_it_found() -> None:
    done, rate, lost = lossy("wam", 0.004, 1e-3)
    (fact,) = find_lost_turns(done, rate)
    found = np.round(fact.turned) - 1
    assert (fact.unseen[found > 0] == 0.0).all()
    assert (fact.unseen >= 0.0).all()
    assert found.sum() + fact.unseen.sum() == pytest.approx(lost.sum(), rel=0.35)


def test_a_step_is_not_taken_back_twice() -> None:
    lost = np.array([0, 0, 1, 0, 0])
    none = np.zeros(5)
    found = _RowJumps(np.full(5, -1), none, np.ones(5, dtype=np.int64), none)
    assert _apply_jumps(lost, found, np.array([1, 3])).tolist() == [0, 0, 0, 0, 0]


def test_the_tail_of_noise_is_no_whole_step() -> None:
    rng = np.random.default_rng(3)
    scatter = np.full(9, 0.18)
    whole = 1.0 + 0.18 * rng.standard_normal(9)
    noise = 0.18 * rng.standard_normal(400_000)
    tail = noise[noise > 0.7][:9]
    assert len(tail) == 9
    assert whole_step_evidence(whole, scatter) > 12.0
    assert whole_step_evidence(tail, scatter) < 0.0
    assert whole_step_evidence(np.array([2.0, 1.0]), np.full(2, 0.1)) > whole_step_evidence(
        np.array([0.75, 0.8]), np.full(2, 0.1)
    )


def test_missing_samples_without_a_gap_in_the_stamps() -> None:
    made = experiment("mam", samples=6000, seed=3, sigma_mag=5e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=5e-4)
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > 0.01)
    cut = without_rows(track, keep, restamp=True)
    facts = find_lost_turns(run_filter(cut, model), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    fact = only(tuple(facts))
    assert fact.effect == "dropped_samples"
    assert 0.004 < value(fact) < 0.02
    right = correct_track(cut, (fact,))
    turned = np.linalg.norm(right.gyro_b_rad_s, axis=1) / np.linalg.norm(cut.gyro_b_rad_s, axis=1)
    assert np.count_nonzero(turned > 1.9) == len(fact.where.intervals_s)
    rate = track.gyro_b_rad_s - model.gyro_bias_rad_s
    assert find_lost_turns(run_filter(track, model), rate) == []


def test_missing_samples_of_a_slow_motion_are_seen_over_more_samples() -> None:
    made = experiment("lam", samples=9000, seed=3, sigma_mag=3e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=3e-4)
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > 0.015)
    cut = without_rows(track, keep, restamp=True)
    facts = find_lost_turns(run_filter(cut, model), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    assert abs(value(only(tuple(facts))) - 0.015) < 0.008


def test_missing_samples_are_seen_where_whole_seconds_are_missing_too() -> None:
    """On its way back from a large jump the filter makes many that no lost turn makes."""
    made = experiment("mam", samples=6000, seed=3, sigma_mag=3e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=3e-4)
    rng = np.random.default_rng(5)
    kept = rng.random(len(track)) > 0.008
    for first in rng.integers(300, 5600, 8):
        kept[first : first + 40] = False
    cut = without_rows(track, np.flatnonzero(kept), restamp=True)
    # as slow as a filter is that believes its gyro
    slow = replace(model, sigma_gyro_rad_s=1e-4)
    facts = find_lost_turns(run_filter(cut, slow), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    fact = only(tuple(facts))
    assert fact.effect == "dropped_samples"
    assert 4 <= fact.setting["long"] <= 10


@pytest.mark.parametrize("motion", ["mam", "wam"])
def test_three_lost_samples_are_told_where_they_are(motion: str) -> None:
    """What is not told of them is a step of the field: a turn that is not in the log."""
    made = experiment(motion, samples=9000, seed=3, sigma_mag=3e-4)
    track, model = track_of(made), replace(true_model(made), sigma_mag_gauss=3e-4)
    quick = np.argsort(-np.linalg.norm(track.gyro_b_rad_s, axis=1))
    rows: list[int] = []
    for row in quick.tolist():
        if 100 < row < 8900 and all(abs(row - other) > 500 for other in rows) and len(rows) < 3:
            rows.append(row)
    cut = without_rows(track, np.delete(np.arange(len(track)), rows), restamp=True)
    slow = replace(model, sigma_gyro_rad_s=GYRO_RAD_S)
    facts = find_lost_turns(run_filter(cut, slow), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    fact = only(tuple(facts))
    told_s = [end for _, end in fact.where.intervals_s]
    at_s = [cut.time_s[row - k] for k, row in enumerate(sorted(rows))]
    assert told_s == pytest.approx(at_s, abs=3 * float(np.nanmedian(cut.dt_s)))
