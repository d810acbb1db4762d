"""The library's effects as components: one for each setting, and what a form leaves."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import cast

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.calibration_fit.delay import low_pass_beyond_delay
from ahrsd.diagnosis.effects.effect import ANGLES, SCALES, Effect, Setting
from ahrsd.diagnosis.inference.components.component import (
    MOMENTS,
    Component,
    Fixed,
    MadeAnew,
    Sized,
    in_frame,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.diagnosis.where_and_when.locate import Frame
from ahrsd.samples import Array

#: the delay that stands for all delays: which of them it is, is asked at the end
LAG = "delay"
LAG_FORM = "form of the delay"
_BESIDE = ", beside the delay"
#: parts in which the transition of a step is free
PIECES = 20
#: pieces of a pulse's form
PULSE_PIECES = 12
#: of a component's power beyond another that is rounding: no reading tells the two
TO_THE_DIGIT = 1e-12
#: s between the times at which a logged cause is tried
LATE_STEP_S = priors.LOGGED_LATE_S[-1] - priors.LOGGED_LATE_S[-2]
#: parts of a recording's length, and factors, to which onsets and scales are sought
_FINE = (1 / 40, 1 / 120, 1 / 400, 1 / 1200, 1 / 3600)

#: degrees by which angles of a setting are first turned
_TURN_DEG = 20.0


def library_components(
    context: Context, library: Mapping[str, Effect]
) -> Iterator[tuple[str, list[Component]]]:
    """Every effect's settings that can be computed here, with its identifier, one by one."""
    for name, effect in library.items():
        settings = () if effect.delay or effect.quick else effect.settings(context)
        settings = tuple(late for one in settings for late in in_time(context, effect, one))
        found = [component(context, effect, one, len(settings)) for one in settings]
        if found:
            yield name, found


def in_time(context: Context, effect: Effect, setting: Setting) -> tuple[Setting, ...]:
    """The setting with its logged cause as it came, and earlier and later where that matters.

    A current that is averaged in the logger, or stamped when it is written, is some tenths of a
    second off, and held against the field as it is logged it explains nothing.
    """
    if setting.get("covariate") not in context.track.covariates:
        return (setting,)
    logged = _flat(effect.columns(context, setting))
    most = _flat(effect.columns(context, {**setting, "late_s": max(priors.LOGGED_LATE_S)}))
    if float(np.sum((most - logged) ** 2)) < priors.COLUMNS_ALIKE * float(np.sum(logged**2)):
        return (setting,)
    return (setting, *({**setting, "late_s": late_s} for late_s in priors.LOGGED_LATE_S))


def _flat(columns: Columns | MadeAnew) -> Array:
    """(N, 3 p) columns about their means: a constant is the calibration's."""
    side = columns.gyro if columns.mag is None else columns.mag
    if side is None:
        raise ValueError("an effect without columns has no setting")
    flat = side.reshape(len(side), -1)
    return np.asarray(flat - flat.mean(axis=0))


def causes(context: Context, library: Mapping[str, Effect]) -> list[Component]:
    """Effects by a logged cause (a current, a temperature, ...), each in its first setting.

    Their keys are the same at every point: a setting that follows the readings (a mean temperature)
    would else be another component at the next, and what it took out of them were lost.
    """
    out = []
    for name, effect in library.items():
        logged = [need for need in effect.needs if "accel" not in need]
        asked = logged and not effect.delay and not effect.quick
        settings = effect.settings(context) if asked else ()
        if settings:
            made = component(context, effect, settings[0], len(settings))
            out.append(replace(made, key=f"{name} as logged"))
    return out


