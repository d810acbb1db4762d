"""A diagnosis in the words of a field engineer."""

from __future__ import annotations

import math

from ahrsd.diagnosis.answer.diagnosis import (
    Diagnosis,
    Finding,
    Limit,
    OnPriors,
    Unexplained,
    Value,
    Where,
)
from ahrsd.diagnosis.answer.ordinary_text import in_one_sentence, ordinary_left, size_lines
from ahrsd.diagnosis.answer.setting_text import setting_text
from ahrsd.diagnosis.columns.roles import shown

_FRAMES = {
    "sensor": "turns with the vehicle",
    "world": "stays in the world",
    "gyro": "in the gyro",
    "link": "on the link",
    "noise": "in the noise",
}
_MG = 1e3
#: units in which a person thinks of small effects, of those in which they are reckoned
_SPOKEN_UNITS = {
    "gauss": ("mG", 1e3),
    "s": ("ms", 1e3),
    "rad": ("deg", 180 / math.pi),
    "1": ("%", 100.0),
}
_LIMITS_SHOWN = 6
_FAILED = 1e-4


def lines(found: Diagnosis) -> list[str]:
    """The whole answer, for a terminal."""
    out = [f"{found.recording}: {verdict(found)}"]
    for number, finding in enumerate(found.findings, start=1):
        out += ["", f"{number}. {headline(finding)}", *_finding_lines(finding)]
    if found.unexplained.detected:
        out += ["", "not in the library:", *_unexplained_lines(found.unexplained)]
    elif ordinary_left(found) is not None:
        out += ["", "left, and ordinary:", *_unexplained_lines(found.unexplained)]
    if not found.mismatch and found.undecided is None and found.sensitivity:
        out += ["", f"this recording would have shown: {sensitivity(found.sensitivity)}"]
    failed = found.failed_checks
    if found.posterior_predictive:
        count = len(found.posterior_predictive)
        state = f"fails {', '.join(failed)}" if failed else "passes all of them"
        out += ["", f"checks: {count} statistics; the repaired model {state}"]
    if found.omnibus:
        out.append(f"innovations: {_whiteness(found)}")
    return out + [f"note: {note}" for note in found.notes]


def _whiteness(found: Diagnosis) -> str:
    """Which of the omnibus tests the model failed, and which the repaired one still fails."""
    before = [name for name, test in found.omnibus.items() if test.p_before < _FAILED]
    after = [name for name, test in found.omnibus.items() if test.p_after < _FAILED]
    if not before and not after:
        return "white, Gaussian and even"
    left = f"still {', '.join(after)}" if after else "nothing with the repaired model"
    return f"fail {', '.join(before) or 'nothing'} before; {left}"


def verdict(found: Diagnosis) -> str:
    """One sentence."""
    names = len(found.findings)
    failed, ordinary = found.failed_checks, ordinary_left(found)
    said = "" if ordinary is None else in_one_sentence(ordinary)
    if found.undecided is not None:
        return f"nothing can be told: {found.undecided}"
    if not found.mismatch and said:
        return (
            f"nothing beyond the ordinary: what is left is {said}; it is there "
            f"(p = {found.p_value:.1g} that nothing is)"
        )
    if not found.mismatch and failed:
        return f"nothing was found, and yet they differ in: {', '.join(failed)} (see the checks)"
    if not found.mismatch:
        return "recording and model agree"
    parts = []
    if names:
        parts.append(f"{names} effect{'s' if names > 1 else ''} left out")
    if found.unexplained.detected:
        parts.append("something that the library has no name for")
    text = " and ".join(parts) or "recording and simulation differ (see the notes)"
    rest = f"; what else is left is {said}" if said else ""
    return f"MISMATCH: {text} (p = {found.p_value:.1g}){rest}"


def headline(finding: Finding) -> str:
    """What it is and how sure that is."""
    return f"{finding.words or finding.effect} ({finding.effect}), {finding.confidence:.1%} sure"


