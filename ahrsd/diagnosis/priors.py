"""Every prior, loss, ordinary size and threshold of a diagnosis, with unit, meaning and source.

Ordinary sizes are printed by `python tests/benchmarks/diagnosis/bench_remainder_priors.py`, which
measures them on untouched real recordings: lognormal about a median, `spread` in the logarithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp

from ahrsd.estimator import locked


@dataclass(frozen=True, slots=True)
class Size:
    """A deviation that is lognormal.

    median: in the component's unit;  spread: of its logarithm;  most: what physics allows
    """

    median: float
    spread: float
    most: float

    def up_to(self) -> float:
        """What 95 % stay below, the component's unit."""
        return self.median * exp(1.645 * self.spread)


# --- what every real recording leaves: measured ----------------------------------------------
#: untouched recordings that were measured
RECORDINGS = 19
#: deviation over the recording, gauss and rad/s; of the others of the coefficient of unit functions
ORDINARY: Mapping[str, Size] = {
    "world_course": Size(locked.COURSE, 1.53, 0.1),  # gauss
    "gyro_course": Size(1.28e-03, 1.73, 0.05),  # rad/s
    "by_direction": Size(locked.BY_DIRECTION, 1.74, 0.2),  # gauss: harmonics of degree 2 and 3
    "by_change": Size(locked.BY_CHANGE, 1.51, 0.03),  # s: axes that are late by different times
    "bending": Size(5.58e-01, 1.10, 3.0),  # of the library's usual flexible mount
    "by_rate_squared": Size(locked.BY_RATE_SQUARED, 2.10, 0.03),  # rad/s at 1 rad/s
    "field_by_rate": Size(locked.FIELD_BY_RATE, 1.72, 0.02),  # gauss at 1 rad/s
    "by_force": Size(2.79e-03, 1.74, 0.03),  # rad/s at 1 g
}
#: of a gyro's matrix: how crooked it sits (1.2 degrees), scales and shears of its axes
ORDINARY_MISALIGNMENT_RAD, ORDINARY_SCALE = 0.02, 0.012
#: deviations by which three turns of it are off together in one recording of twenty
CROOKED = 2.8

#: of a delay between the sensors, s: BROAD 11 ms, a VN-100 by hand 25 to 40, a flight 50 to 100
ORDINARY_LAG_S = 0.04
#: turn within a step, rad, from which on its gyro's sample does not tell it: a rate that goes from
#: nothing to twice its mean within the step leaves a sixth of it, 3 degrees
SAMPLED_TURN_RAD = 0.3
#: how much of a delay is a filter's, 1 all of it
LAG_IS_FILTER = 0.5

#: rad/s below which a sensor stands still, and part of its ordinary rate;  of all of its time,
#: above which this is how it moves;  source: hands of BROAD at rest turn by less than 0.05
STILL_RAD_S, STILL_PART, MOSTLY = 0.05, 0.2, 0.8
#: s over which the rate is taken;  of a spell at rest, at least;  and how many, the longest
SMOOTHED_S, STILL_S, MOST_SPELLS = 0.5, 3.0, 4

# --- what may be there besides ------------------------------------------------------------------
#: deviations of a reading by which the way of a step's source is off a step for it to be unread,
#: and those to which it then is
MOVED, MOVED_LEAST = 10.0, 2.0
#: probability of any one effect of the library;  source: the brief of the engine, 1 in 60
EFFECT = 1.0 / 60.0
#: of a delay between the sensors, which recordings ordinarily have
DELAY = 0.5
#: steps of a kind that are nearer than that are one, s
TRANSITION_S = 2.0
#: seconds before and after a step for which whatever makes it may be anywhere: a strong magnet is
#: seen from half a metre on, and a hand takes its time
APPROACH_S = 4.0
#: of a further step of a kind that is there: what was put on is taken off
AGAIN = 0.3
#: steps of a kind from which on they are one source that changes, which has no name
CHANGES = 3
#: of a course in time that nothing names, in one frame
COURSE = 1.0 / 20.0
#: that a recording leaves what real ones do, and not what a simulation does: nothing
REAL = 0.5
#: sizes of a course in its unit (1 mG, 0.1 mrad/s), and its time constants as shares of it all
COURSE_UNIT: Mapping[str, float] = {"sensor": 1e-3, "world": 1e-3, "gyro": 1e-4}
COURSE_SIZES = (1e-2, 5e2)
#: corner of a course's spectrum, in half waves a recording
COURSE_CORNERS = (1.0, 40.0)
#: corner, in half waves a recording, below which a course is a drift: a walk has one
DRIFT_CORNER = 3.0
#: of a source that comes and goes: s that it is on and off at a time, of which its course is free
#: in such pieces; half waves a second between which its corner is
SPELL_S, BETWEEN_S, SPELL_PIECE_S, SPELL_CORNERS = 2.0, 20.0, 0.2, (0.1, 10.0)
#: part of the time that it is on, beyond which it does not come and go; and half waves of all of
#: its spells, at most
MOST_ON, MOST_WAVES = 0.3, 100
#: nats by which a residual is unlike along its three axes: twice that is one in 1e6 by chance, of
#: five degrees of freedom;  and directions that a source of one may have
UNALIKE, DIRECTIONS = 18.0, 100.0
#: how often what switches is outside of the vehicle;  three nats
SWITCHES_OUTSIDE = 0.05
#: square of a jump of the mean, in its deviations, of three axes: one in 1e6 by chance
JUMPS = 31.0
#: how many times its usual scale an effect is, evenly in the logarithm
EFFECT_SIZES = (1e-2, 10.0)
#: the same where candidates are only ranked
EFFECT_GRID = (0.01, 0.033, 0.1, 0.33, 1.0, 3.0)
#: s by which a logged cause may come late into the log, or early;  source: averages of loggers; the
#: motor's current of a flight came 0.32 s late
LOGGED_LATE_S = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4)
#: s over which a logger may take its means, sought on from there: a row of a log at 1 to 5 Hz;  and
#: the part of a column's power that is lost where a mean leaves nothing.  Chosen, not measured
LOGGED_MEANS_S, LOGGED_LOST = (0.2, 0.4, 0.8), 0.02
#: s by which a column's clock is off from which on it is sought: nearer, its setting is
ON_TIME_S = 1.0
#: s over which a logger ordinarily takes its mean: a battery's monitor filters over a tenth
LOGGED_BLUR_S = 0.05
#: that iron has something along an axis from before the recording, and of twenty values this one
REMEMBERED = 1.0 / 20.0

