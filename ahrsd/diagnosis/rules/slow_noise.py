"""Whether an unknown is no more than noise that is slower than one figure for its colour says.

Noise of the magnetometer that forgets within a second or two looks, over ten minutes, like a field
that comes and goes.  One figure for its colour comes from a smoothed spectrum of what a course
leaves, and the course has taken the slowest noise with it: the figure is too small just where the
course has its own power.  So what is to be told is looked for once more where the noise has its
law (`coloured`), as it is at the frequencies that the course does not reach.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ahrsd.diagnosis.innovation_filter.evidence import CLEAR_PEAK
from ahrsd.diagnosis.limits import Limits
from ahrsd.diagnosis.rules import unknown
from ahrsd.diagnosis.rules.along_field import in_a_field
from ahrsd.diagnosis.rules.coloured import coloured
from ahrsd.diagnosis.rules.regression import Base, based, residual
from ahrsd.diagnosis.rules.spells import with_spells
from ahrsd.diagnosis.rules.unknown import Remainder
from ahrsd.diagnosis.where_and_when import locate


def in_its_noise(basis: Base, left: Remainder, limits: Limits) -> Remainder:
    """The remainder, or, where noise is clearly slow, what is left beside noise of its own law.

    basis: the model's, from which the remainder was taken.  That too is kept where both tell the
    same.  A source of one direction has been held against slow noise already (`one_source`), and a
    name that was taken out again for its form is there.
    """
    white = left.basis.colour <= CLEAR_PEAK
    if white or left.one_source or left.stood_in is not None:
        return left
    again = unknown.tested(lawful(basis, left), with_bins=bool(left.bins))
    again = with_spells(in_a_field(basis, again) if unknown.detected(again, limits) else again)
    agreed = unknown.detected(left, limits) and unknown.detected(again, limits)
    return left if agreed else replace(again, quick=left.quick)


def lawful(basis: Base, left: Remainder) -> Base:
    """The basis with the noise that the strongest course leaves whitened out of it."""
    best = left.strongest
    cut = locate.coarse_cut(basis.context.track)
    course = basis.whitened([locate.frame_columns(basis.context, best.frame, cut)])[0]
    gone = residual(np.concatenate([basis.known, course], axis=2), basis.innovation)
    field = basis.context.field_b @ basis.context.model.soft_iron
    unit = field / np.linalg.norm(field, axis=1, keepdims=True)
    noise = coloured(gone, unit, basis.rate_hz, 1.0 / cut.length_s)
    known, innovation = noise.whitened(basis.known), noise.whitened(basis.innovation)
    return replace(based(basis, basis.groups, known, innovation), rest=noise, colour=1.0)
