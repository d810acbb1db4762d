"""What a search at one point may choose from: the library's settings, free processes, forms."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from ahrsd.diagnosis import priors
from ahrsd.diagnosis.effects.effect import Effect, Setting
from ahrsd.diagnosis.inference.components.component import Component
from ahrsd.diagnosis.inference.components.effect_components import (
    LAG,
    LAG_FORM,
    contains_component,
    effect_component,
    form_component,
    interval_components,
    library_components,
    neighbouring_settings,
    project_out,
    projected_key,
)
from ahrsd.diagnosis.inference.likelihood.candidates import CandidateScan
from ahrsd.diagnosis.inference.likelihood.linearisation import Linearised
from ahrsd.diagnosis.inference.likelihood.richest_model import FittedPoint, psi_by_key
from ahrsd.diagnosis.inference.search.model_search import (
    Hypotheses,
    Hypothesis,
    Names,
    Space,
    beam_search,
)
from ahrsd.diagnosis.inference.search.remembered import memory_settings
from ahrsd.diagnosis.inference.search.switching_sources import find_switching_sources
from ahrsd.diagnosis.model import Context

FREE_PROCESSES = ("free sensor", "free world", "free gyro")
#: columns that are computed before they pass the filter as a batch
_BATCH_COLUMNS = 500


def search_at_point(
    fitted: FittedPoint, library: Mapping[str, Effect], effects: Sequence[Component], was_real: bool
) -> tuple[Hypotheses, Space, Hypothesis]:
    """The most probable set at a richest model, searched from known effects and from nothing.

    was_real: whether the set in which the effects were found had the ordinary remainder
    """
    base = fitted.base
    all_sets, space = build_search_space(fitted, library, effects)
    made = all_sets.made
    real = frozenset(base.remainder)
    known = all_sets.without_member(frozenset(one.key for one in effects), LAG)
    lag = frozenset([LAG]) & made.seen.keys()
    starts: list[Names] = [frozenset(), lag, real | lag, real | lag | {FREE_PROCESSES[0]}]
    if known:
        start = known | real if was_real else known
        starts = [start, known, start | {FREE_PROCESSES[0]}, start | set(FREE_PROCESSES[:2])]
    if not (known and was_real):
        _add_switching_sources(all_sets, space, all_sets.judge(()))
    hypotheses = beam_search(all_sets, space, starts)
    if not all_sets.is_real(hypotheses[0].names):
        extended = [
            hypotheses[0].names | {key}
            for key in _add_switching_sources(all_sets, space, hypotheses[0])
        ]
        if extended:
            hypotheses = beam_search(all_sets, space, [hypotheses[0].names, *extended])
    return all_sets, space, hypotheses[0]


def _add_switching_sources(all_sets: Hypotheses, space: Space, hypothesis: Hypothesis) -> list[str]:
    """Keys of the switching sources in a set's residual, which are added to the space."""
    sources = find_switching_sources(all_sets, hypothesis)
    all_sets.made.add(sources)
    space.sources.extend(one.key for one in sources if one.key not in space.sources)
    return [one.key for one in sources]


def _batches(
    parts: Iterable[tuple[str, list[Component]]],
) -> Iterator[list[tuple[str, list[Component]]]]:
    """Effects in batches of some hundred columns, which limits both batches and memory."""
    batch: list[tuple[str, list[Component]]] = []
    for one in parts:
        batch.append(one)
        if sum(each.width for _, components in batch for each in components) >= _BATCH_COLUMNS:
            yield batch
            batch = []
    if batch:
        yield batch


def _filter_library(
    made: Linearised, library: Mapping[str, Effect]
) -> tuple[dict[str, list[str]], list[Component]]:
    """Keys of the library's components by effect, all passed through the filter.

    Also the components that contain the delay; each is there with the delay projected out as well.
    """
    delay = made.seen[LAG].component if LAG in made.seen else None
    containing_delay: list[Component] = []
    effects: dict[str, list[str]] = {}
    for batch in _batches(library_components(made.context, library)):
        components = []
        for identifier, parts in batch:
            containing = [] if delay is None or not contains_component(parts[0], delay) else parts
            projected = [] if delay is None else [project_out(one, delay) for one in containing]
            effects[identifier] = [one.key for one in (*parts, *projected)]
            components += [*parts, *projected]
            containing_delay += containing
        made.add(components)
        made.make_columns_lazy([one for _, parts in batch for one in parts])
    if delay is not None:
        effects[delay.effect or LAG] = [LAG]
    return effects, containing_delay


def build_search_space(
    fitted: FittedPoint, library: Mapping[str, Effect], accepted: Sequence[Component]
) -> tuple[Hypotheses, Space]:
    """The sets at a richest model, none fitted yet, and what they may be made of."""
    base = fitted.base
    made, context = base.made.copy(), base.made.context
    effects, containing_delay = _filter_library(made, library)
    forms = {}
    for one in accepted:
        keys = effects.setdefault(one.effect or one.key, [])
        if one.key not in keys:
            keys.append(one.key)
        form = form_component(one, context, library)
        if form is not None:
            made.add([form])
            forms[one.key] = form.key
    if LAG_FORM in made.seen:
        forms[LAG] = LAG_FORM
    psi = psi_by_key(made, base.whole, fitted.at)
    projected = {one.key: projected_key(one.key) for one in containing_delay}
    all_sets = Hypotheses(made, base.remainder, fitted.at.log_noise, psi, forms, projected)
    all_sets.unknown_nats = 0.0 if made.point.directed is None else made.point.directed.nats
    return all_sets, _space_of(effects, context, library)


def _space_of(
    effects: dict[str, list[str]], context: Context, library: Mapping[str, Effect]
) -> Space:
    """What a search may put into a set; effects: keys of the library's components by effect."""
    length_s = context.track.duration_s

    def refined(one: Component, settings: Iterable[Setting]) -> list[Component]:
        if one.row is None or one.key == LAG:
            return []
        row, tried = one.row, max(priors.SOUGHT_SETTINGS, len(effects[one.row.identifier]))
        return [
            effect_component(context, row, one, tried).with_lazy_columns(context)
            for one in settings
        ]

    def refine_setting(one: Component, round_: int) -> list[Component]:
        return refined(one, neighbouring_settings(one.setting, length_s, round_))

    def refine_memory(scan: CandidateScan, one: Component, round_: int) -> list[Component]:
        return refined(one, memory_settings(scan, one, round_))

    def form_of_component(one: Component) -> Component | None:
        return form_component(one, context, library)

    def steps_at(time_s: float) -> list[Component]:
        setting = {"onset_s": round(time_s, 3)}
        step_effects = [row for row in library.values() if row.jumps]
        return [
            effect_component(context, row, setting, priors.PROPOSED_ONSETS).with_lazy_columns(
                context
            )
            for row in step_effects
        ]

    def components_between(begins: Component, ends: Component) -> list[Component]:
        return interval_components(begins, ends, context, library, priors.SOUGHT_SETTINGS**2)

    return Space(
        effects,
        FREE_PROCESSES,
        refine_setting,
        refine_memory,
        form_of_component,
        steps_at,
        components_between,
    )
