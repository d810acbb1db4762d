"""Effects of the library as components, one per setting, and components for their form."""

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
    FixedLaw,
    LazyColumns,
    ScaledLaw,
    columns_in_frame,
)
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.diagnosis.where_and_when.locate import Frame
from ahrsd.samples import Array

#: key of the one delay in the search; which of the library's delays it is, is decided at the end
LAG = "delay"
LAG_FORM = "form of the delay"
_PROJECTED = ", beside the delay"
#: intervals of time round a step in which its transition is free
STEP_PIECES = 20
#: intervals of time in the form of a pulse
PULSE_PIECES = 12
#: share of a component's power outside the span of another's columns that is rounding: no reading
#: can tell the two apart
ROUNDING_SHARE = 1e-12
#: s between the shifts in time at which a logged cause is tried
LATE_STEP_S = priors.LOGGED_LATE_S[-1] - priors.LOGGED_LATE_S[-2]
#: resolution of onsets in successive rounds of refinement, as shares of the recording's duration
_REFINEMENT_SHARES = (1 / 40, 1 / 120, 1 / 400, 1 / 1200, 1 / 3600)

#: degrees by which angles of a setting are turned in the first round of refinement
_TURN_DEG = 20.0


def library_components(
    context: Context, library: Mapping[str, Effect]
) -> Iterator[tuple[str, list[Component]]]:
    """Yield each effect's identifier with a component per setting that can be computed here."""
    for identifier, effect in library.items():
        settings = () if effect.delay or effect.quick else effect.settings(context)
        settings = tuple(
            shifted for one in settings for shifted in logged_time_settings(context, effect, one)
        )
        components = [effect_component(context, effect, one, len(settings)) for one in settings]
        if components:
            yield identifier, components


def logged_time_settings(context: Context, effect: Effect, setting: Setting) -> tuple[Setting, ...]:
    """The setting with its logged cause as recorded, and shifted in time where that matters.

    A current that the logger averages, or stamps when it is written, is some tenths of a second
    off. Compared with the field at its logged time it then explains nothing.
    """
    if setting.get("covariate") not in context.track.covariates:
        return (setting,)
    logged = _centred(effect.columns(context, setting))
    latest = _centred(effect.columns(context, {**setting, "late_s": max(priors.LOGGED_LATE_S)}))
    if float(np.sum((latest - logged) ** 2)) < priors.COLUMNS_ALIKE * float(np.sum(logged**2)):
        return (setting,)
    return (setting, *({**setting, "late_s": late_s} for late_s in priors.LOGGED_LATE_S))


def _centred(columns: Columns | LazyColumns) -> Array:
    """(N, 3 p) columns about their means: a constant belongs to the calibration."""
    side = columns.gyro if columns.mag is None else columns.mag
    if side is None:
        raise ValueError("an effect without columns has no setting")
    flat = side.reshape(len(side), -1)
    return np.asarray(flat - flat.mean(axis=0))


def logged_cause_components(context: Context, library: Mapping[str, Effect]) -> list[Component]:
    """Effects of a logged cause (a current, a temperature, ...), each in its first setting.

    Their keys are the same at every linearisation point.  A setting may depend on the readings (a
    mean temperature); with the setting in the key the component would be another one at the next
    point, and the contribution subtracted from the readings would be lost.
    """
    out = []
    for identifier, effect in library.items():
        roles = [need for need in effect.needs if "accel" not in need]
        applicable = roles and not effect.delay and not effect.quick
        settings = effect.settings(context) if applicable else ()
        if settings:
            first = effect_component(context, effect, settings[0], len(settings))
            out.append(replace(first, key=f"{identifier} as logged"))
    return out


def effect_component(
    context: Context, effect: Effect, setting: Setting, settings_tried: int
) -> Component:
    """An effect in one setting.

    settings_tried: number of settings among which this one is chosen; they share the prior odds
    """
    searched = int(setting.get("searched", 1))
    log_odds = float(np.log(priors.EFFECT) - np.log(max(1, settings_tried) * max(1, searched)))
    log_odds += np.count_nonzero(setting.get("memory", ())) * float(np.log(priors.REMEMBERED))
    return Component(
        component_key(effect.identifier, setting),
        effect.frame or effect.family,
        effect.columns(context, setting),
        _effect_law(effect),
        log_odds,
        effect,
        dict(setting),
    )


