"""Lost turns: their rows and numbers of steps are found, and none is invented."""

from dataclasses import replace

import numpy as np
import pytest
from odd_tracks import without_rows
from single_fact import only, value
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

GYRO_RAD_S = 2e-4  # a filter that trusts its gyro, so that the error of a lost turn decays slowly


def lossy(motion: str, share: float, sigma_gauss: float):
    """The filter run on a track with rows removed, its rates, and the number of rows lost before
    each row.
    """
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
    """The number of rows that have one of the others within so many rows."""
    return sum(bool(np.any(np.abs(others - row) <= within)) for row in rows)


@pytest.mark.parametrize(("motion", "share"), [("mam", 0.01), ("lam", 0.004)])
def test_lost_turns_hidden_by_earlier_ones_are_found_at_their_rows(
    motion: str, share: float
) -> None:
    done, rate, lost = lossy(motion, share, 3e-4)
    found = recover_lost_steps(done, rate, np.zeros(len(lost), dtype=np.int64))
    rows, truth = np.flatnonzero(found.lost), np.flatnonzero(lost)
    seen = truth[found.missed[truth] < 0.5]
    assert near(rows, truth, 2) >= 0.96 * len(rows)  # 83 of 86 and 33 of 34 here
    assert near(seen, rows, 2) >= 0.9 * len(seen)  # 83 of 91 and 33 of 34 here
    assert abs(int(found.lost.sum()) - int(lost.sum())) <= 3
    assert np.mean(found.missed) < 0.2


def test_no_lost_turn_is_found_in_a_complete_recording() -> None:
    done, rate, lost = lossy("mam", 0.0, 3e-4)
    assert not lost.any()
    assert not recover_lost_steps(done, rate, np.zeros(len(lost), dtype=np.int64)).lost.any()


def test_rows_without_readings_hide_no_lost_turn_in_other_rows() -> None:
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
def test_share_of_lost_turns_is_estimated_when_no_single_one_is_significant(motion: str) -> None:
    done, rate, lost = lossy(motion, 0.004, 3e-3)
    (fact,) = find_lost_turns(done, rate)
    assert UNSEEN in fact.setting
    assert "in all jumps together" in fact.words
    (part,) = fact.parameters
    assert part.value == pytest.approx(float(lost.mean()), abs=2 * part.std)


@pytest.mark.parametrize("motion", ["mam", "lam", "wam"])
@pytest.mark.parametrize("sigma_gauss", [3e-4, 3e-3])
def test_gyro_scale_error_is_not_taken_for_lost_turns(motion: str, sigma_gauss: float) -> None:
    done, rate, _ = lossy(motion, 0.0, sigma_gauss)
    gyro = done.model.gyro_bias_rad_s + 0.98 * rate
    slow = run_filter(replace(done.track, gyro_b_rad_s=gyro), done.model)
    assert count_from_all_jumps(done, rate) == 0.0
    assert count_from_all_jumps(slow, 0.98 * rate) == 0.0


def jumps_at(starts: list[int], step: float) -> float:
    """Evidence of forward jumps, by `step` of a lost step, at some of 9000 means over 24 rows."""
    size, near = np.full(9000, 20.0), np.zeros(9000)
    for start in starts:
        near[start - 24 : start + 24] = 1.0 - np.abs(np.arange(-24, 24)) / 24.0
    z = step * size * near + np.sqrt(size) * np.random.default_rng(4).normal(size=9000)
    return forward_excess_evidence(JumpMeans(24, np.arange(9000), z, size, np.full(9000, 2.0)))[0]


def test_only_many_forward_jumps_of_a_whole_step_are_evidence_of_lost_turns() -> None:
    many = list(range(500, 8500, 200))
    assert jumps_at(many, 1.0) > 12.0
    assert jumps_at([], 1.0) == 0.0
    assert jumps_at(many[:3], 1.0) == 0.0  # a field that jumps
    assert jumps_at(many, 0.3) == 0.0
    assert jumps_at(many, -1.0) == 0.0


