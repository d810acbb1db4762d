"""Sweeps: the same trajectory and the same draws of noise, one setting after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from ahrsd.simulation.scenarios import Settings


def noise_sweep(base: Settings, noise_mag_gauss: Sequence[float]) -> Iterator[Settings]:
    """The experiment at each level of magnetometer noise, gauss ([L] chapter 4)."""
    for level in noise_mag_gauss:
        yield replace(base, noise_mag_gauss=level)


def bias_sweep(base: Settings, scales: Sequence[float]) -> Iterator[Settings]:
    """The experiment with the hard iron multiplied by each scale ([L] chapter 4)."""
    for scale in scales:
        hard_iron = base.iron.pseudo_hard_iron_gauss * scale
        yield replace(base, iron=replace(base.iron, pseudo_hard_iron_gauss=hard_iron))
