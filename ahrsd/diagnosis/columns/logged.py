"""An answer with columns that were logged badly: with holes, seldom, or with noise.

What a column can still say is asked first; it counts only if an effect is named by it.  Else the
answer is the one that the recording gives without it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.columns.held_columns import drawn_between, held_columns
from ahrsd.diagnosis.columns.logger_noise import cleaned
from ahrsd.diagnosis.columns.shown import shown
from ahrsd.diagnosis.track import Spec, Track

#: an engine: a track and what is known of the sensor
Ask = Callable[[Track, Spec | None], Diagnosis]
#: of the unknown that may be left when a column is at its true time, or without its noise
LEFT = 0.5


def with_columns_as_logged(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """An engine's answer, with what columns with holes, held or noisy ones can still say.

    For an engine that takes columns as they are: it is asked again for each way to read them.
    """

    def straight(each: Track, known: Spec | None) -> Diagnosis:
        return _straight(each, known, ask)

    return with_holes(track, spec, straight)


def with_holes(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """An engine's answer, with columns that have holes where an effect is named by one."""
    holed = roles.holed(track)
    if holed:
        filled = track.with_columns(
            {**track.covariates, **{k: one.values for k, one in holed.items()}}
        )
        missing = np.zeros(len(track), dtype=bool)
        for one in holed.values():
            missing |= one.missing
        found = ask(_blind(filled, missing), spec)
        used = [name for name in holed if name in causes(found)]
        if used:
            notes = tuple(holed[name].words for name in used)
            return replace(found, notes=(*notes, *found.notes))
    return ask(track, spec)


def _straight(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """The diagnosis, with columns that were held between their values drawn straight if better.

    Better is what gains more, all names together, on what was not fitted.
    """
    found = _as_logged(track, spec, ask)
    seldom = held_columns(roles.prepared(track)[0])
    by = set(causes(found))
    if not seldom or not (found.unexplained.detected or by & {one.name for one in seldom}):
        return found
    again = _as_logged(drawn_between(track, seldom), spec, ask)
    used = [one for one in seldom if one.name in causes(again)]
    if used and _gain(again) > _gain(found):
        words = ", ".join(f"{shown(one.name)} ({one.often})" for one in used)
        said = f"logged more seldom than the sensor and drawn straight between its values: {words}"
        return replace(again, notes=(said, *again.notes))
    near = by | {one.channel for one in found.unexplained.follows}
    late = ", ".join(f"{shown(one.name)} ({one.often})" for one in seldom if one.name in near)
    if not late or not found.unexplained.detected:
        return found
    said = f"logged more seldom than the sensor: {late}; what is quicker cannot be told by it"
    return replace(found, notes=(said, *found.notes))


def _gain(found: Diagnosis) -> float:
    return 0.0 if found.validation is None else found.validation.named


def _as_logged(track: Track, spec: Spec | None, ask: Ask) -> Diagnosis:
    """The diagnosis, with the logger's noise taken out of a cause where that leaves less.

    Noise in a cause is told too small, and itself as a source that nobody knows.
    """
    found = ask(track, spec)
    usable = roles.prepared(track)[0]
    by = tuple(name for name in causes(found) if name in usable.covariates)
    clean = cleaned(usable, by) if found.unexplained.detected else None
    if clean is None:
        return found
    again = ask(clean, spec)
    if not (_names(again) == _names(found) and leaves_less(again, found)):
        return found
    own = [name for name in by if clean.covariates[name] is not usable.covariates[name]]
    names = ", ".join(map(shown, own))
    said = f"column {names} has noise of its own: what follows it is judged without it"
    return replace(again, notes=(said, *again.notes))


def _names(found: Diagnosis) -> list[str]:
    return [one.effect for one in found.findings]


def leaves_less(again: Diagnosis, found: Diagnosis) -> bool:
    """Whether less than half of the unknown is left."""
    before, after = found.unexplained, again.unexplained
    return not after.detected or after.evidence_nats < LEFT * before.evidence_nats


def causes(found: Diagnosis) -> tuple[str, ...]:
    """Columns by which effects are named."""
    names = (one.setting.get("covariate") for one in found.findings)
    by_place = any(one.effect in ("field_gradient", "field_anomaly") for one in found.findings)
    position = ("position_north_m", "position_east_m", "position_down_m") if by_place else ()
    return (*(name for name in names if isinstance(name, str)), *position)


def _blind(track: Track, rows: NDArray[np.bool]) -> Track:
    """The track without the magnetometer's readings of these rows."""
    return replace(track, mag_b_gauss=np.where(rows[:, None], np.nan, track.mag_b_gauss))
