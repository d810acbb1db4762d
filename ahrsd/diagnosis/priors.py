"""Every prior, loss, ordinary size and threshold of a diagnosis, with unit, meaning and source.

Ordinary sizes are printed by `python tests/benchmarks/diagnosis/bench_remainder_priors.py`, which
measures them on untouched real recordings: lognormal about a median, `spread` in the logarithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log

import numpy as np

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
#: directions that a source of one may have
DIRECTIONS = 100.0
#: s by which two moments may differ that are one, rounded
SAME_MOMENT_S = 2e-3
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
#: deviation of the log power of a magnetometer's axis from the mean of the three;  source: up to .5
#: on eight of eleven untouched recordings, .6, .7 and 1.2 on the others
AXES_DIFFER = 0.4
#: cosines that an octave has at least for its covariance to be asked
DIRECTED_COSINES = 12
#: power of a source of one direction, relative to the noise's in an octave: where there is one
DIRECTED_SHARES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
#: nats of such a source beside what real recordings leave, from which it is unknown;  source:
#: eleven untouched recordings have up to 106
DIRECTED_REAL = 200.0
#: share of what a name adds that has one direction, and cosine to that of something unknown, from
#: which the two are one source: twenty degrees, six of a hundred directions by chance
ONE_SOURCE, SAME_DIRECTION = 0.8, 0.94
#: the same share of something unknown: a free course takes noise along the other axes as well
MAINLY_ONE = 0.5

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

# --- simulations against which an answer is held -------------------------------------------------
# Smaller probabilities and more nats make the engine more silent (`answer/null_simulations.py`).
#: probability by chance below which an answer that tells nothing is held against simulations all
#: the same;  chosen
FAMILY_P = 1e-3
#: nats that simulations of the calibration alone are taken to show at least;  source: of 300 nulls
#: of five noise laws three have more, errors of a gyro whose bias walks
ALONE_NATS = 9.0
#: gyro beside magnetometer: turns of the field by its noise in a step, in the deviations of a
#: reading, from which on evidence is held against simulations;  source: above every real recording
#: that was looked at, below the simulations that were told to differ from themselves
CHANCE_LOUD = 2.0
#: the same where the gyro's noise moves the calibration by so many deviations to which it is known;
#: source: simulations that hardly tilt have .6 to .9, those that do .2 at most, real recordings
#: next to nothing but one that never moves
CHANCE_BENT = 0.3
#: simulations to which the calibration alone is fitted, for the bands in which the recording's own
#: fit has to be where nothing is told;  and how many of these are diagnosed at most;  chosen
CHANCE_FITS, CHANCE_COPIES = 16, 5
#: of what chance makes, the part that is told when all of these were asked, and when so many fewer
#: were that the rest need not be;  source: an exponential tail of unknown scale, four times the
#: largest of five and 43 times the larger of two
CHANCE_P, CHANCE_EARLY_P = 1 / 126, 1e-3

# --- checks of what is left ----------------------------------------------------------------------
#: probability that any statistic of a simulation is outside of its band
CHECKS_OUTSIDE = 0.01
#: deviations beyond the mean of the largest values of 16 copies that one more is below in 999 of
#: 1000 draws, a thousandth for each of ten statistics;  source: Gumbel's law, drawn in
#: tests/diagnosis/answer/test_predictive_checks.py
CHECKS_LARGEST_REACH = 6.5
#: times the power that noise has in means over segments, beyond which these are no noise;  chosen
SLOW_BEYOND = 2.0
#: mean square of the innovations below which an assumed noise is not there;  source: two of the
#: three axes have the gyro's, 2 / 3 where the magnetometer has none
ABSENT_NOISE = 0.8
#: probability by chance below which a test of the innovations is said to fail;  chosen
TEST_FAILED = 1e-4

# --- what is said of a finding -------------------------------------------------------------------
#: log odds: none is told surer;  chosen
SUREST_ODDS = 30.0
#: probability from which on another name is told beside one;  chosen
SMALLEST_SHARE = 0.01
#: part of the squares that may be left where one component's columns hold another's;  chosen
COLUMNS_ALIKE = 1e-3
#: deviation of each number of a setting, in the changes of which its slopes are made
#: (`inference/search/near_settings.py`);  chosen
SETTING_OFF = 25.0
#: settings that an onset which was sought finely counts for at least;  onsets among which one that
#: the data proposed was chosen
SOUGHT_SETTINGS, PROPOSED_ONSETS = 40, 200
#: part of the largest axis that an axis has on which a term acts;  part of the largest stretch that
#: a stretch has in which it does;  part of the whole time, from where on it is everywhere
ACTS_ON_AXIS, ACTS_IN_STRETCH, ACTS_EVERYWHERE = 0.2, 0.15, 0.6
#: part of a course's largest departure from its usual level, from which on it is away;  deviations
#: by which its beginning and end are still away
DEPARTED, STILL_DEPARTED = 0.25, 2.0
#: range that a quantity has at least for what is left to be told by it, in its unit
REGIME_RANGE: Mapping[str, float] = {
    "heading_deg": 60.0,
    "pitch_deg": 10.0,
    "roll_deg": 10.0,
    "rate_rad_s": 0.05,
}
#: horizontal part of the field where no accelerometer says what is level: at 60 degrees of dip;
#: and the smallest in which a heading is told
LEVEL_SHARE, LEVEL_LEAST_SHARE = 0.5, 0.1

# --- a narrow band -------------------------------------------------------------------------------
#: times as loud as both sides;  source: the colour of a few coefficients is not so steep
BAND_STANDS_OUT = 3.0
#: Hz below which none is sought: there are courses in time and the motion's own rates
BAND_LOWEST_HZ = 0.75
#: part of the power that is along the field, at most, in an error of the gyro; else about a third
BAND_ALONG = 0.1

# --- a simulation that somebody brought ----------------------------------------------------------
#: s that it has in common with the recording, at least;  chosen
OVERLAP_S = 20.0
#: correlation of the two gyros that is the same motion; another motion is far below
SAME_MOTION = 0.8
#: deviations: parameters that differ by less are the same effect;  chosen
SAME_SIGMAS = 4.0

# --- the calibration -----------------------------------------------------------------------------
#: prior deviations of the 11: soft iron about I, hard iron (gauss) about 0, gyro bias (rad/s);
#: source: a thousand times too wide to matter where the motion shows anything
CALIBRATION_DEVIATION = np.array([0.15] * 5 + [0.5] * 3 + [0.03] * 3)
CALIBRATION_DEVIATION.flags.writeable = False
#: scatter of the field over its size that shows the iron; below, the prior is narrower
IRON_TURNED = 0.1
#: of how many data one says something new, from which on the prior is made to count
REPEATED = 3.0
#: rad/s that the mean of a resting gyro may differ from its bias, where the field shows that it
#: rests
STILL_BIAS_RAD_S = 1e-3
#: rows that a recording counts for where the centre of its sphere is sought, and how far it is from
#: a sphere, of the mean square;  chosen
SPHERE_ROWS, SPHERE_OFF = 100, 0.1
#: steps that a fit needs;  chosen
FIT_STEPS = 15
#: deviation of the field at the first row of a run that has no reading, of its size, in all
#: directions
UNSEEN_FIELD = 0.5

# --- levels of noise -----------------------------------------------------------------------------
#: times the gyro's differenced noise that its noise may be at most;  source: free, it swallows
#: every drift of the gyro
GYRO_NOISE_CAP = 1.5
#: deviation of the logarithm of the gyro's noise from its differenced one before the data speak;
#: the same below that where the differences are mostly of the motion
GYRO_NOISE_TRUST, SHAKEN_TRUST = 0.25, 1.5
#: random walk of the bias, rad/s per square root of a second, beyond which it is no longer noise:
#: 50 deg/h after 400 s
WALK_CAP_RAD_S_SQRT_S = 1.2e-5
#: nats that a wandering bias must gain;  source: two standard deviations are not enough
WALK_NATS = 6.0
#: noise of a magnetometer whose readings are too far apart to be compared with each other, gauss
USUAL_MAG_GAUSS = 1e-3
#: least noise of the magnetometer, gauss, and of the gyro, rad/s;  source: below the
#: magnetometer's, what the filter leaves out (it is linear) would be more than the noise
FLOOR_MAG_GAUSS, FLOOR_GYRO_RAD_S = 2e-5, 1e-5

# --- noise that is louder for a while ------------------------------------------------------------
#: nats by which a change of level must be likelier than none;  source: with the 20,000 stretches
#: that 400 s have, one recording of one level in ten thousand has such a one
LOUDER_NATS = 17.0
#: of the two variances, at least;  chosen
LOUDER_RATIO = 1.3
#: deviations from which a reading is no more a sign of a louder noise
LOUDER_OUTLIER = 3.0
#: part of the recording that a burst may last;  part of a stretch that is loud, from which on it is
#: loud throughout;  chosen
BURST_SHARE, BURST_FILLED = 0.4, 0.7
#: correlation of successive differences of noise, at most;  source: -1/2 where it is white
NOISE_OPPOSED = -0.3
#: variance over the spec's, from which on the noise is above it;  chosen
LEVEL_RATIO = 1.15

# --- what a gyro's readings are ------------------------------------------------------------------
#: a gyro's noise per sample, rad/s, below which none is;  coning that is no more than so many times
#: its square, summed, is lost even in this and left
CONING_QUIETEST_RAD_S, CONING_LOST = 1e-4, 10.0
#: deviations that none and all of it must be apart to be told;  deviations beyond all of it from
#: which on it is something else
CONING_RESOLVED, CONING_OFF = 3.0, 4.0
#: change of the rate from step to step over the rate, root mean squares, beyond which the product
#: of neighbours says nothing of what was between them
CONING_UNRESOLVED = 0.5
#: of the usual level, what the quiet seconds of noise are at least; a motion's are quieter;
#: source: of twelve real recordings eleven have a tenth of their seconds below .67, of 120
#: simulated motions none below .76
SHAKEN_STEADY = 0.7
#: noise of the magnetometer over its differences beyond which something else is wrong;  noise of
#: the gyro over its differences below which these were the motion's
SHAKEN_WRONG, SHAKEN_QUIETER = 1.5, 0.7

# --- a gyro that stands still --------------------------------------------------------------------
#: 1 - |mean direction| of the field in the sensor, below which it hardly turns: directions within
#: about 5 degrees
REST_SPREAD = 4e-3
#: walk of an ordinary gyro's bias, rad/s per square root of a second: 20 deg/h in 400 s is noise
#: and gets no name
ORDINARY_WALK_RAD_S_SQRT_S = 5e-6
#: what may move the bias, and log prior odds;  source: that the recording began when the power came
#: on, as a start-up needs, is seldom so
REST_CAUSES: Mapping[str, float] = {
    "gyro_bias_temperature": 0.0,
    "gyro_bias_drift": 0.0,
    "gyro_bias_step": 0.0,
    "gyro_startup": -5.0,
}
#: prior deviation of the bias itself, rad/s
REST_BIAS_RAD_S = 1e-2
#: seconds of standing that are needed;  how far a still second's scatter may be, of the usual one,
#: and its mean, rad/s
REST_S, REST_SCATTER, REST_AWAY_RAD_S = 60, 3.0, 0.01
#: nats over its walk alone for a cause of the bias: odds 50 to 1 for every candidate's size
REST_NATS = 4.0
#: deviations of an ordinary walk: a change below is one
REST_LARGE = 3.0
#: probability from which on another cause is told beside one;  chosen
REST_SMALLEST_SHARE = 0.005
#: share of the gyro's integral that the field follows, beyond which the vehicle does turn
REST_TURNS = 0.3

# --- a delay -------------------------------------------------------------------------------------
#: part of the middle step within which steps are alike, and so many must be
STEPS_ALIKE, STEPS_ALIKE_SHARE = 0.25, 0.95
#: part of half a step within which a delay is one: then it is the gyro's
HALF_STEP_WITHIN = 0.1
#: s that a magnetometer is ordinarily late at most: readings so near to a run's first row are left
#: out;  source: BROAD 11 ms, a VN-100 by hand 25 to 40, a flight 50 to 100
BEGIN_S = 0.1
#: part of a run from which on its first readings are too many to be left out.  Chosen, not measured
BEGIN_SHARE = 0.1

# --- logged columns ------------------------------------------------------------------------------
#: s without values that are filled;  source: a column of 1 Hz beside samples of 25 Hz has them, a
#: failed logger has more
COLUMN_GAP_S = 2.0
#: part of the rows without a value beyond which a column is left out;  chosen
COLUMN_MISSING = 0.98
#: the same of a column with long holes, whose other readings are used: with more holes than values
#: it says too little
COLUMN_HOLES = 0.5
#: rows that a 0/1 column stays on, beyond which it is a switch, else a train of pulses
SWITCH_ROWS = 4
#: s between a column's values, at most: what changes more seldom is a level
COLUMN_HELD_S = 5.0
#: share of the values that come after one period, and by how much of one they may miss it
COLUMN_REGULAR, COLUMN_MISS = 0.6, 0.25
#: fewest values that tell how a column was logged
COLUMN_UPDATES = 20
#: deviations of its own scatter by which a logger's noise may depart from flat, and from Gaussian
COLUMN_NOISE_SCATTER = 3.0
#: part of a column's power that its course has at least, where its noise is taken off
COLUMN_COURSE = 0.8
#: share of an unknown course that a column of another clock must explain, and deviations of what it
#: explains at other times
CLOCK_SHARE, CLOCK_SURE = 0.5, 4.0
#: nats of a column's clock over the column as logged, and of a drift over a lag that stays
CLOCK_NATS = 30.0
#: s: a column's lag below is none
CLOCK_SMALLEST_S = 0.1

# --- data quality: how sure a fact is ------------------------------------------------------------
#: probability of a name that was counted and compared: a limit, coarse steps, stamps, axes, units
SURE_OF_READINGS = 0.99
#: the same of lost turns and of louder noise, which are told against noise
SURE_OF_NOISE = 0.98
#: of samples that came twice;  of a clock's rate against another;  of time that goes back
SURE_OF_DOUBLED, SURE_OF_CLOCK, SURE_BACKWARDS = 0.95, 0.95, 0.9

# --- data quality: time stamps -------------------------------------------------------------------
#: share of the samples that are missing, from which on it is said;  chosen
MISSING_SHARE = 1e-3
#: of the step, from which on scatter is jitter unless the field says that the steps are as stamped;
#: below, only where the field says that they are even
JITTER_SHARE = 0.03
#: correlation of neighbouring steps that scatter, at most;  source: -1/2 of late stamps
JITTER_OPPOSED = -0.25
#: nats for steps as stamped, against steps of a regular clock, or the reverse
STAMPED_NATS = 5.0
#: deviations beyond which a change of the field is not asked for that
STAMPED_OUTLIER = 5.0
#: relative rate between two clocks that is worth a word
CLOCK_RATE = 2e-4
#: s of a break that is believed whatever the recording's length;  what is left of one that is not
BREAK_BELIEVED_S, BREAK_LEFT_S = 60.0, 10.0
#: share of the samples that are missing, and scatter of the stamps of the step, from which on they
#: are a finding;  source: by honest stamps they are part of the recording and no difference from
#: its simulation, which has the same stamps, unless there are so many
MISSING_FINDING_SHARE, JITTER_FINDING_SHARE = 0.02, 0.05

# --- data quality: lost turns --------------------------------------------------------------------
#: samples before and after a jump, and how many deviations of a mean a step's turn must have;
#: source: over more samples there are fewer jumps by chance
LOST_TURN_AVERAGED = ((3, 7.0), (12, 5.0))
#: steps by which a jump may be off a whole number
LOST_TURN_NEAR = 0.3
#: jumps, at least;  source: of 18 untouched recordings and 240 simulations (eight draws of two
#: worlds) none without lost samples has so many that the nats below hold for
LOST_TURNS_FEWEST = 3
#: nats by which they must be whole steps rather than noise;  source: others have 160 and more
LOST_TURNS_NATS = 12.0
#: and nats that each must have in the mean;  source: a gyro that reads 3 % too little is ahead all
#: the time, and on a path through a room 13 jumps had 2.4 each; lost turns have 3.8 and more
LOST_TURN_EACH_NATS = 3.0
#: deviations of a mean that no noise jumps by;  part of such a jump that is across the turn, more
#: than a lost one has
JUMP_CLEAR, JUMP_ACROSS = 8.0, 0.5
#: deviations of a jump that many turns in a row were lost at, which nobody can count
JUMP_LONG = 30.0
#: nats of one lost turn beyond its share of the rows;  chosen
LOST_TURN_BEYOND_SHARE_NATS = 3.0
#: times as many rows as are averaged: else their spread is not known
LOST_TURN_ROWS = 10
#: nats that each further step of a gap costs: one in four gaps is longer by one more
LONGER_GAP_NATS = log(4.0)
#: chi square, of two axes, of a jump's part across the turn that one in 400 is beyond
JUMP_ACROSS_CHI2 = 12.0
#: nats for a step that counts twice;  source: one in twenty does, and must be surer than chance
COUNTED_TWICE_NATS = 6.0
#: nats that one jump is worth at most: several must say it, not a field that jumps once
JUMP_MOST_NATS = 6.0
#: of a step, in the mean over the rows that have a part of it: what a lost turn has there, and what
#: it has not
LOST_TURN_PART, OTHER_PARTS = 0.7, (0.3, 1.4)
#: nats by which all jumps together must be lost turns, less so many times those backward;  source:
#: 3.5 is the most of 370 recordings with none lost
LOST_TURNS_TOGETHER_NATS, LOST_TURNS_BACKWARD = 12.0, 3.0

# --- data quality: limits and steps of the numbers -----------------------------------------------
#: samples at a limit, and their share of all samples, at least;  chosen
LIMIT_FEWEST, LIMIT_SHARE = 8, 1e-3
#: times as many at a limit as at each number just inside it;  chosen
LIMIT_PILED = 6.0
#: noise levels, and share of the limit, at which it begins to act
LIMIT_MARGIN_NOISE, LIMIT_MARGIN_SHARE = 5.0, 0.02
#: steps of coarse numbers: as many at the top as one step below are no limit
LIMIT_TOP_STEPS = 1.5
#: noise levels that hold a heap of readings at a limit that noise is added to
LIMIT_HEAP_NOISE = 7.0
#: sides of axes that end at a shared limit, and how alike they are, of it
LIMIT_SIDES, LIMIT_ALIKE = 3, 0.01
#: share of the readings that differ from all others, where numbers are fine
FINE_NUMBERS = 0.5
#: steps of the numbers over the noise's deviation that matter
COARSE_STEPS = 2.0

# --- data quality: axes and units ----------------------------------------------------------------
#: cost of the best frame, of that of no motion, at most;  chosen
FRAME_EXPLAINED = 0.6
#: times the cost, and nats, by which the frame as recorded must be worse;  chosen
FRAME_BETTER, FRAME_NATS = 1.5, 20.0
#: times the cost by which iron that deforms may favour another frame: it is left out there
FRAME_BENT = 3.0
#: rad/s that no vehicle has for long;  factor from that of degrees within which the scale is theirs
FAST_RAD_S, DEGREES_NEAR = 3.0, 1.1
#: factor from a unit's own within which the gyro's scale is that unit
SAME_UNIT = 1.2
#: factor of the gyro's scale beyond which it is another unit
OTHER_UNIT = 2.0
#: part of the rates' variance that is noise, at most, for a factor that is no unit's to be believed
RATES_NOISE_SHARE = 0.05
#: cost below which a part of a recording is explained;  chosen
PART_EXPLAINED = 0.1
#: part of gravity's turns that the gyro may leave, and how many times more by other axes;  chosen
GRAVITY_EXPLAINED, GRAVITY_BETTER = 0.5, 1.5
#: readings of an ellipsoid, more than;  chosen
ELLIPSOID_READINGS = 100
#: sine of the inclination from which up and down are told
STEEP = 0.15
#: degrees of a turn beyond any quarter from which a mount is askew, and no crooked sensor any more
ASKEW_DEG = 10.0
#: of a map that is a turn: its longest axis over its shortest, at most;  deviations by which it is
#: no quarter
ASKEW_ROUND, ASKEW_TOLD = 1.25, 4.0
#: cosine of a turn's axis to the sensor's, to be called by its name
ASKEW_ABOUT = 0.97

# --- data quality: stuck, held and doubled readings ----------------------------------------------
#: part of the field, and noise levels, by which a reading should have moved;  chosen
STUCK_MOVED_SHARE, STUCK_MOVED_NOISE = 0.1, 8.0
#: steps of coarse readings by which it should: they repeat themselves where they turn the least
STUCK_MOVED_STEPS = 20.0
#: rad that the gyro turned by while a magnetometer never changed, beyond which it is stuck;  chosen
STUCK_TURNED_RAD = 0.3
#: rows that one axis, or the gyro, repeats at least;  chosen
AXIS_STUCK_ROWS = 8
#: part of what is left of the field's changes which lies as a turn about one axis of the gyro;
#: noise levels that this is at least;  rad about that axis, by the field, beyond which it is dead
DEAD_AXIS_SHOWN, DEAD_AXIS_NOISE, DEAD_AXIS_TURNED_RAD = 0.5, 3.0, 0.1
#: usual size of a reading in any unit of a field, from tesla to nanotesla
FIELD_READINGS = (1e-6, 1e6)
#: readings so many times the usual field are none;  nor are rates so many times the quickest but
#: for one in a thousand and beyond what is quick in any unit
IMPOSSIBLE_FIELD, IMPOSSIBLE_RATE, IMPOSSIBLE_RAD_S = 100.0, 100.0, 40.0
#: rows that a stuck reading lasts at least, and so many times as long as a reading usually does
STUCK_ROWS, STUCK_LONGER = 8, 5.0
#: noise levels by which the field must have turned during the repetition;  chosen
STUCK_TURNED_NOISE = 8.0
#: s, all together, from which on a stuck magnetometer is a finding;  source: a reading that is held
#: for less came late and is not used; that is no fault of the sensor, but again and again it is
STUCK_FINDING_S = 0.25
#: steps of coarse numbers by which the field must turn to have a new reading
HELD_STEPS = 3.0
#: repeated readings, at least;  chosen
HELD_REPEATS = 20
#: share of repeated readings where the sensor turns, of that in all, at least;  source: numbers
#: that are coarse change there, and a reading that is held does not
HELD_MOVING_SHARE = 0.7
#: s between readings of a magnetometer: less is a rate of its own;  source: 202 a second in all
#: recordings of BROAD, rows at 286
HELD_ORDINARY_S = 0.01
#: variance of the time from one new reading to the next, in that of chance, at most
HELD_CLOCKWORK = 0.3
#: sums of such times that tell it, at least;  variances that one counts, at most;  chosen
HELD_FEWEST_SUMS, HELD_MOST_VARIANCES = 15, 4.0
#: share of the samples that came twice, at least;  chosen
DOUBLED_SHARE = 2e-3
#: times as many as if each sensor repeated for itself;  source: a slow turn makes it nearly two
DOUBLED_BEYOND_CHANCE = 5.0
#: noise levels of the gyro beyond which the sensor turns;  chosen
DOUBLED_TURNING_NOISE = 5.0
