"""Short forms of the write-safety campaign (docs/validation/campaign.md)."""

from __future__ import annotations

import json
from pathlib import Path

import campaign_cuts
import campaign_faults
import campaign_histories
import pytest

RESULT = Path(__file__).parents[3] / "docs" / "validation" / "campaign" / "campaign.json"


def test_power_cut_never_leaves_an_unreported_disagreement():
    tally = campaign_cuts.CutTally()
    for step in campaign_cuts.STEPS:
        for number in range(6):
            campaign_cuts.run_one(step, number, 7, tally)
    assert set(tally.cuts.values()) == {6}
    assert tally.again > 0
    assert len(tally.ends) >= 4
    assert tally.disagreements == []
    assert tally.unrecoverable == []
    assert tally.flash_after == 0


def test_every_step_has_points_for_power_cuts():
    places = campaign_cuts.places()
    assert len(campaign_cuts.STEPS) == 12
    assert all(places[step] for step in campaign_cuts.STEPS)


def test_check_detects_a_disagreement_and_a_lost_journal():
    rig = campaign_cuts.make()
    old = rig.device.held()
    rig.whole_way()
    new = rig.device.held()
    assert campaign_cuts.disagreement(rig, old, new) == ""
    assert campaign_cuts.unrecoverable(rig, old) == ""
    rig.device.ram[23] = old[23]
    assert "has other values" in campaign_cuts.disagreement(rig, old, new)
    rig.journal.clear()
    assert "knows of nothing" in campaign_cuts.unrecoverable(rig, old)


def test_nothing_is_written_when_a_gate_is_closed():
    tally = campaign_histories.HistoryTally()
    with campaign_histories.remembered():
        for number in range(300):
            campaign_histories.run_one(number, 7, tally)
    assert tally.wrong == []
    assert tally.writes.keys() | tally.saves.keys() <= {"flash gate red", "mixed"}
    assert tally.saves["flash gate red"] == 0
    assert tally.writes["flash gate red"] > 50  # RAM is written: only the flash is forbidden
    assert tally.saves["mixed"] > 0


def test_run_recovers_from_random_faults_and_stops_cleanly():
    tally = campaign_faults.FaultTally()
    for number in range(3):
        campaign_faults.run_one(number, 7, tally)
    assert sum(tally.cycles.values()) == 3 * campaign_faults.PER_SCHEDULE
    assert tally.exceptions == []
    assert tally.hangs == []
    assert tally.differs == []
    assert (tally.leaked_threads, tally.leaked_files) == (0, 0)
    assert tally.samples > 500


@pytest.mark.parametrize(
    "number", [506, 1079, *(pytest.param(n, marks=pytest.mark.slow) for n in (1499, 2375))]
)
def test_fault_schedules_that_once_failed_now_pass(number):
    """Two once continued without samples, two left output settings in the device that nobody had
    kept.
    """
    tally = campaign_faults.FaultTally()
    campaign_faults.run_one(number, 1, tally)
    assert tally.hangs + tally.outputs_changed + tally.exceptions + tally.differs == []
    assert tally.samples > 100


@pytest.mark.parametrize("part", ["cuts", "histories", "cycles"])
def test_published_result_is_that_of_this_campaign(part):
    found = json.loads(RESULT.read_text())["parts"][part]
    assert found["runs"] > 0
    assert found["tally"]
