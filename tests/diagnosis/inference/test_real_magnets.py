"""Magnets put on a sensor by hand and taken off again: BROAD, compared with the optical
attitude.
"""

from __future__ import annotations

import numpy as np
import pytest
from tracks import recorded

from ahrsd.diagnosis.inference.diagnose import diagnose

pytestmark = [pytest.mark.recordings, pytest.mark.slow]


@pytest.mark.parametrize(
    ("trial", "on_s", "off_s", "gauss"),  # `bench_known_values.py`; the size of 33 is not known
    [
        ("32_disturbed_attached_magnet_1cm", 38.5, 95.5, 0.5855),
        ("33_disturbed_attached_magnet_2cm", 41.5, 98.5, None),
        ("34_disturbed_attached_magnet_3cm", 45.5, 99.5, 0.139),
        ("36_disturbed_attached_magnet_5cm", 37.5, 98.0, 0.0556),
    ],
)
def test_magnet_is_one_vector_over_the_interval_in_which_it_was_on(trial, on_s, off_s, gauss):
    found = diagnose(recorded(f"broad/{trial}"))
    named = {one.effect: one for one in found.findings}
    assert named.keys() == {"hard_iron_step", "mag_time_lag"}
    assert len(found.findings) == 2
    magnet = named["hard_iron_step"]
    ((first, last),) = magnet.where.intervals_s
    assert (first, last) == (pytest.approx(on_s, abs=2.5), pytest.approx(off_s, abs=2.5))
    size = np.linalg.norm([one.value for one in magnet.parameters])
    assert gauss is None or size == pytest.approx(gauss, rel=0.05)
    assert magnet.heldout.nll_gain_per_sample > magnet.heldout.placebo_gain
    (lag,) = named["mag_time_lag"].parameters
    assert lag.value == pytest.approx(0.0125, abs=1.5e-3)
    assert not found.unexplained.detected
