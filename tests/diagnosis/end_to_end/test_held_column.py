"""A current that was logged seldom."""

from __future__ import annotations

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.one_model.diagnose import diagnose_logged

RATE_HZ = 25.0


def held(values, rows):
    return values[(np.arange(len(values)) // rows) * rows]


@pytest.mark.slow
def test_a_current_that_was_logged_five_times_a_second_is_one_name():
    one = made(
        Trial(seed=11, effects=(("motor_current_field", 1.0),), samples=8_000, rate_hz=RATE_HZ)
    )
    current = held(one.track.covariates["motor_current_a"], 5)
    track = one.track.with_columns({**one.track.covariates, "motor_current_a": current})
    found = diagnose_logged(track)
    # as it was held it is late, which a field by its change explains
    assert [x.effect for x in found.findings] == ["motor_current_field"]
    assert not found.unexplained.detected
    assert found.notes[0] == (
        "logged more seldom than the sensor and drawn straight between its values: "
        "motor_current_a (every 0.2 s)"
    )
    _, value, _ = one.truth[0]
    np.testing.assert_allclose([p.value for p in found.findings[0].parameters], value, rtol=0.02)
