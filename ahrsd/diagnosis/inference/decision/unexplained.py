"""What no effect explains: its size, frame, direction, times and values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.answer.diagnosis import Unexplained, Where
from ahrsd.diagnosis.inference.components.alternatives import factor_keys
from ahrsd.diagnosis.inference.decision.members import (
    coefficients,
    contribution_of,
    is_ordinary,
    library_members,
    size_of,
)
from ahrsd.diagnosis.inference.likelihood.directed_noise import DirectedNoise
from ahrsd.diagnosis.inference.search.model_search import Hypotheses, Hypothesis, Space
from ahrsd.diagnosis.where_and_when.address import AXES, departure_intervals
from ahrsd.diagnosis.where_and_when.locate import Frame, single_source_direction, unit_columns
from ahrsd.samples import Array

#: times at which a curve is sampled over a recording, and at least in an interval
_TIMES, _LEAST_TIMES = 80, 8
#: least power of an octave that has a source, as a share of the strongest octave's
_LEAST_OCTAVE_SHARE = 0.1


def largest_unexplained(
    all_sets: Hypotheses, space: Space, best: Hypothesis, odds: Mapping[str, float]
) -> tuple[tuple[str, ...], Unexplained]:
    """What is unexplained beyond the ordinary, and the keys of the members that describe it."""
    sources = [key for key in odds if all_sets.component(key).row is None]
    sources = [key for key in sources if not is_ordinary(all_sets, best, key)]
    if sources:
        key = max(sources, key=lambda one: odds[one])
        if key in space.courses:
            return (key,), _describe_free_process(all_sets, best, key, odds[key])
        scaled_effects = [
            effect for effect in library_members(all_sets, best) if key in factor_keys(effect)
        ]
        return (key, *scaled_effects), _describe_members(
            all_sets, best, (key, *scaled_effects), odds[key]
        )
    for key, size in priors.ORDINARY.items():
        if key not in best.names or size_of(all_sets, best, key) < size.up_to():
            continue
        nats = best.score - all_sets.judge(best.names - {key}, best).score
        if nats > priors.ODDS_REAL:
            frame, found = all_sets.component(key).frame, size_of(all_sets, best, key)
            unit = "rad/s" if frame == "gyro" else "gauss"
            where = Where((), AXES, frame, f"a part of the residual ({key})")
            return (key,), Unexplained(True, where, None, found, unit, evidence_nats=nats)
    return (), Unexplained(False)


def changing_source(
    all_sets: Hypotheses, best: Hypothesis, kind: str, odds: Mapping[str, float]
) -> tuple[tuple[str, ...], Unexplained]:
    """A source that goes in steps: its levels between the changes, along its direction."""
    keys = [key for key in sorted(best.names) if all_sets.component(key).effect == kind]
    events = sorted(
        (time_s, sign, key)
        for key in keys
        for time_s, sign in zip(all_sets.component(key).moments_s, (1.0, -1.0), strict=False)
    )
    changes = np.array([sign * coefficients(all_sets, best, key)[0] for _, sign, key in events])
    onsets = [time_s for time_s, _, _ in events]
    time_s = all_sets.made.context.track.time_s
    at = np.linspace(time_s[0], time_s[-1], _TIMES)
    levels = np.vstack([np.zeros(3), np.cumsum(changes, axis=0)])
    values = levels[np.searchsorted(onsets, at, side="right")]
    frame = all_sets.component(keys[0]).frame
    nats = sum(odds.get(key, 0.0) for key in keys)
    return tuple(keys), _describe_values(at, values, frame, nats, ((onsets[0], float(time_s[-1])),))


def directed_noise_source(
    all_sets: Hypotheses,
    best: Hypothesis,
    source: DirectedNoise | None,
    contributions: Sequence[Array],
) -> Unexplained:
    """Noise of a higher level along one direction: the octaves that have most of its power.

    contributions: (N, 3) gauss, of each effect; noise along the direction of one is its residual
    """
    made = all_sets.made
    rate_hz = made.point.problem.rate_hz
    if source is None or any(
        acts_along(source.direction, contribution) for contribution in contributions
    ):
        return Unexplained(False)
    count = int(made.edges[-1])
    edges_hz = made.edges * rate_hz / (2.0 * count)
    power = source.power((edges_hz[1:] + edges_hz[:-1]) / 2, np.exp(best.at.log_noise))
    power = power * np.diff(made.edges) / count
    strong = np.flatnonzero(power > _LEAST_OCTAVE_SHARE * power.max())
    band_hz = (float(edges_hz[strong[0]]), float(edges_hz[strong[-1] + 1]))
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


def acts_along(direction: Array, contribution: Array) -> bool:
    """Whether a contribution (N, 3) has one direction, within `SAME_DIRECTION` of the given one."""
    own_direction, share = single_source_direction(contribution, np.ones(len(contribution)))
    return bool(
        share > priors.ONE_SOURCE and abs(own_direction @ direction) > priors.SAME_DIRECTION
    )


def _describe_free_process(
    all_sets: Hypotheses, best: Hypothesis, key: str, odds: float
) -> Unexplained:
    """A free process in time: its frame, its direction and its values."""
    component, time_s = all_sets.component(key), all_sets.made.context.track.time_s
    modes, mode_deviation = (part.reshape(-1, 3) for part in coefficients(all_sets, best, key))
    edges = np.linspace(time_s[0], time_s[-1], _TIMES + 1)
    at = (edges[1:] + edges[:-1]) / 2
    order = np.arange(1, len(modes) + 1)
    phase_rad = np.pi * (at - time_s[0]) / (time_s[-1] - time_s[0])
    cosines = np.cos(phase_rad[:, None] * order)
    values = cosines @ modes
    deviation = np.sqrt(np.mean(cosines**2 @ mode_deviation**2, axis=1))
    intervals = departure_intervals(edges, values, deviation)
    spans = intervals or [(float(time_s[0]), float(time_s[-1]))]
    return _describe_values(at, values, component.frame, odds, tuple(spans))


def _describe_members(
    all_sets: Hypotheses, best: Hypothesis, keys: Sequence[str], odds: float
) -> Unexplained:
    """What members explain together, whatever their law, as a function of time in their frame."""
    component, context = all_sets.component(keys[0]), all_sets.made.context
    contribution = sum(contribution_of(all_sets, best, key)[0] for key in keys)
    in_frame = np.einsum(
        "nia,ni->na", unit_columns(context, cast("Frame", component.frame)), contribution
    )
    time_s = context.track.time_s
    spans = component.setting.get("spans_s", ())
    within = [np.linspace(a, b, max(_LEAST_TIMES, _TIMES // len(spans))) for a, b in spans]
    at = np.unique(np.concatenate([np.linspace(time_s[0], time_s[-1], _TIMES), *within]))

    def interpolated(times_s: Array) -> Array:
        return np.column_stack([np.interp(times_s, time_s, column) for column in in_frame.T])

    spans = spans or ((float(time_s[0]), float(time_s[-1])),)
    if "edges_s" in component.setting:  # the intervals in which its level is not the usual one
        edges = np.array(component.setting["edges_s"])
        levels = interpolated((edges[1:] + edges[:-1]) / 2)
        deviation = float(np.max(coefficients(all_sets, best, keys[0])[1]))
        spans = tuple(departure_intervals(edges, levels, np.full(len(levels), deviation)))
    return _describe_values(at, interpolated(at), component.frame, odds, spans)


def _describe_values(
    at: Array, values: Array, frame: str, nats: float, spans: tuple[tuple[float, float], ...]
) -> Unexplained:
    """Values (k, 3) at times (k,) as something unexplained."""
    direction, share = single_source_direction(values, np.ones(len(at)))
    along_direction = values @ direction
    spread = values.std(axis=0)
    axes = tuple(axis for axis, size in zip(AXES, spread, strict=True) if size > 0.3 * spread.max())
    x, y, z = (float(part) for part in direction)
    return Unexplained(
        detected=True,
        where=Where(spans, axes, frame, direction=(x, y, z)),
        size=float(np.ptp(along_direction)),
        unit="rad/s" if frame == "gyro" else "gauss",
        single_source_share=share,
        evidence_nats=float(nats),
        course=tuple(zip(at.tolist(), along_direction.tolist(), strict=True)),
    )