def _finding_lines(finding: Finding) -> list[str]:
    held, cost = finding.heldout, finding.cost_if_left_out
    out = [
        f"   where      {place(finding.where)}",
        *(
            f"   {'size' if k == 0 else '':<10} {value_text(v)}"
            for k, v in enumerate(finding.parameters)
        ),
        f"   read as    {read}" if (read := setting_text(finding.setting)) else "",
        f"   left out   {finding.equation}" if finding.equation else "",
    ]
    if cost is not None:
        out.append(
            f"   without it hard iron off by {cost.hard_iron_shift_gauss * _MG:.2f} mG, heading by "
            f"{cost.heading_error_deg:.2f} deg"
        )
    if held is not None:
        out.append(
            f"   held out   {held.nll_gain_per_sample:+.4f} nats/sample (moved in time: at most "
            f"{held.placebo_gain:+.4f})"
        )
    if finding.priors is not None:
        out.append(f"   assumed    {assumed(finding.priors)}")
    if finding.alternatives:
        rest = ", ".join(f"{a.effect} {a.confidence:.1%}" for a in finding.alternatives)
        out.append(f"   or else    {rest}")
    if finding.separate_from:
        out.append(f"   to be sure {finding.separate_from}")
    return [line for line in out if line]


def assumed(one: OnPriors) -> str:
    """`95 nats of odds (3 are asked), 94 at least with half or twice of what was assumed`."""
    least = min(nats for each in one.assumed for nats in (each.half_nats, each.double_nats))
    return (
        f"{one.log_odds:.0f} nats of odds ({one.asked:.0f} are asked), {least:.0f} at least with "
        "half or twice of what was assumed"
    )


def place(where: Where) -> str:
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


def value_text(value: Value) -> str:
    """`field_per_ampere_y = 1.30e-03 +- 4e-05 gauss/A`."""
    return f"{value.name} = {value.value:.3g} +- {value.std:.1g} {value.unit}"


def _unexplained_lines(left: Unexplained) -> list[str]:
    out = [] if left.where is None else [f"   where      {place(left.where)}"]
    if left.size is not None:
        out.append(f"   size       {left.size:.3g} {left.unit}")
    if left.ordinary is not None:
        out += [f"   part       {text}" for text in size_lines(left.ordinary)]
        out += [f"   yardstick  {left.ordinary.why}"] if left.ordinary.why else []
    if left.single_source_share is not None and left.single_source_share > 0.8:
        out.append(
            f"   one source of fixed direction explains {left.single_source_share:.0%} of it"
        )
    out += [
        f"   moves with {shown(one.channel)} (correlation {one.correlation:+.2f}, "
        f"p = {one.p_value:.1g})"
        for one in left.follows
    ]
    if left.priors is not None:
        out.append(f"   assumed    {assumed(left.priors)}")
    if left.heldout is not None:
        out.append(
            f"   held out   {left.heldout.nll_gain_per_sample:+.4f} nats/sample if drawn freely"
        )
    return out


def _small(value: float, unit: str) -> str:
    """`1.5 ms` for 0.0015 s, `0.3 mG/A` for 3e-4 gauss/A, `0.69 %` for 0.0069."""
    first, *rest = unit.split("/")
    spoken, factor = _SPOKEN_UNITS.get(first, (first, 1.0))
    return f"{value * factor:.2g} {'/'.join([spoken, *rest])}"


def sensitivity(limits: tuple[Limit, ...]) -> str:
    """The smallest effects that would have been seen, one parameter an effect."""
    seen: dict[str, str] = {}
    for limit in limits:
        if limit.smallest is not None and limit.effect not in seen:
            seen[limit.effect] = f"{limit.effect} above {_small(limit.smallest, limit.unit)}"
    texts = list(seen.values())
    more = f", and {len(texts) - _LIMITS_SHOWN} more" if len(texts) > _LIMITS_SHOWN else ""
    return ", ".join(texts[:_LIMITS_SHOWN]) + more
