"""Lost turns beside the names: which search is believed, and what slow turns leave."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ahrsd.mismatch.diagnosis import Where
from ahrsd.mismatch.facts import Fact
from ahrsd.mismatch.limits import LIMITS
from ahrsd.mismatch.lost import believed, beyond_lost

LOST = Fact("dropped_samples", "", Where((), (), "link"), 0.98, turned=np.ones(3))
LONG = replace(LOST, setting={"hidden": True, "long": 2})
UNSEEN = replace(LOST, setting={"hidden": True, "unseen": 38.0})
STAMPED = Fact("dropped_samples", "", Where((), (), "link"), 0.98)


def fitted(nats: float) -> SimpleNamespace:
    return SimpleNamespace(fit=SimpleNamespace(log_likelihood=nats))


@pytest.mark.parametrize(
    ("lost", "put_right", "as_it_came", "stays"),
    [([LOST], 59_223.0, 47_066.0, True), ([LOST], 40.0, 60.0, False), ([], 60.0, 40.0, False)],
)
def test_lost_turns_stay_where_the_recording_is_likelier_with_them(
    lost, put_right, as_it_came, stays
):
    assert believed(lost, fitted(put_right), fitted(as_it_came)) is stays


@pytest.mark.parametrize(
    ("facts", "frame", "told"),
    [
        ([LOST], "gyro", False),
        ([LOST], "sensor", True),
        ([LONG], "sensor", False),
        ([UNSEEN], "world", False),
        ([STAMPED], "gyro", True),
        ([], "gyro", True),
    ],
)
def test_what_lost_turns_leave_is_an_error_of_the_gyro(facts, frame, told):
    left = SimpleNamespace(
        strongest=SimpleNamespace(frame=frame, evidence=400.0, p_value=0.0),
        bins=(),
        stood_in=None,
        one_source=False,
    )
    assert beyond_lost(left, facts, SimpleNamespace(limits=LIMITS)) is told