def rebuild_component(
    known: Component, context: Context, library: Mapping[str, Effect]
) -> Component:
    """An effect's component with its columns computed from another context."""
    if known.row is None or known.key == LAG:
        return known
    rebuilt = replace(known, columns=known.row.columns(context, known.setting))
    lag = delay_component(context, library) if known.beside else None
    return rebuilt if lag is None else project_out(rebuilt, lag)


def delay_component(context: Context, library: Mapping[str, Effect]) -> Component | None:
    """The delay between the sensors, of either sign; None if the library has no such delay."""
    effect, log_odds = plain_delay(library, 1.0), float(np.log(priors.DELAY))
    if effect is None:
        return None
    law = FixedLaw(np.array([priors.ORDINARY_LAG_S**2]))
    return Component(LAG, "sensor", effect.columns(context, {}), law, log_odds, effect)


def plain_delay(library: Mapping[str, Effect], sign: float) -> Effect | None:
    """The library's delay of a sign, reported if nothing supports another kind of delay."""
    plain = (one for one in library.values() if one.plain and one.delay * sign > 0.0)
    return next(plain, None)


def contains_component(
    one: Component, part: Component, tolerance: float = priors.COLUMNS_ALIKE
) -> bool:
    """True if the columns of `part` lie in the span of the columns of `one`.

    tolerance: share of the power of `part` that may lie outside the span
    """
    if one.width <= part.width or one.columns.on_mag != part.columns.on_mag:
        return False
    if one.columns.on_mag and one.columns.on_gyro:
        return False
    X, y = (_centred(each.columns).reshape(-1, each.width) for each in (one, part))
    residual = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    return float(np.sum(residual**2)) < tolerance * float(np.sum(y**2))


def project_out(one: Component, part: Component) -> Component:
    """A component whose span contains another's column, with that column projected out.

    Both in one model would otherwise share what they have in common.
    """
    mag, part_mag = one.columns.mag, part.columns.mag
    if mag is None or part_mag is None:
        raise ValueError(f"{one.key} and {part.key} are not of the magnetometer")
    X, y = mag, part_mag[:, :, 0]
    coefficients = np.einsum("nia,ni->a", X, y) / np.sum(y**2)
    remaining = Columns(mag=X - y[:, :, None] * coefficients)
    return replace(one, key=projected_key(one.key), columns=remaining, beside=part.key)


def projected_key(key: str) -> str:
    """Key of a component from which the delay has been projected out."""
    return key if key.endswith(_PROJECTED) else f"{key}{_PROJECTED}"


def delay_form(context: Context, lag_s: float) -> Component:
    """The difference between a delay caused by a filter and a pure delay, of either sign.

    Its coefficient is the share of the delay that the filter causes.
    """
    law = FixedLaw(np.array([priors.LAG_IS_FILTER**2]))
    return Component(LAG_FORM, "sensor", low_pass_beyond_delay(context, abs(lag_s)), law)


def component_key(identifier: str, setting: Setting) -> str:
    """Key of an effect in a setting."""
    kept = {k: v for k, v in setting.items() if k != "searched"}
    return f"{identifier} {json.dumps(kept, sort_keys=True, default=str)}"


def _effect_law(effect: Effect) -> ScaledLaw:
    """One size for all coefficients, in units of the effect's usual sizes."""
    scale = np.array([one.scale for one in effect.parameters])
    low, high = np.log(priors.EFFECT_SIZES)
    return ScaledLaw(scale, np.array([low]), np.array([high]))


def neighbouring_settings(setting: Setting, duration_s: float, round_: int) -> list[Setting]:
    """Settings with times earlier and later, scales less and more, angles turned both ways.

    The steps become smaller from round to round.
    """
    out: list[Setting] = []
    share = _REFINEMENT_SHARES[min(round_, len(_REFINEMENT_SHARES) - 1)]
    for name in MOMENTS:
        if setting.get(name):
            steps = (-2, -1, 1, 2)
            shifted = [float(setting[name]) + k * share * duration_s / 2 for k in steps]
            out += [{**setting, name: t} for t in shifted if t > 0.0]
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


