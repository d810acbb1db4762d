"""Samples that wait for an answer of the device: which are released, in which order, and which
never.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ahrsd.core.sample_source import MOST_ROWS, UnconfirmedSamples
from ahrsd.samples import SampleBlock


def block(number: int, rows: int = 4) -> SampleBlock:
    """A block identified by its temperature."""
    time_s = number + np.arange(rows) / rows
    dt_s = np.full(rows, 1.0 / rows)
    return SampleBlock(
        time_s, dt_s, time_s, np.ones((rows, 3)), np.zeros((rows, 3)), np.zeros((rows, 3)),
        {"temperature_c": np.full(rows, float(number))},
    )  # fmt: skip


def numbers(released) -> list[int]:
    return [int(one.covariates["temperature_c"][0]) for group, _ in released for one in group]


def holding(*came: int) -> UnconfirmedSamples[str]:
    line: UnconfirmedSamples[str] = UnconfirmedSamples()
    for number in came:
        line.hold(block(number), float(number), f"how {number}")
    return line


def test_samples_before_the_query_are_released_and_later_ones_wait():
    line = holding(1, 2, 3)
    released = line.confirm(2.0)
    assert numbers(released) == [1, 2]
    assert [how for _, how in released] == ["how 2"]
    assert line.span_s == 1.0
    assert numbers(line.confirm(9.0)) == [3]
    assert line.span_s == 0.0


def test_released_samples_come_in_groups():
    released = holding(1, 2, 3, 4, 5).confirm(9.0)
    assert [len(group) for group, _ in released] == [2, 2, 1]
    assert [how for _, how in released] == ["how 2", "how 4", "how 5"]


def test_answer_to_a_query_from_before_the_doubt_is_ignored():
    line = holding(1)
    line.confirm(1.5)
    line.hold(block(2), 2.0, "")
    line.mark_doubt(2.5, perhaps_restarted=False)
    assert line.confirm(2.2) == []
    assert numbers(line.confirm(2.6)) == [2]


def test_samples_between_two_unanswered_doubts_are_dropped():
    line = holding(1)
    line.mark_doubt(1.5, perhaps_restarted=False)
    line.hold(block(2), 2.0, "")
    line.mark_doubt(2.5, perhaps_restarted=False)
    line.hold(block(3), 3.0, "")
    released = line.confirm(4.0)
    assert numbers(released) == [1, 3]
    assert line.dropped == 4
    first, after = released[0][0]
    assert np.isfinite(first.dt_s).all()
    assert after.gap_before
    assert np.isnan(after.dt_s[0])
    assert np.isfinite(after.dt_s[1:]).all()


def test_samples_from_before_a_possible_restart_are_dropped():
    line = holding(1, 2)
    line.mark_doubt(2.5, perhaps_restarted=True)
    line.hold(block(3), 3.0, "")
    assert numbers(line.confirm(4.0)) == [3]
    assert line.dropped == 8


def test_memory_is_bounded_when_the_device_never_answers():
    line: UnconfirmedSamples[None] = UnconfirmedSamples()
    for number in range(MOST_ROWS // 1000 + 50):
        line.hold(block(number, 1000), float(number), None)
    kept = numbers(line.confirm(1e9))
    assert len(kept) == MOST_ROWS // 1000
    assert kept[-1] == MOST_ROWS // 1000 + 49
    assert line.dropped == 50 * 1000


@given(st.lists(st.sampled_from(["hold", "gap", "restart", "ask", "answer"]), max_size=60))
def test_released_samples_are_confirmed_before_and_after(script):
    """Judged by a plain implementation of the rule over the whole history."""
    line: UnconfirmedSamples[int] = UnconfirmedSamples()
    events, asked, counted = [], None, []
    for at_s, what in enumerate(script, start=1):
        events.append((at_s, "nothing" if what == "answer" else what))
        if what == "hold":
            line.hold(block(at_s), float(at_s), at_s)
        elif what in ("gap", "restart"):
            line.mark_doubt(float(at_s), perhaps_restarted=what == "restart")
        elif what == "ask":
            asked = at_s
        elif asked is not None:
            counted += numbers(line.confirm(float(asked)))
            events[-1] = (at_s, f"answer {asked}")
    assert counted == [at_s for at_s, what in events if what == "hold" and vouched(events, at_s)]
    assert line.dropped % 4 == 0


def vouched(events: list[tuple[int, str]], came: int) -> bool:
    """Whether the block that came then may be used by the end of the history."""
    doubts = [(at, what) for at, what in events if what in ("gap", "restart")]
    good = [  # answers to queries that no doubt followed
        (at, int(what.split()[1]))
        for at, what in events
        if what.startswith("answer")
        and not any(int(what.split()[1]) <= doubt < at for doubt, _ in doubts)
    ]
    behind = min((at for at, asked in good if asked >= came and at > came), default=None)
    if behind is None:
        return False
    between = [(at, what) for at, what in doubts if came < at < behind]
    if any(what == "restart" for _, what in between):
        return False
    if not between:
        return True
    last_doubt = max((at for at, _ in doubts if at < came), default=0)
    return not last_doubt or any(last_doubt < at and at < between[0][0] for at, _ in good)
