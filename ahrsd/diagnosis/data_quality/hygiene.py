"""Before any physics: what is wrong with the recording itself.

Counting and comparing only, no calibration: repeated and doubled readings, limits, coarse steps,
the clock, units, and whether gyro and magnetometer mean the same axes.  `put_right` gives the
track as it would be without what was found.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.answer.diagnosis import Value, Where
from ahrsd.diagnosis.calibration_fit.noise_fit import noise_of_differences
from ahrsd.diagnosis.data_quality.clipping import clipping, quantisation
from ahrsd.diagnosis.data_quality.dead import stuck_axes, stuck_gyro
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.data_quality.frames import Frame, ranked, window_rows, windows
from ahrsd.diagnosis.data_quality.handedness import (
    Askew,
    advice,
    askew,
    odd_magnetometer,
    turns_gravity,
)
from ahrsd.diagnosis.data_quality.repeats import repeats
from ahrsd.diagnosis.data_quality.stamps import regular, stamps
from ahrsd.diagnosis.track import Track

_EXPLAINED = 0.6  # cost of the best frame, of that of no motion, at most
_BETTER = 1.5  # times the cost that the frame as recorded must be worse
_BENT = 3.0  # times, by which iron that deforms may favour another frame: it is left out here
_NATS = 20.0  # log likelihood by which it must be worse
_FAST_RAD_S, _NEAR = 3.0, 1.1  # rates that no vehicle has for long; a factor that is another's
_SURE = 0.99  # of a finding that was counted and compared
_SAME_UNIT = 1.2  # factor from a unit's own within which the gyro's scale is that unit
_NOISE_SHARE = 0.05  # of the rates' variance, for a factor that is no unit's to be believed
_PARTS, _CLEARLY = 4, 0.1  # of a recording; cost below which a part of it is explained
_UNIT = 2.0  # factor of the gyro's scale beyond which it is another unit
#: median readings in gauss of the Earth's field (0.2 to 0.7 G) taken in other units
MAG_UNITS = (
    ("uT", 1e-2, 20.0, 70.0),
    ("mG", 1e-3, 200.0, 700.0),
    ("nT", 1e-5, 2e4, 7e4),
    ("T", 1e4, 2e-5, 7e-5),
)
GYRO_UNITS = (("deg/s", np.pi / 180), ("mrad/s", 1e-3), ("rpm", 2 * np.pi / 60))


def hygiene(track: Track) -> tuple[Fact, ...]:
    """Everything that is found, what stops first."""
    wrong = as_recorded(track)
    limits = clipping(track)
    clipped = next((fact.bad for fact in limits if fact.bad is not None), None)
    again = repeats(track, clipped) + stuck_gyro(track)
    known = [fact.bad for fact in again + limits if fact.bad is not None]
    again += stuck_axes(track, np.any([np.zeros(len(track), bool), *known], axis=0))
    rest = again + limits + quantisation(track) + stamps(track)
    return tuple(sorted(wrong + rest, key=lambda fact: not fact.stops))


def as_recorded(track: Track) -> list[Fact]:
    """Units, axes and signs that are wrong: nothing fitted before they are right means anything."""
    return mag_unit(track) + _gyro(track)


def mag_unit(track: Track) -> list[Fact]:
    """The magnetometer in another unit, told by the Earth's field only."""
    size = track.usual_gauss
    for name, factor, low, high in MAG_UNITS:
        if low <= size <= high:
            words = f"the magnetometer reads {size:.3g}: that is {name}, not gauss"
            return [
                _unit_error(track, words, 1 / factor, {"sensor": "mag", "unit": name}, "sensor")
            ]
    return []


def _gyro(track: Track) -> list[Fact]:
    """Axes, signs and unit of the gyro against the magnetometer."""
    found = windows(track)
    if found is None:
        return []
    turned = askew(track, _worse)
    if turned is not None:
        return [_turned(track, turned)]
    order = ranked(found)
    same = next((one for one in order if one.is_identity), None)
    if not order:
        return []
    best = order[0]
    if best.cost > _EXPLAINED:
        return _gyro_unit(track, best) if _in_degrees(track, best, found.count) else []
    if same is not None and (
        same.cost < _BENT * best.cost or not _worse(same.cost, best.cost, found.count)
    ):
        best = same
    facts = []
    if not best.is_identity:
        equal = [one for one in order if not _worse(one.cost, best.cost, found.count)]
        facts.append(_frame_error(track, min(equal, key=_changes), len(equal)))
    if not 1 / _UNIT < best.scale < _UNIT:
        facts += _gyro_unit(track, best)
    return facts


