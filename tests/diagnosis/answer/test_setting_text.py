"""How an effect was read: what of its setting is told, and in which words."""

from __future__ import annotations

import pytest
from effect_motion import moving

from ahrsd.diagnosis.answer.text import TOLD, UNTOLD, setting_text
from ahrsd.diagnosis.effects.library import EFFECTS


@pytest.mark.parametrize("name", list(EFFECTS))
def test_each_part_of_a_setting_is_told_or_left_out_for_a_reason(name):
    context, readings = moving(5)
    settings = [*EFFECTS[name].settings(context), EFFECTS[name].example(readings, 1.0)[1]]
    keys = {key for setting in settings for key in setting}
    assert keys <= TOLD.keys() | UNTOLD.keys()
    assert not TOLD.keys() & UNTOLD.keys()


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ({}, ""),
        ({"onset_s": 12.5, "searched": 40}, ""),
        (
            {"covariate": "motor_current_a", "reference": 0.2, "late_s": 0.2375, "mean_s": 0.4},
            "by the column motor_current_a; logged 0.237 s late; each value the mean of 0.4 s",
        ),
        (
            {"late_s": -0.05, "covariate": "heater"},
            "by the column heater; logged 0.05 s early",
        ),
        ({"covariate": "i_a", "late_s": 0.0, "mean_s": 0.0}, "by the column i_a"),
        (
            {"start_s": 3.0, "period_s": 2.0000012, "phase_s": 0.4, "width_s": 0.0612},
            "every 2 s; for 0.0612 s",
        ),
        ({"radius_gauss": 0.0063, "memory": (0.0, 0.5, 0.0)}, "half width of the loop 6.3 mG"),
        ({"time_constant_s": 1.2096}, "time constant 1.21 s"),
        ({"frequency_hz": 10.0031, "mains_hz": []}, "seen at 10 Hz"),
        (
            {"frequency_hz": 10.0031, "mains_hz": [50.0, 60.0]},
            "seen at 10 Hz; as mains of 50 or 60 Hz would be",
        ),
        ({"covariate": "rpm", "harmonic": 2, "off_hz": -0.012},
         "by the column rpm; 2 times a turn of the shaft; 0.012 Hz slower than the column"),
        ({"hold_samples": 4, "phase": 3}, "each reading held for 4 samples"),
        ({"shape": "wave", "length_s": 40.0}, "course: wave; lasts 40 s"),
        ({"covariate": "an\nodd name"}, "by the column an\\nodd name"),
    ],
)  # fmt: skip
def test_the_words(setting, text):
    assert setting_text(setting) == text
