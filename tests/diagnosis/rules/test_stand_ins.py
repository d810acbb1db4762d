"""Names that only stand in for something else."""

import numpy as np
import pytest

from ahrsd.diagnosis.rules.stand_ins import end_where_they_began


@pytest.mark.parametrize(
    ("steps", "back"),
    [
        # a sealed trial's bump of .06 deg/s, told as three steps
        ([(-778, 438, 301), (11, -1000, 528), (775, 585, -830)], True),
        ([(500, 0, 0), (-450, 0, 0)], True),
        ([(500, 0, 0), (-350, 0, 0)], False),
        ([(500, 0, 0), (0, 500, 0), (0, 0, -500)], False),
    ],
)
def test_steps_that_cancel_are_something_that_came_and_went(steps, back):
    values = [1e-6 * np.array(one, float) for one in steps]
    assert end_where_they_began(values) is back