def test_step_counted_twice_is_removed_and_true_lost_steps_stay() -> None:
    done, rate, lost = lossy("mam", 0.004, 3e-4)
    right = recover_lost_steps(done, rate, np.zeros(len(lost), dtype=np.int64))
    rows = np.flatnonzero(right.lost)
    twice = right.lost.copy()
    twice[rows[5:25:5] + 1] += 1
    again = recover_lost_steps(done, rate, twice)
    assert np.array_equal(again.lost[rows], right.lost[rows])
    others = np.setdiff1d(np.flatnonzero(again.lost), rows)  # one here, in a slow turn
    assert len(others) <= 1
    assert near(others, rows, 40) == 0


def test_expected_undetected_lost_turns_add_noise_along_the_turn() -> None:
    """The noise has the variance of undetected lost turns, along the turn and not across it."""
    done, _, lost = lossy("mam", 0.03, 1e-3)
    assert done.normalised_innovation > 1.5
    expected = np.full(len(lost), float(lost.mean()))
    on_average = done.track.gyro_b_rad_s * (1.0 + expected[:, None])
    told = replace(done.track, gyro_b_rad_s=on_average, lost_turns=expected)
    seen = run_filter(told, done.model)
    assert seen.normalised_innovation == pytest.approx(1.0, abs=0.12)
    never = run_filter(replace(told, lost_turns=np.zeros(len(lost))), done.model)
    assert never.normalised_innovation > 1.4


def test_fact_reports_expected_number_of_undetected_lost_turns() -> None:
    done, rate, lost = lossy("wam", 0.004, 1e-3)
    (fact,) = find_lost_turns(done, rate)
    found = np.round(fact.turned) - 1
    assert (fact.unseen[found > 0] == 0.0).all()
    assert (fact.unseen >= 0.0).all()
    assert found.sum() + fact.unseen.sum() == pytest.approx(lost.sum(), rel=0.35)


def test_each_lost_step_is_removed_only_once() -> None:
    lost = np.array([0, 0, 1, 0, 0])
    none = np.zeros(5)
    found = _RowJumps(np.full(5, -1), none, np.ones(5, dtype=np.int64), none)
    assert _apply_jumps(lost, found, np.array([1, 3])).tolist() == [0, 0, 0, 0, 0]


def test_tail_of_the_noise_is_no_evidence_of_whole_steps() -> None:
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


def test_missing_samples_are_found_without_a_gap_in_the_time_stamps() -> None:
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


def test_missing_samples_of_a_slow_motion_are_found() -> None:
    made = experiment("lam", samples=9000, seed=3, sigma_mag=3e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=3e-4)
    keep = np.flatnonzero(np.random.default_rng(5).random(len(track)) > 0.015)
    cut = without_rows(track, keep, restamp=True)
    facts = find_lost_turns(run_filter(cut, model), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    assert abs(value(only(tuple(facts))) - 0.015) < 0.008


def test_missing_samples_are_found_when_whole_seconds_are_missing_too() -> None:
    """While the filter recovers from a large jump it makes many jumps that no lost turn causes."""
    made = experiment("mam", samples=6000, seed=3, sigma_mag=3e-4)
    track = track_of(made)
    model = replace(true_model(made), sigma_mag_gauss=3e-4)
    rng = np.random.default_rng(5)
    kept = rng.random(len(track)) > 0.008
    for first in rng.integers(300, 5600, 8):
        kept[first : first + 40] = False
    cut = without_rows(track, np.flatnonzero(kept), restamp=True)
    # as slow as a filter that trusts its gyro
    slow = replace(model, sigma_gyro_rad_s=1e-4)
    facts = find_lost_turns(run_filter(cut, slow), cut.gyro_b_rad_s - model.gyro_bias_rad_s)
    fact = only(tuple(facts))
    assert fact.effect == "dropped_samples"
    assert 4 <= fact.setting["long"] <= 10


@pytest.mark.parametrize("motion", ["mam", "wam"])
def test_three_lost_samples_are_located(motion: str) -> None:
    """An unreported lost sample would look like a step of the field, a turn that is not in the
    log.
    """
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