def component(context: Context, effect: Effect, setting: Setting, tried: int) -> Component:
    """An effect in one setting.  tried: settings among which it is chosen."""
    searched = int(setting.get("searched", 1))
    odds = float(np.log(priors.EFFECT) - np.log(max(1, tried) * max(1, searched)))
    odds += np.count_nonzero(setting.get("memory", ())) * float(np.log(priors.REMEMBERED))
    return Component(
        key_of(effect.identifier, setting),
        effect.frame or effect.family,
        effect.columns(context, setting),
        _sized(effect),
        odds,
        effect,
        dict(setting),
    )


def anew(known: Component, context: Context, library: Mapping[str, Effect]) -> Component:
    """A named component, its columns made of another context."""
    if known.row is None or known.key == LAG:
        return known
    made = replace(known, columns=known.row.columns(context, known.setting))
    lag = delay(context, library) if known.beside else None
    return made if lag is None else beyond(made, lag)


def delay(context: Context, library: Mapping[str, Effect]) -> Component | None:
    """The delay between the sensors, of either sign; None where the library has no late field."""
    row, odds = plain_delay(library, 1.0), float(np.log(priors.DELAY))
    if row is None:
        return None
    law = Fixed(np.array([priors.ORDINARY_LAG_S**2]))
    return Component(LAG, "sensor", row.columns(context, {}), law, odds, row)


def plain_delay(library: Mapping[str, Effect], sign: float) -> Effect | None:
    """The library's delay of a sign that is told where nothing speaks for another."""
    plain = (one for one in library.values() if one.plain and one.delay * sign > 0.0)
    return next(plain, None)


def holds(one: Component, part: Component, least: float = priors.COLUMNS_ALIKE) -> bool:
    """Whether a component can be all that another is: its columns are among the first's.

    least: of the other's power that may be beyond
    """
    if one.width <= part.width or one.columns.on_mag != part.columns.on_mag:
        return False
    if one.columns.on_mag and one.columns.on_gyro:
        return False
    X, y = (_flat(each.columns).reshape(-1, each.width) for each in (one, part))
    left = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    return float(np.sum(left**2)) < least * float(np.sum(y**2))


def beyond(one: Component, part: Component) -> Component:
    """A component that holds another, without it: both in one set would share what they have."""
    mag, part_mag = one.columns.mag, part.columns.mag
    if mag is None or part_mag is None:
        raise ValueError(f"{one.key} and {part.key} are not of the magnetometer")
    X, y = mag, part_mag[:, :, 0]
    along = np.einsum("nia,ni->a", X, y) / np.sum(y**2)
    rest = Columns(mag=X - y[:, :, None] * along)
    return replace(one, key=beside_key(one.key), columns=rest, beside=part.key)


def beside_key(key: str) -> str:
    """Key of what a component has beyond the delay that it holds."""
    return key if key.endswith(_BESIDE) else f"{key}{_BESIDE}"


def delay_form(context: Context, lag_s: float) -> Component:
    """What a delay by a filter does beyond a delay: of either, in part."""
    law = Fixed(np.array([priors.LAG_IS_FILTER**2]))
    return Component(LAG_FORM, "sensor", low_pass_beyond_delay(context, abs(lag_s)), law)


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
    for name in MOMENTS:
        if setting.get(name):
            steps = (-2, -1, 1, 2)
            moved = [float(setting[name]) + k * share * duration_s / 2 for k in steps]
            out += [{**setting, name: t} for t in moved if t > 0.0]
    if "late_s" in setting:
        late_s, step_s = float(setting["late_s"]), LATE_STEP_S / 2 ** (1 + round_)
        out += [{**setting, "late_s": round(late_s + way * step_s, 4)} for way in (-1, 1)]
    for name in SCALES:
        if name in setting:
            factor = 1.5 ** (1.0 / 2**round_)
            out += [{**setting, name: float(setting[name]) * f} for f in (1 / factor, factor)]
    for name in ANGLES:
        if name in setting:
            turn_deg, step_deg = float(setting[name]), _TURN_DEG / 2**round_
            out += [{**setting, name: turn_deg + way * step_deg} for way in (-1, 1)]
    return out


