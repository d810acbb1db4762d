"""The thresholds that hold an answer against simulations, and what a gyro at rest must show.

What the one model decides by is in `one_model/priors`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limits:
    """Smaller probabilities and more nats make the engine more silent.

    family_p:       probability by chance below which an answer that tells nothing is held against
                    simulations all the same
    evidence_nats:  evidence over its walk alone for a cause of the bias of a gyro that stands: odds
                    50 to 1 for every candidate's size
    alone_nats:     what simulations of the calibration alone are taken to show at least: of 300
                    nulls of five noise laws three have more, errors of a gyro whose bias walks
    chance_loud:    gyro beside magnetometer: turns of the field by its noise in a step, in the
                    deviations of a reading, from which on evidence is held against simulations.
                    Above every real recording that was looked at, below the simulations that
                    were told to differ from themselves
    chance_bent:    the same where the gyro's noise moves the calibration by so many deviations to
                    which it is known.  Simulations that hardly tilt have .6 to .9, those that do
                    .2 at most, real recordings next to nothing but one that never moves
    chance_fits:    simulations to which the calibration alone is fitted, for the bands in which the
                    recording's own fit has to be where nothing is told
    chance_copies:  how many of these are diagnosed at most
    chance_p, chance_early_p: of what chance makes, the part that is told when all of these were
                    asked, and when so many fewer were that the rest need not be
                    (`null_simulations`)
    """

    family_p: float = 1e-3
    evidence_nats: float = 4.0
    alone_nats: float = 9.0
    chance_loud: float = 2.0
    chance_bent: float = 0.3
    chance_fits: int = 16
    chance_copies: int = 5
    chance_p: float = 1 / 126
    chance_early_p: float = 1e-3


LIMITS = Limits()