def form_component(
    known: Component, context: Context, library: Mapping[str, Effect]
) -> Component | None:
    """A component for the error of an effect's form in time; None where no such form is known.

    A step takes time: within some seconds of its onset the source may have any size.  A pulse that
    comes once a period may grow and fade.  A cause that changes quickly may be logged late or as a
    mean over some time; its form is its change in time.
    """
    law = known.law
    if not isinstance(law, ScaledLaw):
        return None
    if known.jumps:
        return _step_form(known, law, context, cast("Frame", known.frame))
    if "period_s" in known.setting:
        return _pulse_form(known, law, context, cast("Frame", known.frame))
    effect = library.get(known.effect or "")
    if effect is None or len(logged_time_settings(context, effect, known.setting)) == 1:
        return None
    late_s, step_s = float(known.setting.get("late_s", 0.0)), LATE_STEP_S / 2
    around = [
        effect.columns(context, {**known.setting, "late_s": late_s + way * step_s})
        for way in (-1, 0, 1)
    ]
    columns = Columns(
        _time_differences([one.mag for one in around]),
        _time_differences([one.gyro for one in around]),
    )
    scale = np.concatenate([law.scale, law.scale]) * (priors.LOGGED_BLUR_S / LATE_STEP_S)
    return Component(
        f"form of {known.key}", known.frame, columns, ScaledLaw(scale, law.low, law.high)
    )


def _time_differences(around: list[Array | None]) -> Array | None:
    """(N, 3, 2 p) first and second difference of columns earlier than, at and later than a time."""
    before, at, behind = around
    if before is None or at is None or behind is None:
        return None
    return np.concatenate([behind - before, behind - 2.0 * at + before], axis=2)


def _step_form(known: Component, law: ScaledLaw, context: Context, frame: Frame) -> Component:
    """Form of a step: intervals of time round its onset and its end, along each axis."""
    width_s, moments_s = 2 * priors.APPROACH_S / STEP_PIECES, known.moments_s

    def piece_indicators() -> Array:
        pieces = []
        for moment_s in moments_s:
            edges = moment_s - priors.APPROACH_S + width_s * np.arange(STEP_PIECES + 1)
            piece = np.searchsorted(edges, context.track.time_s, side="right") - 1
            pieces.append((piece[:, None] == np.arange(STEP_PIECES)).astype(float))
        return np.hstack(pieces)

    columns = columns_in_frame(context, frame, piece_indicators, STEP_PIECES * len(moments_s))
    piece_law = ScaledLaw(np.full(columns.width, float(law.scale[0])), law.low, law.high)
    moments = {name: known.setting[name] for name in MOMENTS if name in known.setting}
    return Component(f"form of {known.key}", frame, columns, piece_law, setting=moments)


def _pulse_form(known: Component, law: ScaledLaw, context: Context, frame: Frame) -> Component:
    """Form of pulses: intervals from one width before a pulse to one after, along each axis."""
    setting = known.setting
    piece_s = 3.0 * setting["width_s"] / PULSE_PIECES

    def piece_indicators() -> Array:
        first_s = setting["start_s"] + setting["phase_s"] - setting["width_s"]
        piece = ((context.track.time_s - first_s) % setting["period_s"] / piece_s).astype(int)
        return np.asarray(piece[:, None] == np.arange(PULSE_PIECES), dtype=float)

    columns = columns_in_frame(context, frame, piece_indicators, PULSE_PIECES)
    piece_law = ScaledLaw(np.full(columns.width, float(law.scale[0])), law.low, law.high)
    return Component(f"form of {known.key}", frame, columns, piece_law)


def interval_components(
    begins: Component,
    ends: Component,
    context: Context,
    library: Mapping[str, Effect],
    settings_tried: int,
) -> list[Component]:
    """Effects that jump, each from the onset of one step to the end of another.

    A source that is put on and taken off is one vector; two steps would have one vector each.
    """
    first, last = begins.moments_s[0], ends.moments_s[-1]
    effects = [effect for effect in library.values() if effect.jumps]
    components = [
        effect_component(context, effect, {"onset_s": first, "end_s": last}, settings_tried)
        for effect in effects
    ]
    return [one for one in components if one.columns.on_mag == begins.columns.on_mag]