def form_of(known: Component, context: Context, library: Mapping[str, Effect]) -> Component | None:
    """What an effect leaves of its form; None where nothing is known of that.

    A step takes its time: within some seconds of its onset the source may be at any size.  What
    comes once a period may swell and fade.  A cause that changes quickly is logged late, or as a
    mean of some time: its change in time.
    """
    law = known.law
    if not isinstance(law, Sized):
        return None
    if known.jumps:
        return _way_of(known, law, context, cast("Frame", known.frame))
    if "period_s" in known.setting:
        return _swelling(known, law, context, cast("Frame", known.frame))
    effect = library.get(known.effect or "")
    if effect is None or len(in_time(context, effect, known.setting)) == 1:
        return None
    late_s, step_s = float(known.setting.get("late_s", 0.0)), LATE_STEP_S / 2
    around = [
        effect.columns(context, {**known.setting, "late_s": late_s + way * step_s})
        for way in (-1, 0, 1)
    ]
    columns = Columns(_changes([one.mag for one in around]), _changes([one.gyro for one in around]))
    scale = np.concatenate([law.scale, law.scale]) * (priors.LOGGED_BLUR_S / LATE_STEP_S)
    return Component(f"form of {known.key}", known.frame, columns, Sized(scale, law.low, law.high))


def _changes(around: list[Array | None]) -> Array | None:
    """(N, 3, 2 p) first and second difference of columns before, at and behind a time."""
    before, at, behind = around
    if before is None or at is None or behind is None:
        return None
    return np.concatenate([behind - before, behind - 2.0 * at + before], axis=2)


def _way_of(known: Component, law: Sized, context: Context, frame: Frame) -> Component:
    """Of a step: pieces of time round its onset, and its end, each along each axis of its frame."""
    width_s, moments_s = 2 * priors.APPROACH_S / PIECES, known.moments_s

    def inside() -> Array:
        pieces = []
        for moment_s in moments_s:
            edges = moment_s - priors.APPROACH_S + width_s * np.arange(PIECES + 1)
            piece = np.searchsorted(edges, context.track.time_s, side="right") - 1
            pieces.append((piece[:, None] == np.arange(PIECES)).astype(float))
        return np.hstack(pieces)

    columns = in_frame(context, frame, inside, PIECES * len(moments_s))
    sized = Sized(np.full(columns.width, float(law.scale[0])), law.low, law.high)
    moments = {name: known.setting[name] for name in MOMENTS if name in known.setting}
    return Component(f"form of {known.key}", frame, columns, sized, setting=moments)


def _swelling(known: Component, law: Sized, context: Context, frame: Frame) -> Component:
    """Of pulses: pieces of a period, from a width before to one behind, along each axis."""
    setting = known.setting
    piece_s = 3.0 * setting["width_s"] / PULSE_PIECES

    def inside() -> Array:
        first_s = setting["start_s"] + setting["phase_s"] - setting["width_s"]
        piece = ((context.track.time_s - first_s) % setting["period_s"] / piece_s).astype(int)
        return np.asarray(piece[:, None] == np.arange(PULSE_PIECES), dtype=float)

    columns = in_frame(context, frame, inside, PULSE_PIECES)
    sized = Sized(np.full(columns.width, float(law.scale[0])), law.low, law.high)
    return Component(f"form of {known.key}", frame, columns, sized)


def while_there(
    begins: Component, ends: Component, context: Context, library: Mapping[str, Effect], tried: int
) -> list[Component]:
    """What comes with one step and goes with another, as each vector that jumps.

    What was put on is taken off: one vector where two steps have one each.
    """
    first, last = begins.moments_s[0], ends.moments_s[-1]
    rows = [row for row in library.values() if row.jumps]
    made = [component(context, row, {"onset_s": first, "end_s": last}, tried) for row in rows]
    return [one for one in made if one.columns.on_mag == begins.columns.on_mag]
