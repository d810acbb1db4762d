"""A diagnosis in the words of a field engineer.

`answer_lines` is the whole answer, `verdict` one sentence of it.  The residual, its size, its
place and what real recordings ordinarily leave are `ordinary_text` and `component_lines`.
`setting_text` describes the parts of a finding's setting that a user can act on.  The delay of a
logged column, a period and a time constant were chosen among many values and are no coefficients,
so that they have no standard deviation.

`separating_manoeuvre` is what would separate two effects that this motion cannot tell apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import (
    Component,
    Diagnosis,
    Finding,
    Limit,
    OnPriors,
    Ordinary,
    Unexplained,
    Value,
    Where,
)
from ahrsd.diagnosis.columns.roles import label
from ahrsd.diagnosis.effects.effect import Effect

_FRAMES = {
    "sensor": "turns with the vehicle",
    "world": "stays in the world",
    "gyro": "in the gyro",
    "link": "on the link",
    "noise": "in the noise",
}
_MG = 1e3
#: display units of small effects, by the unit of computation
_DISPLAY_UNITS = {
    "gauss": ("mG", 1e3),
    "s": ("ms", 1e3),
    "rad": ("deg", 180 / math.pi),
    "1": ("%", 100.0),
}
_LIMITS_SHOWN = 6
#: the note on a simulation whose residual would be ordinary for a real recording
SIMULATED = (
    "the recording is simulated (its truth file lies next to it), so no residual is ordinary"
)


def answer_lines(found: Diagnosis) -> list[str]:
    """The whole answer, for a terminal."""
    out = [f"{found.recording}: {verdict(found)}"]
    for number, finding in enumerate(found.findings, start=1):
        out += ["", f"{number}. {headline(finding)}", *_finding_lines(finding)]
    if found.unexplained.detected:
        out += ["", "unknown, here (no effect of the library explains it):"]
        out += [*_unexplained_lines(found.unexplained)]
    elif ordinary_residual(found) is not None:
        out += ["", "remaining residual, ordinary:", *_unexplained_lines(found.unexplained)]
    if not found.mismatch and found.undecided is None and found.sensitivity:
        out += ["", f"this recording would have shown: {sensitivity_text(found.sensitivity)}"]
    failed = found.failed_checks
    if found.posterior_predictive:
        count = len(found.posterior_predictive)
        state = f"fails {', '.join(failed)}" if failed else "passes all of them"
        out += ["", f"checks: {count} statistics; {_checked(found)} {state}"]
    if found.omnibus:
        out.append(f"innovations: {_whiteness(found)}")
    return out + [f"note: {note}" for note in found.notes]


def _whiteness(found: Diagnosis) -> str:
    """Which of the omnibus tests the null model failed, and which the repaired one still fails."""
    before = [name for name, test in found.omnibus.items() if test.p_before < priors.TEST_FAILED]
    after = [name for name, test in found.omnibus.items() if test.p_after < priors.TEST_FAILED]
    if not before and not after:
        return "white, Gaussian and of constant variance"
    return (
        f"tests failed without the findings: {', '.join(before) or 'none'}; "
        f"by {_checked(found)}: {', '.join(after) or 'none'}"
    )


def residual_is_drawn(found: Diagnosis) -> bool:
    """Whether what is compared "after" the findings has the remaining residual in it.

    It is drawn as a free time series; the model file, and what is simulated with it, lacks it.
    """
    return found.unexplained.detected or ordinary_residual(found) is not None


def _checked(found: Diagnosis) -> str:
    free = " with the remaining residual as a free time series" if residual_is_drawn(found) else ""
    return f"the repaired model{free}"


def verdict(found: Diagnosis) -> str:
    """One sentence."""
    names = len(found.findings)
    failed, ordinary = found.failed_checks, ordinary_residual(found)
    ordinary_words = "" if ordinary is None else ordinary_text(ordinary)
    if found.undecided is not None:
        return f"no verdict: {found.undecided}"
    if not found.mismatch and ordinary_words:
        return (
            f"nothing beyond the ordinary: the residual is {ordinary_words}; "
            f"p = {found.p_value:.1g} that there is none"
        )
    if not found.mismatch and failed:
        where = ", ".join(failed)
        return f"no cause found, but recording and model differ in: {where} (see the checks)"
    if not found.mismatch:
        return "recording and model agree"
    parts = []
    if names:
        parts.append(f"{names} effect{'s' if names > 1 else ''} left out")
    if found.unexplained.detected:
        parts.append("an unknown cause")
    text = " and ".join(parts) or "recording and simulation differ (see the notes)"
    rest = f"; the remaining residual is {ordinary_words}" if ordinary_words else ""
    return f"MISMATCH: {text} (p = {found.p_value:.1g}){rest}"


def agrees(found: Diagnosis) -> bool:
    """Whether the verdict is good: nothing is left out, and nothing undecided or unlike."""
    unlike = bool(found.failed_checks) and ordinary_residual(found) is None
    return not found.mismatch and found.undecided is None and not unlike


def headline(finding: Finding) -> str:
    """The effect and its probability."""
    return f"{finding.words or finding.effect} ({finding.effect}), {finding.confidence:.1%} sure"


def _finding_lines(finding: Finding) -> list[str]:
    held, cost = finding.heldout, finding.cost_if_left_out
    out = [
        f"   where      {where_text(finding.where)}",
        *(
            f"   {'size' if k == 0 else '':<10} {value_text(v)}"
            for k, v in enumerate(finding.parameters)
        ),
        f"   setting    {read}" if (read := setting_text(finding.setting)) else "",
        f"   equation   {finding.equation}" if finding.equation else "",
    ]
    if cost is not None:
        out.append(
            f"   cost       hard iron off by {cost.hard_iron_shift_gauss * _MG:.2f} mG, heading by "
            f"{cost.heading_error_deg:.2f} deg if it is left out"
        )
    if held is not None:
        out.append(
            f"   held out   {held.nll_gain_per_sample:+.4f} nats/sample on readings not fitted "
            f"(time-shifted copies: at most {held.placebo_gain:+.4f})"
        )
    if finding.priors is not None:
        out.append(f"   evidence   {evidence_text(finding.priors)}")
    if finding.alternatives:
        rest = ", ".join(f"{a.effect} {a.confidence:.1%}" for a in finding.alternatives)
        out.append(f"   or else    {rest}")
    if finding.separate_from:
        out.append(f"   to be sure {finding.separate_from}")
    return [line for line in out if line]


def evidence_text(one: OnPriors) -> str:
    """`95 nats (3 required); at least 94 with each prior halved or doubled`."""
    least = min(nats for each in one.assumed for nats in (each.half_nats, each.double_nats))
    return (
        f"{one.log_odds:.0f} nats ({one.asked:.0f} required); at least {least:.0f} with each prior "
        "halved or doubled"
    )


def where_text(where: Where) -> str:
    """When, on which axes, in which frame, under which condition."""
    spans = ", ".join(f"{a:.1f}-{b:.1f} s" for a, b in where.intervals_s[:5])
    more = f" and {len(where.intervals_s) - 5} more" if len(where.intervals_s) > 5 else ""
    parts = [
        spans + more or "whole recording",
        f"axes {' '.join(where.axes)}" if where.axes else "",
    ]
    parts += [_FRAMES.get(where.frame, where.frame), where.regime or ""]
    if where.band_hz is not None:
        parts.append(f"{where.band_hz[0]:.3g}-{where.band_hz[1]:.3g} Hz")
    return "; ".join(part for part in parts if part)


def direction_text(direction: tuple[float, float, float]) -> str:
    """`x -0.44, y +0.65, z +0.62 (a unit vector of that frame)`."""
    x, y, z = direction
    return f"x {x:+.2f}, y {y:+.2f}, z {z:+.2f} (a unit vector of that frame)"


def value_text(value: Value) -> str:
    """`field_per_ampere_y = 1.30e-03 +- 4e-05 gauss/A`."""
    return f"{value.name} = {value.value:.3g} +- {value.std:.1g} {value.unit}"


def _unexplained_lines(left: Unexplained) -> list[str]:
    out = [] if left.where is None else [f"   where      {where_text(left.where)}"]
    if left.where is not None and left.where.direction is not None:
        out.append(f"   along      {direction_text(left.where.direction)}")
    if left.size is not None:
        out.append(f"   size       {size_text(left.size, left.unit)}")
    if left.ordinary is not None:
        out += [f"   component  {text}" for text in component_lines(left.ordinary)]
        out += [f"   why        {left.ordinary.why}"] if left.ordinary.why else []
    if left.single_source_share is not None and left.single_source_share > 0.8:
        out.append(
            f"   one source of fixed direction explains {left.single_source_share:.0%} of it"
        )
    out += [
        f"   follows    {label(one.channel)} (correlation {one.correlation:+.2f}, "
        f"p = {one.p_value:.1g})"
        for one in left.follows
    ]
    if left.priors is not None:
        out.append(f"   evidence   {evidence_text(left.priors)}")
    if left.heldout is not None:
        out.append(
            f"   held out   {left.heldout.nll_gain_per_sample:+.4f} nats/sample with a free time "
            "series in its place"
        )
    return out


def _limit_value_text(value: float, unit: str) -> str:
    """`1.5 ms` for 0.0015 s, `0.3 mG/A` for 3e-4 gauss/A, `0.69 %` for 0.0069."""
    first, *rest = unit.split("/")
    spoken, factor = _DISPLAY_UNITS.get(first, (first, 1.0))
    return f"{value * factor:.2g} {'/'.join([spoken, *rest])}"


def sensitivity_text(limits: tuple[Limit, ...]) -> str:
    """The smallest effects that would have been seen, one parameter an effect."""
    seen: dict[str, str] = {}
    for limit in limits:
        if limit.smallest is not None and limit.effect not in seen:
            seen[limit.effect] = (
                f"{limit.effect} above {_limit_value_text(limit.smallest, limit.unit)}"
            )
    texts = list(seen.values())
    more = f", and {len(texts) - _LIMITS_SHOWN} more" if len(texts) > _LIMITS_SHOWN else ""
    return ", ".join(texts[:_LIMITS_SHOWN]) + more


def size_text(size: float, unit: str) -> str:
    """`9.1 mG`, `620 mrad/s`: two digits."""
    return f"{float(f'{1e3 * size:.2g}'):g} {'mG' if unit == 'gauss' else 'mrad/s'}"


def limit_text(one: Component) -> str:
    """`up to 72 mG`, or that none is."""
    return f"up to {size_text(one.up_to, one.unit)}" if one.up_to > 0.0 else "none"


def ordinary_residual(found: Diagnosis) -> Ordinary | None:
    """The residual if it is ordinary; None where there is none, or where it is unexplained."""
    left = found.unexplained
    return left.ordinary if left.ordinary is not None and not left.detected else None


def ordinary_text(one: Ordinary) -> str:
    """`ordinary for a real recording: 9.1 mG, 1.3 deg of heading (...)`."""
    gyro = any(part.there and part.unit == "rad/s" for part in one.components)
    more = f" and {size_text(one.gyro_rad_s, 'rad/s')} of the gyro" if gyro else ""
    return (
        f"ordinary for a real recording: {size_text(one.field_gauss, 'gauss')}, "
        f"{one.heading_deg:.2g} deg of heading{more} (95 % of {one.recordings} untouched "
        f"recordings have less than {size_text(one.field_up_to_gauss, 'gauss')}, "
        f"{one.heading_up_to_deg:.2g} deg)"
    )


def component_text(one: Component) -> str:
    """`a field by attitude: 8.5 mG, 1.3 deg of heading, 130 nats (ordinary: up to 72 mG)`."""
    heading = "" if one.heading_deg is None else f", {one.heading_deg:.2g} deg of heading"
    return (
        f"{one.words}: {size_text(one.size, one.unit)}{heading}, {one.evidence_nats:.0f} nats "
        f"(ordinary: {limit_text(one)})"
    )


def component_lines(one: Ordinary) -> list[str]:
    """The components that are there, by evidence; the total where there is no single one."""
    there = [part for part in one.components if part.there]
    if not there:
        return [
            f"{size_text(one.field_gauss, 'gauss')}, {one.heading_deg:.2g} deg of heading, in no "
            "single component"
        ]
    return [component_text(part) for part in sorted(there, key=lambda part: -part.evidence_nats)]


@dataclass(frozen=True, slots=True)
class SettingText:
    """Text for one part of a setting.

    words: with {} for the value, times `times`
    negative: the words where the value is below zero, with {} for its size
    """

    words: str
    times: float = 1.0
    negative: str = ""


#: by key, in the order in which they are reported
REPORTED_SETTINGS: Mapping[str, SettingText] = {
    "covariate": SettingText("by the column {}"),
    "late_s": SettingText("logged {} s late", negative="logged {} s early"),
    "mean_s": SettingText("each value the mean of {} s"),
    "harmonic": SettingText("{} periods per turn of the shaft"),
    "off_hz": SettingText("{} Hz faster than the column", negative="{} Hz slower than the column"),
    "frequency_hz": SettingText("seen at {} Hz"),
    "mains_hz": SettingText("as an alias of mains at {} Hz"),
    "period_s": SettingText("every {} s"),
    "width_s": SettingText("for {} s"),
    "hold_samples": SettingText("each reading held for {} samples"),
    "time_constant_s": SettingText("time constant {} s"),
    "radius_gauss": SettingText("half width of the loop {} mG", times=1e3),
    "shape": SettingText("shape: {}"),
    "length_s": SettingText("lasts {} s"),
    "length_m": SettingText("falls off within {} m"),
    "distance_m": SettingText("size stated as its field {} m away"),
}

#: what is not reported, and why: it is elsewhere in the answer, or nobody can act on it
UNREPORTED_SETTINGS: Mapping[str, str] = {
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
    """`by the column motor_current_a; logged 0.25 s late`; empty if there is nothing to report."""
    parts = []
    for key, entry in REPORTED_SETTINGS.items():
        value = setting.get(key)
        if not value:
            continue
        if isinstance(value, str):
            parts.append(entry.words.format(label(value)))
        elif isinstance(value, (list, tuple)):
            parts.append(entry.words.format(" or ".join(f"{one:.3g}" for one in value)))
        elif value < 0 and entry.negative:
            parts.append(entry.negative.format(f"{-value * entry.times:.3g}"))
        else:
            parts.append(entry.words.format(f"{value * entry.times:.3g}"))
    return "; ".join(parts)


def separating_manoeuvre(
    library: Mapping[str, Effect], identifier: str, others: Sequence[str]
) -> str:
    """The manoeuvre that separates the effect from the first of `others` that has one, in words."""
    for other in others:
        for one, two in ((identifier, other), (other, identifier)):
            if one in library:
                for confuser, words in library[one].confusers:
                    if confuser == two:
                        return words
    return library[identifier].manoeuvre if identifier in library else ""