def _in_degrees(track: Track, best: Frame, count: int) -> bool:
    """Whether rates that explain the field only in part are in degrees beyond doubt.

    In a room, or beside a motor, no frame explains most; but no vehicle turns at 3 rad/s a tenth
    of the time while its field turns at a fifty-seventh of that.
    """
    clear = best.is_identity and -1.5 * count * np.log(max(best.cost, 1e-12)) > _NATS
    size = np.linalg.norm(track.gyro_b_rad_s, axis=1)
    fast = float(np.nanpercentile(size, 90)) > _FAST_RAD_S
    return bool(clear and fast and abs(np.log(best.scale * 180 / np.pi)) < np.log(_NEAR))


def _worse(cost: float, best: float, count: int) -> bool:
    """Whether a frame explains so much less that it is out."""
    ratio = max(cost, 1e-12) / max(best, 1e-12)
    return ratio > _BETTER and 1.5 * count * np.log(ratio) > _NATS


def _frame_error(track: Track, best: Frame, equal: int) -> Fact:
    """equal: how many frames explain the recording as well, this one among them."""
    odd = odd_magnetometer(track, best.matrix)
    words = _frame_words(track, best) if odd is None else odd.words
    if equal > 1:
        words += (
            f"; this or one of {equal - 1} other ways of axes and signs, which the motion does not "
            "tell apart: turn it about all axes to know"
        )
    return Fact(
        "frame_error",
        words,
        Where(_whole(track), ("x", "y", "z"), "gyro" if odd is None else "sensor"),
        1.0 if equal == 1 else _SURE,  # that it is one of them
        (Value("present", 1.0, 0.0, "1"),),
        # the true rate is signs * reading[axes]
        {"axes": list(best.axes), "signs": list(best.signs)},
        stops=True,
    )


def _turned(track: Track, turned: Askew) -> Fact:
    names = (f"angle_{axis}" for axis in "xyz")
    return Fact(
        "mag_gyro_misalignment",
        turned.words,
        Where(_whole(track), ("x", "y", "z"), "sensor" if turned.of_magnetometer else "gyro"),
        _SURE,
        tuple(
            Value(name, float(value), 0.0, "rad")
            for name, value in zip(names, turned.rotation_rad, strict=True)
        ),
        stops=True,
    )


def _changes(frame: Frame) -> int:
    """How many axes and signs are not as recorded."""
    moved = sum(axis != place for place, axis in enumerate(frame.axes))
    return moved + sum(sign < 0 for sign in frame.signs)


def _frame_words(track: Track, best: Frame) -> str:
    """What is said of the gyro's axes; with both ways where nothing tells which sensor is odd."""
    P = best.matrix
    words = f"the gyro's x y z are the magnetometer's {' '.join(_inverse_words(best))}"
    if np.linalg.det(P) < 0:
        return f"{words} (left-handed)"
    if turns_gravity(track, P):
        return f"{words} and the accelerometer's"
    return (
        f"{words}, or the magnetometer is left-handed ({advice(-P.T)}): turn none of them before "
        "you know which, the wrong one turns every heading by 180 deg"
    )


def _inverse_words(frame: Frame) -> list[str]:
    """What the reading's axes are in the magnetometer's frame."""
    out = [""] * 3
    for true_axis, (axis, sign) in enumerate(zip(frame.axes, frame.signs, strict=True)):
        out[axis] = f"{'-' if sign < 0 else ''}{'xyz'[true_axis]}"
    return out


def _gyro_unit(track: Track, best: Frame) -> list[Fact]:
    """The unit whose factor is nearest; where none is near, that it is another one."""
    tried = [(name, f) for name, factor in GYRO_UNITS for f in (factor, 1 / factor)]
    name, factor = min(tried, key=lambda pair: abs(np.log(best.scale / pair[1])))
    large = best.scale < 1
    off = f"{1 / best.scale:.3g} times too large" if large else f"{best.scale:.3g} times too small"
    if abs(np.log(best.scale / factor)) > np.log(_SAME_UNIT):
        if _hidden(track) or _right_in_part(track):
            return []
        usual = 1 / factor if large else factor
        words = (
            f"the gyro's rates are {off} for the turns of the field: they are in another unit, or "
            f"the time is ({name} would be {usual:.3g} times)"
        )
        factor, name = best.scale, "another unit"
    else:
        way = f"in {name}" if large else f"divided by {factor:.4g} once too often"
        words = f"the gyro's rates are {off}: they are {way}"
    setting = {"sensor": "gyro", "unit": name}
    return [_unit_error(track, words, 1 / factor, setting, "gyro")]


