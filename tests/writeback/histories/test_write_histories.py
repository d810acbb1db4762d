"""Short form of the histories that histories.py runs by the hundred thousand."""

from __future__ import annotations

import pytest
import write_histories
from scripted_world import fitted

REAL = 1


@pytest.mark.parametrize("histories", [30, pytest.param(200, marks=pytest.mark.slow)])
def test_random_histories_have_no_wrong_write(histories):
    tally = write_histories.HistoriesTally()
    with fitted():
        for number in range(histories):
            write_histories.run_one(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["writes"] > histories
    assert tally.seen["saves"] > histories / 10
    assert tally.seen["CONFIRMED"] > histories / 30


@pytest.mark.parametrize("histories", [12, pytest.param(80, marks=pytest.mark.slow)])
def test_histories_with_a_client_that_writes_and_saves_have_no_wrong_write(histories):
    tally = write_histories.HistoriesTally()
    with fitted():
        for number in range(histories):
            write_histories.run_with_client(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["client saves"] > histories / 2
    assert tally.seen["client writes"] > 0
    assert tally.seen["CONFIRMED"] > 0


def test_history_with_the_real_estimator_has_no_wrong_write():
    tally = write_histories.HistoriesTally()
    for number in range(3, 3 + REAL):
        write_histories.run_real(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["writes"] > 0
