"""One case: what was true, what was said, what that is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

from blind_trials.answers import ClaimedEffect, ClaimedParameter, Span, ToolAnswer
from blind_trials.units import normal

Json = dict[str, Any]

RIGHT, IN_SET, MISSED, WRONG, ADDED = "right", "in the set", "missed", "wrong name", "name added"
FALSE, UNKNOWN, PARTLY, NONE, QUIET = "false name", "unknown", "one of two", "no answer", "quiet"
#: order of the report, misses first
ORDER = (NONE, FALSE, WRONG, MISSED, ADDED, PARTLY, UNKNOWN, IN_SET, QUIET, RIGHT)
DELAYED = {
    "mag_time_lag": "mag",
    "mag_low_pass": "mag",
    "gyro_integration": "mag",
    "gyro_time_lag": "gyro",
}
SHORT_PART = 0.95  # an interval that covers more of the recording than this locates nothing


@dataclass(frozen=True, slots=True)
class Verdict:
    """A judged case.  None means: the question does not arise.

    word:     one of ORDER
    error:    whether it counts as a mistake when tools are compared
    multiple: smallest strength, in limits, of what was planted
    strict:   the first name is the key's own, not one for the same signal
    pulls:    (estimate - truth) / standard deviation of each comparable coefficient
    relative: |estimate - truth| / |truth| over all comparable coefficients of the effect
    gain:     held-out gain as a part of what an ideal observer has
    """

    case: str
    truth: Json
    answer: ToolAnswer
    word: str
    error: bool
    multiple: float | None = None
    detected: bool | None = None
    first_right: bool | None = None
    strict: bool | None = None
    in_set: bool | None = None
    called_unknown: bool | None = None
    frame_right: bool | None = None
    overlap: float | None = None
    onset_error_s: float | None = None
    pulls: tuple[float, ...] = field(default=())
    relative: float | None = None
    gain: float | None = None

    @property
    def kind(self) -> str:
        """null, single, pair, withheld, outside, unidentifiable, semireal or control."""
        return str(self.truth["kind"])

    @property
    def confidence(self) -> float | None:
        """Of the first name."""
        findings = self.answer.findings
        return findings[0].confidence if findings else None


def judge(truth: Json, answer: ToolAnswer, control: ToolAnswer | None = None) -> Verdict:
    """The verdict on one case.  control: the answer to the same recording left as it was."""
    case = str(truth["id"])
    effects = truth["effects"]
    if answer.failure is not None and not _refused_rightly(truth, answer):
        return Verdict(case, truth, answer, NONE, error=True, multiple=_least(effects))
    rules = {
        "null": _null,
        "control": _control,
        "single": _single,
        "pair": _pair,
        "withheld": _unknowable,
        "outside": _unknowable,
        "unidentifiable": _unidentifiable,
    }
    if truth["kind"] == "semireal":
        return _semireal(case, truth, answer, control)
    return rules[str(truth["kind"])](case, truth, answer)


def _refused_rightly(truth: Json, answer: ToolAnswer) -> bool:
    """A recording in wrong units may be refused in words that say so."""
    unit = any(effect["effect"] == "unit_error" for effect in truth["effects"])
    return unit and "deg" in answer.printed


def _least(effects: Sequence[Json]) -> float | None:
    return min((float(effect["multiple"]) for effect in effects), default=None)


def _null(case: str, truth: Json, answer: ToolAnswer) -> Verdict:
    false = [name for name in answer.names if name not in truth["allowed"]]
    word = FALSE if false else UNKNOWN if answer.unexplained else QUIET
    return Verdict(case, truth, answer, word, error=bool(false), called_unknown=answer.unexplained)


def _control(case: str, truth: Json, answer: ToolAnswer) -> Verdict:
    return Verdict(case, truth, answer, QUIET, error=False)


def _single(case: str, truth: Json, answer: ToolAnswer) -> Verdict:
    effect = truth["effects"][0]
    right = effect["right"]
    if answer.failure is not None:  # refused, and rightly
        return Verdict(
            case, truth, answer, RIGHT, False, _least([effect]), True, True, True, True, False
        )
    asked = [name for name in answer.names if name in right or name not in truth["allowed"]]
    first = asked[0] if asked else None
    detected = answer.mismatch or bool(answer.findings) or answer.unexplained
    in_set = any(name in right for name in answer.everything)
    others = [n for n in answer.names if n not in right and n not in truth["allowed"]]
    if first in right:
        word = ADDED if others else RIGHT
    elif in_set:
        word = IN_SET
    elif answer.findings:
        word = WRONG
    else:
        word = UNKNOWN if detected else MISSED
    found = next((f for f in answer.findings if f.effect in right), None)
    return Verdict(
        case,
        truth,
        answer,
        word,
        error=word in (MISSED, WRONG, ADDED, UNKNOWN, IN_SET),
        multiple=_least([effect]),
        detected=detected,
        first_right=first in right if detected else None,
        strict=first == effect["effect"] if detected else None,
        in_set=in_set if detected else None,
        called_unknown=answer.unexplained,
        **_measured(truth, effect, found),
    )


def _pair(case: str, truth: Json, answer: ToolAnswer) -> Verdict:
    effects = truth["effects"]
    right = [name for effect in effects for name in effect["right"]]
    hit = [any(name in effect["right"] for name in answer.names) for effect in effects]
    others = [n for n in answer.names if n not in right and n not in truth["allowed"]]
    detected = answer.mismatch or bool(answer.findings) or answer.unexplained
    in_set = all(any(name in e["right"] for name in answer.everything) for e in effects)
    if all(hit):
        word = ADDED if others else RIGHT
    elif in_set:
        word = IN_SET
    elif others:
        word = WRONG
    else:
        word = PARTLY if any(hit) else UNKNOWN if detected else MISSED
    return Verdict(
        case,
        truth,
        answer,
        word,
        error=word != RIGHT,
        multiple=_least(effects),
        detected=detected,
        first_right=(answer.names[0] in right if answer.findings else None),
        in_set=in_set,
        called_unknown=answer.unexplained,
    )


def _unknowable(case: str, truth: Json, answer: ToolAnswer) -> Verdict:
    """The cause is in no column or in no library: unknown, here, is the right answer."""
    effect = truth["effects"][0]
    parents = (*effect["parents"], *(n for n in effect["right"] if truth["kind"] == "withheld"))
    forced = [n for n in answer.names if n not in parents and n not in truth["allowed"]]
    parent = next((f for f in answer.findings if f.effect in parents), None)
    detected = answer.mismatch or bool(answer.findings) or answer.unexplained
    if forced:
        word = FALSE
    elif answer.unexplained or parent is not None:
        word = RIGHT
    else:
        word = UNKNOWN if detected else MISSED
    frame = parent.frame if parent is not None else answer.unexplained_frame
    spans = parent.spans_s if parent is not None else answer.unexplained_spans_s
    said = word == RIGHT
    return Verdict(
        case,
        truth,
        answer,
        word,
        error=word != RIGHT,
        multiple=_least([effect]),
        detected=detected,
        called_unknown=said,
        frame_right=frame in effect["frames"] if said else None,
        overlap=_overlap(truth, effect, spans) if said else None,
    )


def _unidentifiable(case: str, truth: Json, answer: ToolAnswer) -> Verdict:
    effect = truth["effects"][0]
    false = [f.effect for f in answer.findings if f.effect not in effect["right"]]
    word = FALSE if false else RIGHT if answer.findings else QUIET
    return Verdict(case, truth, answer, word, error=bool(false), called_unknown=answer.unexplained)


def _semireal(case: str, truth: Json, answer: ToolAnswer, control: ToolAnswer | None) -> Verdict:
    """Judged by what is said beyond the answer to the untouched recording of the same variant.

    A name that the control has too, first or among its alternatives, is neither right nor false;
    one of the right names is right if it moved by what was injected.  So is one that the key allows
    because the recording has it of its own.
    """
    effect = truth["effects"][0]
    right = effect["right"]
    if answer.failure is not None:  # refused, and rightly
        return Verdict(case, truth, answer, RIGHT, False, _least([effect]), True, True, True, True)
    before = control.findings if control is not None else ()
    said_before = control.everything if control is not None else frozenset()
    own = said_before | frozenset(truth["allowed"])
    rate_hz = float(truth["rate_hz"])
    found = next((_delay(f, rate_hz) for f in answer.findings if f.effect in right), None)
    earlier = next((_delay(f, rate_hz) for f in before if f.effect in right), None)
    was_there = earlier or _own_delay(truth, effect)
    pulls, relative = compare(effect["parameters"], found, was_there, str(effect["effect"]))
    # what no control said is an estimate: then nearer to what was injected than to nothing
    close = 0.25 if earlier is not None else 0.5
    hit = found is not None and (was_there is None or (relative is not None and relative < close))
    others = [n for n in answer.names if n not in right and n not in own]
    if hit:
        word = ADDED if others else RIGHT
    elif any(n in right and n not in said_before for n in answer.everything):
        word = IN_SET
    else:
        word = WRONG if others else UNKNOWN if answer.unexplained else MISSED
    was = control.unexplained_frame if control is not None and control.unexplained else None
    detected = word not in (UNKNOWN, MISSED) or (
        answer.unexplained and (answer.unexplained_frame or "yes") != was
    )
    new = [n for n in answer.names if n not in own or (hit and n in right)]
    return Verdict(
        case,
        truth,
        answer,
        word,
        error=not hit,
        multiple=_least([effect]),
        detected=detected,
        first_right=new[:1] != [] and new[0] in right if detected else None,
        strict=new[:1] == [effect["effect"]] if detected else None,
        in_set=word in (RIGHT, ADDED, IN_SET) if detected else None,
        onset_error_s=_onset_error(effect, found),
        pulls=pulls,
        relative=relative,
    )


def _delay(found: ClaimedEffect, rate_hz: float) -> ClaimedEffect:
    """A rate that stands for its interval's middle or end told as the delay that it is."""
    if found.effect != "gyro_integration":
        return found
    half_s = 0.5 / rate_hz
    told = tuple(
        ClaimedParameter("lag", p.value * half_s, None if p.std is None else p.std * half_s, "s")
        for p in found.parameters
        if p.name == "half_steps"
    )
    return replace(found, parameters=told or found.parameters)