def _hidden(track: Track) -> bool:
    """Whether a fair part of the rates is noise, even as means over the frames' windows.

    The scale of rates that are mostly noise is too small, whatever their unit is.
    """
    rows = window_rows(track)
    whole = len(track) // rows * rows
    if not whole:
        return True
    means = np.nan_to_num(track.gyro_b_rad_s[:whole]).reshape(-1, rows, 3).mean(axis=1)
    noise = 3 * noise_of_differences(track)[1] ** 2 / rows
    return bool(noise > _NOISE_SHARE * np.sum(np.var(means, axis=0)))


def _right_in_part(track: Track) -> bool:
    """Whether the rates have the field's turns at their own unit in some part of the recording.

    A unit holds all along.  While a magnet is put on, the field's changes are none of a turn.
    """
    edges = np.linspace(0, len(track), _PARTS + 1).astype(int)
    found = [windows(track, slice(int(a), int(b))) for a, b in itertools.pairwise(edges)]
    order = [frame for one in found if one is not None for frame in ranked(one)]
    return any(
        one.is_identity and one.cost < _CLEARLY and 1 / _UNIT < one.scale < _UNIT for one in order
    )


def _unit_error(
    track: Track, words: str, too_large: float, setting: dict[str, str], frame: str
) -> Fact:
    parameters = (Value("factor_less_one", too_large - 1, 0.0, "1"),)
    where = Where(_whole(track), ("x", "y", "z"), frame)
    return Fact("unit_error", words, where, _SURE, parameters, dict(setting), stops=True)


def put_right(track: Track, facts: Sequence[Fact]) -> Track:
    """The track without what the facts say: frames and units undone, false readings nan.

    Jittering stamps are put on their regular clock, the turn of lost samples is put back, and
    where the turn is not known a run ends.  Rows stay as they are in number and order.
    """
    mag, gyro = track.mag_b_gauss.copy(), track.gyro_b_rad_s.copy()
    time_s, dt_s, unseen = track.time_s, track.dt_s, track.lost_turns
    for fact in facts:
        if fact.effect == "frame_error":
            gyro = gyro[:, fact.setting["axes"]] * np.array(fact.setting["signs"])
        elif fact.effect == "unit_error":
            factor = 1.0 / (1.0 + fact.parameters[0].value)
            if fact.setting["sensor"] == "gyro":
                gyro = gyro * factor
            else:
                mag = mag * factor
        elif fact.effect == "timestamp_jitter" and not fact.stops:
            time_s = regular(track)
            dt_s = np.where(np.isnan(dt_s), np.nan, np.diff(time_s, prepend=np.nan))
        if fact.turned is not None:
            known = np.isfinite(fact.turned)
            gyro[known] *= fact.turned[known, None]
            dt_s = np.where(known, dt_s, np.nan)
            unseen = fact.unseen if fact.unseen is not None else unseen
        if fact.bad is not None:
            mag[fact.bad] = np.nan
    runs = track.runs if dt_s is track.dt_s else tuple(time_series.runs(dt_s))
    return replace(
        track,
        time_s=time_s,
        dt_s=dt_s,
        mag_b_gauss=mag,
        gyro_b_rad_s=gyro,
        runs=runs,
        lost_turns=unseen,
    )


def would_have_shown(track: Track) -> tuple[str, ...]:
    """What the checks would have shown here, one line each."""
    mag, gyro = noise_of_differences(track)
    step = track.step_s
    found = windows(track)
    shown = [
        f"a magnetometer stuck while the field turns by {1e3 * 8 * mag:.2g} mG",
        f"readings in steps above {1e3 * 2 * mag:.2g} mG (noise {1e3 * mag:.2g} mG, "
        f"{1e3 * gyro:.2g} mrad/s)",
        f"time stamps that jitter by {1e3 * 0.03 * step:.2g} ms",
        "1 sample in 1000 missing",
    ]
    axes = "swapped, negated or left-handed axes, wrong units of the gyro"
    turned = found is not None and ranked(found) and ranked(found)[0].cost < _EXPLAINED
    if turned:
        shown.append(axes)
    said = f"would also have been seen: {'; '.join(shown)}"
    return (said,) if turned else (said, f"would not have been seen, it hardly turned: {axes}")


def _whole(track: Track) -> tuple[tuple[float, float], ...]:
    return ((float(track.time_s[0]), float(track.time_s[-1])),)
