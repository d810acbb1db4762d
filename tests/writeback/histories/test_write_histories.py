"""Short form of the histories that histories.py runs by the hundred thousand."""

from __future__ import annotations

import write_histories
from scripted_world import fitted

HISTORIES, CLIENTS, REAL = 100, 40, 1


def test_random_histories_write_nothing_wrong():
    tally = write_histories.HistoriesTally()
    with fitted():
        for number in range(HISTORIES):
            write_histories.run_one(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["writes"] > HISTORIES
    assert tally.seen["saves"] > HISTORIES / 10
    assert tally.seen["CONFIRMED"] > HISTORIES / 30


def test_histories_with_a_driver_that_saves_and_writes_are_as_right():
    tally = write_histories.HistoriesTally()
    with fitted():
        for number in range(CLIENTS):
            write_histories.run_with_client(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["client saves"] > CLIENTS / 2
    assert tally.seen["client writes"] > 0
    assert tally.seen["CONFIRMED"] > 0


def test_a_history_with_the_estimator_itself_writes_nothing_wrong():
    tally = write_histories.HistoriesTally()
    for number in range(3, 3 + REAL):
        write_histories.run_real(number, 1, tally)
    assert tally.wrong == []
    assert tally.seen["writes"] > 0