#: deviation of a name's coefficient that is free in time or attitude, relative to itself: from
#: which on the name stands in for something else, and the largest;  source: in time twelve names
#: that are there have .1 at most, stand-ins .36 to 1.3 (workboat 501, 601, road_and_air 502, 602)
VARIES, VARIES_MOST = 0.25, 10.0

# --- noise --------------------------------------------------------------------------------------
#: deviation of a log power from that of the next octave: of a sensor's own noise, of what a real
#: recording leaves as well, and where only a delay is sought;  of the highest from the filter's
NOISE_STEP_CLEAN, NOISE_STEP_REAL, NOISE_STEP_FREE, NOISE_TOP = 0.25, 0.6, 1.5, 3.0
#: log power by which a band is louder than the highest where the noise has what a model lacks
LOUD = 2.0
#: times as loud as its sides that a narrow band is for it to be a source that hums and no colour
STANDS_OUT = 3.0
#: log powers between which a band stays
NOISE_RANGE = (-9.0, 9.0)
#: degrees of freedom of readings beyond their level, beside normal ones;  source: 3 on a flight
FREEDOMS = (3.0, 5.0, 8.0, 15.0)
#: seconds over which the noise's level is taken;  powers between which it stays, of the median's
LEVEL_S, LEVELS = 4.0, (0.02, 50.0)
#: octaves of the noise's spectrum, at most
BANDS = 7

#: size of a free course, by frame, that one in ten untouched recordings is beyond beside the
#: remainder, gauss or rad/s: it is a finding only where it is larger;  source: the same command.
#: Of effects it is a column of the library, `ordinary`
ORDINARY_COURSE: Mapping[str, float] = {"sensor": 0.017}

# --- where it is linearised --------------------------------------------------------------------
#: deviations of calibration and delay to which a point is where its model wants it
NEAR = 0.7
#: deviations by which the readings say at a delay that it is nearer to none, for it not to be one
POINTS_BACK = 2.0

# --- the decision -------------------------------------------------------------------------------
#: log odds from which an effect is told: a false name costs more than a missed one;  from which a
#: factor that is free says that a name stands in for something else
NAME_ODDS, FORM_ODDS = 3.0, 3.0
#: from which something is called unknown: a course explains whatever the noise has that its law
#: lacks;  source: nulls of other authors' generators had 4, 7, 9, 14 and 37 where others had less
#: than 3 (slow noise, host stamps that jitter)
UNKNOWN_ODDS = 12.0
#: both on a recording with an ordinary remainder: its laws are not exact, a few nats say nothing
ODDS_REAL = 12.0
#: odds that what one effect explains is a wider one's in just that form, which no reading tells:
#: one cause may make a gyro's axes all be off alike, but more often they differ
SAME_FORM = 0.5
#: part of the evidence of what is unknown that a name beside it must have;  source: stand-ins .25
#: and .46 there, the one that is there .75
BESIDE_UNKNOWN = 0.5
#: part of the square of what a name and its form add that the name's own columns hold at least;
#: source: pulses .92 (that swell and fade) and 1.0, a square current taken for pulses .29
OWN_PART = 0.5
#: coefficients of a set that is asked, at most: the time that it takes goes by the cube;  source:
#: a flight with its current and magnets put on were told with sets of up to 770, counted once
WIDEST = 800
#: nats that a move of the search must gain
MOVE = 2.0
#: how near to all of a delay must be a filter's to be called one
NEARLY_ALL = 0.25
#: of a delay to be half a step of the recording: a gyro that tells the rate of the moment
HALF_STEP = 0.1

# --- what is held against an answer --------------------------------------------------------------
#: parts into which a recording is dealt, each foretold from the others, and seconds of a stretch:
#: longer than a whitened reading remembers, shorter than an object that is passed by
PARTS, STRETCH_S = 5, 2.0
#: shares of a recording by which copies of a cause are moved: no simple ones, what comes again and
#: again would meet itself
SHIFTS = (0.236, 0.382, 0.472, 0.618, 0.764, 0.854)
#: deviations of a coefficient from which on it would have been told nine times in ten
SHOWN_AT = 6.5
#: probability that any bin of any regime is outside of its band where nothing is left
BINS_OUTSIDE = 0.01
#: s that an object which is passed by shows at most: what it leaves there is no noise
PASSING_S = 30.0
#: probability by chance, and correlation, of a logged column that is said to move with a course
CHANCE, ALIKE = 0.2, 0.5


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
