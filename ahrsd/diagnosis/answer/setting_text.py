"""How an effect was read, in words: the parts of a finding's setting that a person can act on.

A column that is logged late, a period, a time constant: they were chosen among many and are no
coefficients, so that they have no deviation of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ahrsd.diagnosis.columns.roles import shown


@dataclass(frozen=True, slots=True)
class Told:
    """Words of one part of a setting.

    words: with {} for the value, times `times`
    negative: the words where the value is below zero, with {} for its size
    """

    words: str
    times: float = 1.0
    negative: str = ""


#: by key, in the order in which they are told
TOLD: Mapping[str, Told] = {
    "covariate": Told("by the column {}"),
    "late_s": Told("logged {} s late", negative="logged {} s early"),
    "mean_s": Told("each value the mean of {} s"),
    "harmonic": Told("{} times a turn of the shaft"),
    "off_hz": Told("{} Hz faster than the column", negative="{} Hz slower than the column"),
    "frequency_hz": Told("seen at {} Hz"),
    "mains_hz": Told("as mains of {} Hz would be"),
    "period_s": Told("every {} s"),
    "width_s": Told("for {} s"),
    "hold_samples": Told("each reading held for {} samples"),
    "time_constant_s": Told("time constant {} s"),
    "radius_gauss": Told("half width of the loop {} mG", times=1e3),
    "shape": Told("course: {}"),
    "length_s": Told("lasts {} s"),
    "length_m": Told("falls off within {} m"),
    "distance_m": Told("its size is that of its field {} m away"),
}

#: what is not told, and why: it stands elsewhere in the answer, or nobody can act on it
UNTOLD: Mapping[str, str] = {
    "onset_s": "the finding's place says when",
    "end_s": "the finding's place says when",
    "start_s": "the first reading, or the zero of a phase",
    "span_s": "the recording's length",
    "phase_s": "of pulses: their first moment",
    "phase": "the first sample of those that are held",
    "turn_deg": "of a wave or a map: what it begins with",
    "reference": "the value of the column at which nothing is added",
    "reference_m": "the middle of the way",
    "place_m": "of an object: in the recording's own metres",
    "searched": "how many settings it was chosen of",
    "memory": "what iron had from before the recording",
    "relaxation_s": "one value for all",
    "window_s": "one value for all",
    "mean": "the ordinary shaking",
    "straight_g": "the mean force, at which a mount was aligned",
    "unit": "the column's value at which the coefficient counts",
    "power": "in the equation",
    "form": "which of the equation's forms",
    "of": "which of the equation's forms",
    "products": "which of the equation's forms",
    "axes": "what the repaired model turns",
    "signs": "what the repaired model turns",
    "seed": "of a simulation",
}


def setting_text(setting: Mapping[str, Any]) -> str:
    """`by the column motor_current_a; logged 0.25 s late`; empty where nothing is to be told."""
    parts = []
    for key, told in TOLD.items():
        value = setting.get(key)
        if not value:
            continue
        if isinstance(value, str):
            parts.append(told.words.format(shown(value)))
        elif isinstance(value, (list, tuple)):
            parts.append(told.words.format(" or ".join(f"{one:.3g}" for one in value)))
        elif value < 0 and told.negative:
            parts.append(told.negative.format(f"{-value * told.times:.3g}"))
        else:
            parts.append(told.words.format(f"{value * told.times:.3g}"))
    return "; ".join(parts)
