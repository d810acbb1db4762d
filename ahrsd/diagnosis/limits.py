"""Every threshold on which a verdict rests, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Limits:
    """Smaller probabilities and more nats make the engine more silent.

    family_p:       family-wise probability below which a candidate may be named; times the number
                    of candidates and settings tried it is the chance of a false name, 1 in 1000
                    before the other gates
    robust_family_p: the same for the block-robust test, whose tails are heavy with few blocks; it
                    guards against coloured and bursty noise, where the score test does not
    evidence_nats:  evidence over the calibration alone: odds 50 to 1 for every candidate's size
    lead_nats:      two candidates closer than this are told as one set (odds of 20 to 1)
    cv_gain:        held-out gain, nats per sample, must be above this
    placebo_beaten: share of time-shifted copies of a candidate that it must beat
    coverage:       share of the agnostic statistic of its own frame that a time-shaped name must
                    explain, else it is a stand-in for an unlogged source
    most_shaped:    steps, drifts and bumps of one frame beyond this are one source that changes
    beyond_nats:    what a name must be worth beyond the random effects of what the model leaves
                    (`discrepancy`), where it leaves something: a library of a hundred names and
                    settings against a remainder whose form is only roughly known
    beyond_share:   and in parts of what the random effects are worth themselves: what is a small
                    part of the unknown is not known; of real recordings the names that are known
                    to be right have a fifth at least, those that are not a seventh at most
    beside_nats:    and where it is found with the remainder whitened out of everything
    beside_logged_nats: the same of a logged cause that changes often, which no room imitates
    unknown_nats:   evidence of an agnostic frame beyond the names, for "not in my library"
    unknown_p:      its probability under coloured noise
    alone_nats, alone_p: the same where nothing at all was found, so that no name's own misfit can
                    be what is left: odds of 8000 to 1.  Of 300 nulls of five noise laws three have
                    more, errors of a gyro whose bias walks, which are held against a walk besides
    doubt:          what noise model and library do not know, by which every confidence is less:
                    about the share of names with all of the evidence that sealed rings found wrong
                    (docs/validation/blind-trials.md, "calibration error of the confidence")
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
                    asked, and when so many fewer were that the rest need not be (`chance`)
    most_terms:     rounds of naming; real recordings beyond this are another model, not a repair
    """

    family_p: float = 1e-3
    robust_family_p: float = 5e-4
    evidence_nats: float = 4.0
    lead_nats: float = 3.0
    cv_gain: float = 0.0
    placebo_beaten: float = 0.99
    coverage: float = 0.9
    most_shaped: int = 3
    beyond_nats: float = 60.0
    beyond_share: float = 0.15
    beside_nats: float = 35.0
    beside_logged_nats: float = 20.0
    unknown_nats: float = 12.0
    unknown_p: float = 1e-6
    alone_nats: float = 9.0
    alone_p: float = 1e-4
    doubt: float = 0.01
    chance_loud: float = 2.0
    chance_bent: float = 0.3
    chance_fits: int = 16
    chance_copies: int = 5
    chance_p: float = 1 / 126
    chance_early_p: float = 1e-3
    most_terms: int = 5

    def alone(self) -> Limits:
        """The limits of what is left where nothing was found."""
        return replace(self, unknown_nats=self.alone_nats, unknown_p=self.alone_p)


LIMITS = Limits()
