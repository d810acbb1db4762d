"""What no name explains: its size, frame, direction, moments and course."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Unexplained, Where
from ahrsd.diagnosis.inference.components.alternatives import form_keys
from ahrsd.diagnosis.inference.decision.members import (
    added_by,
    coefficients,
    is_ordinary,
    library_members,
    size_of,
)
from ahrsd.diagnosis.inference.likelihood.directed_noise import Directed
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis, Space
from ahrsd.diagnosis.where_and_when.address import AXES, departure_intervals
from ahrsd.diagnosis.where_and_when.locate import Frame, single_source_direction, unit_columns
from ahrsd.samples import Array

#: moments at which a course is drawn over a recording, and at least in a spell
_PIECES, _IN_SPELL = 80, 8
#: power of an octave that has a source, of the loudest's
_OF_LOUDEST = 0.1


def left_beyond_ordinary(
    all_sets: Hypotheses, space: Space, best: Hypothesis, odds: Mapping[str, float]
) -> tuple[tuple[str, ...], Unexplained]:
    """What no name explains, where that is beyond the ordinary, and the members that it is."""
    courses = [key for key in odds if all_sets.component(key).row is None]
    courses = [key for key in courses if not is_ordinary(all_sets, best, key)]
    if courses:
        key = max(courses, key=lambda one: odds[one])
        if key in space.courses:
            return (key,), _course(all_sets, best, key, odds[key])
        stands_in = [name for name in library_members(all_sets, best) if key in form_keys(name)]
        return (key, *stands_in), _other(all_sets, best, (key, *stands_in), odds[key])
    for key, size in priors.ORDINARY.items():
        if key not in best.names or size_of(all_sets, best, key) < size.up_to():
            continue
        nats = best.score - all_sets.judge(best.names - {key}, best).score
        if nats > priors.ODDS_REAL:
            frame, found = all_sets.component(key).frame, size_of(all_sets, best, key)
            unit = "rad/s" if frame == "gyro" else "gauss"
            where = Where((), AXES, frame, f"a part of what is left ({key})")
            return (key,), Unexplained(True, where, None, found, unit, evidence_nats=nats)
    return (), Unexplained(False)


def changing_source(
    all_sets: Hypotheses, best: Hypothesis, kind: str, odds: Mapping[str, float]
) -> tuple[tuple[str, ...], Unexplained]:
    """A source that goes in steps: its levels between the changes, along its direction."""
    keys = [key for key in sorted(best.names) if all_sets.component(key).effect == kind]
    moments = sorted(
        (time_s, way, key)
        for key in keys
        for time_s, way in zip(all_sets.component(key).moments_s, (1.0, -1.0), strict=False)
    )
    changes = np.array([way * coefficients(all_sets, best, key)[0] for _, way, key in moments])
    onsets = [time_s for time_s, _, _ in moments]
    time_s = all_sets.made.context.track.time_s
    at = np.linspace(time_s[0], time_s[-1], _PIECES)
    levels = np.vstack([np.zeros(3), np.cumsum(changes, axis=0)])
    course = levels[np.searchsorted(onsets, at, side="right")]
    frame = all_sets.component(keys[0]).frame
    nats = sum(odds.get(key, 0.0) for key in keys)
    return tuple(keys), _described(at, course, frame, nats, ((onsets[0], float(time_s[-1])),))


def along_its_direction(
    all_sets: Hypotheses, best: Hypothesis, source: Directed | None, named: Sequence[Array]
) -> Unexplained:
    """A source along whose direction the noise is louder: the octaves that have most of it.

    named: (N, 3) gauss that names add, each; what is along the direction of one is its own rest
    """
    made = all_sets.made
    rate_hz = made.point.problem.rate_hz
    if source is None or any(is_along(source.direction, added) for added in named):
        return Unexplained(False)
    count = int(made.edges[-1])
    edges_hz = made.edges * rate_hz / (2.0 * count)
    power = source.power((edges_hz[1:] + edges_hz[:-1]) / 2, np.exp(best.at.log_noise))
    power = power * np.diff(made.edges) / count
    loud = np.flatnonzero(power > _OF_LOUDEST * power.max())
    band_hz = (float(edges_hz[loud[0]]), float(edges_hz[loud[-1] + 1]))
    x, y, z = (float(part) for part in source.direction)
    axes = tuple(axis for axis, part in zip(AXES, (x, y, z), strict=True) if abs(part) > 0.3)
    time_s = made.context.track.time_s
    return Unexplained(
        detected=True,
        where=Where(
            ((float(time_s[0]), float(time_s[-1])),), axes, "sensor", None, band_hz, (x, y, z)
        ),
        size=float(np.sqrt(2.0 * power.sum())) * made.context.model.sigma_mag_gauss,
        unit="gauss",
        evidence_nats=source.nats,
    )


def is_along(direction: Array, added: Array) -> bool:
    """Whether what a name adds has one direction, and nearly this one."""
    own, share = single_source_direction(added, np.ones(len(added)))
    return bool(share > priors.ONE_SOURCE and abs(own @ direction) > priors.SAME_DIRECTION)


def _course(all_sets: Hypotheses, best: Hypothesis, key: str, odds: float) -> Unexplained:
    """A free course in time: its frame, its direction and its values."""
    one, time_s = all_sets.component(key), all_sets.made.context.track.time_s
    modes, unsure = (part.reshape(-1, 3) for part in coefficients(all_sets, best, key))
    edges = np.linspace(time_s[0], time_s[-1], _PIECES + 1)
    at = (edges[1:] + edges[:-1]) / 2
    order = np.arange(1, len(modes) + 1)
    phase = np.pi * (at - time_s[0]) / (time_s[-1] - time_s[0])
    waves = np.cos(phase[:, None] * order)
    course = waves @ modes
    deviation = np.sqrt(np.mean(waves**2 @ unsure**2, axis=1))
    away = departure_intervals(edges, course, deviation)
    spans = away or [(float(time_s[0]), float(time_s[-1]))]
    return _described(at, course, one.frame, odds, tuple(spans))


def _other(all_sets: Hypotheses, best: Hypothesis, keys: Sequence[str], odds: float) -> Unexplained:
    """What is left that members explain together, whatever their law: its course in their frame."""
    one, context = all_sets.component(keys[0]), all_sets.made.context
    added = sum(added_by(all_sets, best, key)[0] for key in keys)
    turned = np.einsum("nia,ni->na", unit_columns(context, cast("Frame", one.frame)), added)
    time_s = context.track.time_s
    spans = one.setting.get("spans_s", ())
    within = [np.linspace(a, b, max(_IN_SPELL, _PIECES // len(spans))) for a, b in spans]
    at = np.unique(np.concatenate([np.linspace(time_s[0], time_s[-1], _PIECES), *within]))

    def drawn(times_s: Array) -> Array:
        return np.column_stack([np.interp(times_s, time_s, column) for column in turned.T])

    spans = spans or ((float(time_s[0]), float(time_s[-1])),)
    if "edges_s" in one.setting:  # where its levels are not the usual one
        edges = np.array(one.setting["edges_s"])
        levels = drawn((edges[1:] + edges[:-1]) / 2)
        unsure = float(np.max(coefficients(all_sets, best, keys[0])[1]))
        spans = tuple(departure_intervals(edges, levels, np.full(len(levels), unsure)))
    return _described(at, drawn(at), one.frame, odds, spans)


def _described(
    at: Array, course: Array, frame: str, nats: float, spans: tuple[tuple[float, float], ...]
) -> Unexplained:
    """A course (k, 3) at times (k,) as what no name explains."""
    direction, share = single_source_direction(course, np.ones(len(at)))
    source = course @ direction
    spread = course.std(axis=0)
    axes = tuple(axis for axis, size in zip(AXES, spread, strict=True) if size > 0.3 * spread.max())
    x, y, z = (float(part) for part in direction)
    return Unexplained(
        detected=True,
        where=Where(spans, axes, frame, direction=(x, y, z)),
        size=float(np.ptp(source)),
        unit="rad/s" if frame == "gyro" else "gauss",
        single_source_share=share,
        evidence_nats=float(nats),
        course=tuple(zip(at.tolist(), source.tolist(), strict=True)),
    )