def _own_delay(truth: Json, effect: Json) -> ClaimedEffect | None:
    """The delay that a real recording has of its own, as if the control had said it."""
    delay = truth["noise"].get("own_delay_s")
    if delay is None or effect["effect"] not in DELAYED:
        return None
    told = (ClaimedParameter("lag", float(delay), None, "s"),)
    return ClaimedEffect("mag_time_lag", None, (), None, (), told, None, None)


def _measured(truth: Json, effect: Json, found: ClaimedEffect | None) -> dict[str, Any]:
    """Frame, interval, onset, coefficients and gain of a finding that has the right name."""
    if found is None:
        return {}
    pulls, relative = compare(effect["parameters"], found)
    oracle = truth["oracle_gain_nats_per_sample"]
    return {
        "frame_right": found.frame in effect["frames"],
        "overlap": _overlap(truth, effect, found.spans_s),
        "onset_error_s": _onset_error(effect, found),
        "pulls": pulls,
        "relative": relative,
        "gain": found.gain / oracle if oracle and found.gain is not None else None,
    }


def _true_spans(truth: Json, effect: Json) -> list[Span]:
    return [
        (begin, end)
        for begin, end in effect["intervals_s"]
        if end - begin < SHORT_PART * truth["duration_s"]
    ]


def _overlap(truth: Json, effect: Json, said: Sequence[Span]) -> float | None:
    """Of the true intervals, or of what they leave out where the hard iron makes both the same."""
    true = _true_spans(truth, effect)
    value = overlap(true, said)
    if value is None or not effect["either_half"]:
        return value
    edges = [0.0, *(edge for span in true for edge in span), float(truth["duration_s"])]
    between = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    return max(value, overlap(between, said) or 0.0)


