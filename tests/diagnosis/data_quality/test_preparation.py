"""No significant fact is found in simulated nulls and in clean recordings."""

from __future__ import annotations

import pytest
from tracks import experiment, recorded, track_of

from ahrsd.diagnosis.data_quality.facts import is_finding
from ahrsd.diagnosis.data_quality.preparation import find_facts

CLEAN = (
    "broad/01_undisturbed_slow_rotation_A",
    "broad/02_undisturbed_slow_rotation_B",
    "broad/21_undisturbed_fast_combined",
    "vn100/hand_2023_thumatti",
    "repoimu/TStick_Test11_Trial1",
    "vn100/drive_2022_rahul",
    "vn100/static_2025_kiran_5min",
)


@pytest.mark.parametrize(
    ("scenario", "motion", "sigma"),
    [("wam", "rov", 5e-4), ("mam", "slow", 5e-3), ("lam", "slow", 5e-3), ("lam", "rov", 5e-4)],
)
def test_no_facts_in_simulated_nulls(scenario: str, motion: str, sigma: float) -> None:
    for seed in range(6):
        made = experiment(scenario, motion=motion, seed=seed, samples=5000, sigma_gyro=sigma)
        assert find_facts(track_of(made)) == ()


@pytest.mark.parametrize("name", CLEAN)
@pytest.mark.recordings
def test_no_findings_in_clean_recordings(name: str) -> None:
    assert [fact.words for fact in find_facts(recorded(name)) if is_finding(fact)] == []
