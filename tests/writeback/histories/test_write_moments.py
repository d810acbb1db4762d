"""Every event at every moment of a write, judged by an independent observer.

A moment is before or after a command that the device carries out, or a record of the journal.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import write_histories
from scripted_world import POLICY, fitted
from write_events import ORIGIN_SERIAL

PLACES = [
    "after PREPARED", "before VNWRG,23", "after VNWRG,23", "before VNWRG,84", "after VNWRG,84",
    "before RAM_VERIFIED", "after RAM_VERIFIED", "before PROVEN", "after PROVEN",
    "before FLASH_SENT", "after FLASH_SENT", "before VNWNV", "after VNWNV", "after FLASH_ACKED",
]  # fmt: skip


@pytest.fixture(autouse=True)
def _cheap_estimator():
    with fitted():
        yield


def wrong(event: str, places: list[str], **options: object) -> list[str]:
    """Violations after this event at these moments, alternately on two kinds of stream."""
    tally = write_histories.HistoriesTally()
    streams = options.pop("streams", ("binary", "imu"))
    for number, place in enumerate(places):
        stream = streams[number % len(streams)]
        seed = number // len(streams)  # alternately a unit in factory state and a user's unit
        write_histories.run_at(event, place, tally, stream=stream, seed=seed, **options)
    assert tally.histories == len(places)
    assert tally.seen["PREPARED"] > 0
    return tally.wrong


def moments(events: list[str]) -> pytest.MarkDecorator:
    """Each event at a third of the moments, another third for the next event; the slow form has
    all.
    """
    thirds = [pytest.param(event, PLACES[k % 3 :: 3], id=event) for k, event in enumerate(events)]
    whole = [
        pytest.param(event, PLACES, id=f"{event}, all", marks=pytest.mark.slow) for event in events
    ]
    return pytest.mark.parametrize(("event", "places"), [*thirds, *whole])


#: after a client's save in a trial: 5 or 10 of the 240 moments
BEHIND_A_SAVE = {5: range(0, 240, 48), 10: range(0, 240, 24)}


QUICK = ("kill and other writes", "swap", "disk full", "client saves and resets")
OTHERS = ("kill", "host reboots", "restart", "other writes", "unsafe for a while", "bad line",
    "lie", "client saves", "client calibrates")  # fmt: skip


@pytest.mark.parametrize("count", [5, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "event", [*QUICK, *(pytest.param(event, marks=pytest.mark.slow) for event in OTHERS)]
)
def test_no_wrong_write_for_events_after_a_client_saves_or_resets_in_a_trial(event, count):
    names = [*write_histories.NAMES, *write_histories.CLIENT_EVENTS]
    tally, does = write_histories.HistoriesTally(), write_histories.ASIDE_FOR
    for k, turn in enumerate(BEHIND_A_SAVE[count]):
        number = (turn + names.index(event) % 16) * len(names) + names.index(event)
        write_histories.run_aside(number * len(does) + k % len(does), 2, tally)
    assert tally.wrong == []
    assert tally.events == {event: count}
    assert tally.seen["client saves"] > 0
    assert tally.seen["CLIENT_RESET"] > 0


@pytest.mark.parametrize("stream", ["binary", "imu"])
@moments(["swap", "swap and back"])
def test_no_wrong_write_when_the_unit_is_exchanged(event, places, stream):
    assert wrong(event, places, streams=(stream,)) == []


@moments(["swap"])
def test_no_wrong_write_when_the_unit_is_exchanged_and_the_serial_number_is_bound(event, places):
    assert wrong(event, places, policy=replace(POLICY, serial=ORIGIN_SERIAL)) == []


@moments(["other writes", "other writes and saves", "other saves"])
def test_no_wrong_write_when_another_program_writes(event, places):
    assert wrong(event, places) == []


@moments(["restart", "other resets"])
def test_no_wrong_write_when_the_device_restarts(event, places):
    assert wrong(event, places) == []


CLOCKS = ("clock", "kill and time is set", "host reboots")


@pytest.mark.parametrize(
    ("event", "wall_s"),
    [
        pytest.param(event, wall_s, marks=() if k == j else pytest.mark.slow)
        for k, event in enumerate(CLOCKS)
        for j, wall_s in enumerate(write_histories.WALLS_S)
    ],
)
def test_no_wrong_write_when_the_host_clock_is_set(event, wall_s):
    places = [*PLACES[::3], "after PROVEN", "after VNWNV", "after FLASH_ACKED"]
    assert wrong(event, places, wall_s=wall_s, streams=("binary",)) == []


@pytest.mark.parametrize("event", ["iron", "iron for a while", "iron while unsafe"])
def test_no_wrong_write_when_the_calibration_becomes_void(event):
    proven_on = PLACES[PLACES.index("before PROVEN") :]
    assert wrong(event, ["after RAM_VERIFIED", *proven_on]) == []


@moments(["kill", "kill and swap", "kill and other writes"])
def test_no_wrong_write_when_the_program_is_killed(event, places):
    assert wrong(event, places) == []


@moments(["stop and start", "unsafe for a while", "disk full", "person"])
def test_no_wrong_write_with_ordinary_faults(event, places):
    assert wrong(event, places) == []


@moments(["lie", "bad line", "silence", "journal lost"])
def test_no_wrong_write_when_device_or_disk_report_falsely(event, places):
    assert wrong(event, places) == []
