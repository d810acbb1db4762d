"""Time of a run: the device's clock, going on where it began again."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.report.contents import RunTime


def test_it_is_the_devices_time_until_it_restarts():
    clock = RunTime()
    assert np.isnan(clock.newest_s)
    assert clock.samples(np.array([12.0, 12.5])).tolist() == [12.0, 12.5]
    assert clock.at(12.4) == 12.4
    assert clock.newest_s == 12.5


@pytest.mark.parametrize("in_one_block", [False, True])
def test_it_goes_on_behind_a_restart(in_one_block):
    clock = RunTime()
    before, after = np.array([400.0, 401.0]), np.array([0.5, 1.5, 2.5])
    if in_one_block:
        found = clock.samples(np.concatenate([before, after]))
    else:
        found = np.concatenate([clock.samples(before), clock.samples(after)])
    assert found.tolist() == [400.0, 401.0, 402.0, 403.0, 404.0]
    assert clock.at(2.5) == 404.0  # an event of now
    assert clock.at(399.0) == 399.0  # one of before, which is told late


def test_an_event_before_the_first_sample_behind_a_restart_is_at_the_end():
    clock = RunTime()
    clock.samples(np.array([480.0]))
    assert clock.at(0.3) == 481.0
    assert clock.at(475.0) == 475.0


def test_a_second_restart_goes_on_as_well():
    clock = RunTime()
    for block in ([10.0], [3.0], [1.0, 2.0]):
        found = clock.samples(np.array(block))
    assert found.tolist() == [12.0, 13.0]
