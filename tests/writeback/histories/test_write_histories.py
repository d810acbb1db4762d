"""Short form of the histories that histories.py runs by the hundred thousand."""

from __future__ import annotations

import pytest
import write_histories
from scripted_world import fitted

REAL = 1


@pytest.mark.parametrize("histories", [30, pytest.param(200, marks=pytest.mark.slow)])
def test_random_histories_write_nothing_wrong(histories):
    tally = write_histories.HistoriesTally()
    with fitted():
        for number in range(histories):
            write_histories.run_one(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["writes"] > histories
    assert tally.seen["saves"] > histories / 10
    assert tally.seen["CONFIRMED"] > histories / 30


@pytest.mark.parametrize("histories", [12, pytest.param(80, marks=pytest.mark.slow)])
def test_histories_with_a_driver_that_saves_and_writes_are_as_right(histories):
    tally = write_histories.HistoriesTally()
    with fitted():
        for number in range(histories):
            write_histories.run_with_client(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["client saves"] > histories / 2
    assert tally.seen["client writes"] > 0
    assert tally.seen["CONFIRMED"] > 0


def test_a_history_with_the_estimator_itself_writes_nothing_wrong():
    tally = write_histories.HistoriesTally()
    for number in range(3, 3 + REAL):
        write_histories.run_real(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["writes"] > 0