def overlap(true: Sequence[Span], said: Sequence[Span]) -> float | None:
    """Intersection over union of two unions of intervals; None where there is no true one."""
    if not true:
        return None
    edges = sorted({edge for span in (*true, *said) for edge in span})
    both = either = 0.0
    for begin, end in pairwise(edges):
        middle = 0.5 * (begin + end)
        inside = [any(a <= middle < b for a, b in spans) for spans in (true, said)]
        both += (end - begin) * all(inside)
        either += (end - begin) * any(inside)
    return both / either if either > 0 else 0.0


def _onset_error(effect: Json, found: ClaimedEffect | None) -> float | None:
    """|t0 - truth| of a step: its own parameter in seconds, or where its first interval begins."""
    if found is None or effect["onset_s"] is None:
        return None
    named = [p for p in found.parameters if p.unit == "s" and ("onset" in p.name or "t0" in p.name)]
    said = named[0].value if named else found.spans_s[0][0] if found.spans_s else None
    return None if said is None else abs(said - float(effect["onset_s"]))


def compare(
    true: Sequence[Json],
    found: ClaimedEffect | None,
    earlier: ClaimedEffect | None = None,
    planted: str | None = None,
) -> tuple[tuple[float, ...], float | None]:
    """Pulls of the coefficients that can be compared, and the relative error of them together.

    A coefficient is compared with the one of the same unit and name, or of the same unit and axis
    (`_x`, `_y`, `_z`), or with the only one of its unit.  earlier: what was there before; it is
    taken off.  planted: the true name, where a delay of the other sensor is to count as negative.
    """
    if found is None or not true:
        return (), None
    pulls: list[float] = []
    miss = size = 0.0
    sign, sign_before = _sense(planted, found), _sense(planted, earlier)
    for entry in true:
        said = _partner(entry, found.parameters)
        if said is None:
            return (), None
        before = None if earlier is None else _partner(entry, earlier.parameters)
        scale = normal(said.unit)[1] / normal(str(entry["unit"]))[1]
        own = sign_before * before.value if before is not None else 0.0
        value = scale * (sign * said.value - own)
        error = value - float(entry["value"])
        miss, size = miss + error**2, size + float(entry["value"]) ** 2
        if said.std:
            pulls.append(error / (scale * said.std))
    return tuple(pulls), (miss / size) ** 0.5 if size > 0 else None


def _sense(planted: str | None, found: ClaimedEffect | None) -> float:
    """-1 where a delay is told of the other sensor than that which was delayed."""
    if planted not in DELAYED or found is None or found.effect not in DELAYED:
        return 1.0
    return 1.0 if DELAYED[planted] == DELAYED[found.effect] else -1.0


def _partner(entry: Json, said: Sequence[ClaimedParameter]) -> ClaimedParameter | None:
    unit = normal(str(entry["unit"]))[0]
    same = [p for p in said if normal(p.unit)[0] == unit and "onset" not in p.name]
    named = [p for p in same if p.name == entry["name"]]
    axis = str(entry["name"])[-2:]
    if not named and axis in ("_x", "_y", "_z"):
        named = [p for p in same if p.name.endswith(axis)]
    if not named and len(same) == 1:
        named = same
    return named[0] if len(named) == 1 else None
