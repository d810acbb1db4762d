"""A recording without what named effects added to it, so that they do not bend its calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import NullModel, Term
from ahrsd.diagnosis.repaired_model.forward import context_along, contribution
from ahrsd.diagnosis.track import Track


def without(
    track: Track,
    model: NullModel,
    terms: Sequence[Term],
    library: Mapping[str, Effect] = EFFECTS,
) -> tuple[Track, tuple[str, ...]]:
    """The track as it would read without the terms, and the effects that no number takes out.

    What an effect adds follows from the model it was fitted with: motion, field and the columns of
    this track. Noise, coarse steps and lost samples cannot be undone; those come back by name.
    Raises ValueError where a term needs a column that the track has not.
    """
    undone = [term for term in terms if library[term.identifier].kind == "mean"]
    left = tuple(term.identifier for term in terms if library[term.identifier].kind != "mean")
    if not undone:
        return track, left
    context = context_along(track, model, undone, library)
    mag, gyro = contribution(context, undone, library)
    return (
        replace(track, mag_b_gauss=track.mag_b_gauss - mag, gyro_b_rad_s=track.gyro_b_rad_s - gyro),
        left,
    )
