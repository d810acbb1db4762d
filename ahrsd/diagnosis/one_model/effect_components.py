"""The library's effects as components: one for each setting worth trying, and what a form leaves."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from ahrsd.diagnosis.delays import beyond_the_lag
from ahrsd.diagnosis.effects.base import Effect, Setting
from ahrsd.diagnosis.one_model import priors
from ahrsd.diagnosis.one_model.component import Component, Fixed, Sized
from ahrsd.diagnosis.values import Context

#: the delay that stands for all delays: which of them it is, is asked at the end
LAG = "mag_time_lag"
LAG_FORM = "form of the delay"
#: delays and what only the recorded rate shows are not asked
NOT_ASKED = (
    LAG, "gyro_time_lag", "gyro_integration", "mag_low_pass", "ac_interference", "sync_pulses",
    "rotor_field",
)  # fmt: skip
#: parts of a recording's length, and factors, to which onsets and scales are sought
_FINE = (1 / 40, 1 / 120, 1 / 400, 1 / 1200)


def library_components(
    context: Context, library: Mapping[str, Effect]
) -> dict[str, list[Component]]:
    """Every effect's settings that can be computed here, by identifier."""
    out = {}
    for name, effect in library.items():
        settings = () if name in NOT_ASKED else effect.settings(context)
        found = [component(context, effect, one, len(settings)) for one in settings]
        if found:
            out[name] = found
    return out


def component(context: Context, effect: Effect, setting: Setting, tried: int) -> Component:
    """An effect in one setting.  tried: settings among which it is chosen."""
    searched = int(setting.get("searched", 1))
    odds = float(np.log(priors.EFFECT) - np.log(max(1, tried) * max(1, searched)))
    return Component(
        key_of(effect.identifier, setting),
        effect.frame or effect.family,
        effect.columns(context, setting),
        _sized(effect),
        odds,
        effect.identifier,
        dict(setting),
    )


def delay(context: Context, library: Mapping[str, Effect]) -> Component:
    """The delay between the sensors, of either sign."""
    odds = float(np.log(priors.ORDINARY_EFFECTS[LAG]))
    law = Fixed(np.array([priors.ORDINARY_LAG_S**2]))
    return Component(LAG, "sensor", library[LAG].columns(context, {}), law, odds, LAG)


def delay_form(context: Context, lag_s: float) -> Component:
    """What a delay by a filter does beyond a delay: of either, in part."""
    law = Fixed(np.array([priors.LAG_IS_FILTER**2]))
    return Component(LAG_FORM, "sensor", beyond_the_lag(context, abs(lag_s)), law)


def key_of(name: str, setting: Setting) -> str:
    """One text for an effect in a setting."""
    kept = {k: v for k, v in setting.items() if k != "searched"}
    return f"{name} {json.dumps(kept, sort_keys=True, default=str)}"


def _sized(effect: Effect) -> Sized:
    scale = np.array([one.scale for one in effect.parameters])
    low, high = np.log(priors.EFFECT_SIZES)
    return Sized(scale, np.array([low]), np.array([high]))


def neighbours(setting: Setting, duration_s: float, round_: int) -> list[Setting]:
    """The setting with its onset a little earlier and later, and its scale less and more."""
    out: list[Setting] = []
    share = _FINE[min(round_, len(_FINE) - 1)]
    if setting.get("onset_s"):
        onset = float(setting["onset_s"])
        steps = (-2, -1, 1, 2)
        moved = [onset + k * share * duration_s / 2 for k in steps]
        out += [{**setting, "onset_s": t} for t in moved if 0.0 < t]
    for name in ("length_s", "time_constant_s", "radius_gauss"):
        if name in setting:
            factor = 1.5 ** (1.0 / (1 + round_))
            out += [{**setting, name: float(setting[name]) * f} for f in (1 / factor, factor)]
    return out
