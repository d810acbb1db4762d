"""All priors, losses, ordinary sizes and thresholds of a diagnosis, with unit, meaning and source.

Terms that the comments use:

* a nat is a natural logarithm of odds or of a likelihood ratio: 3 nats are 20 to 1;
* an effect is a cause of the library, such as a logged current or a bias drift of the gyro;
* the remainder is the residual that every real recording has, and a simulation does not have;
* a free process is a Gaussian process in time, on the axes of the sensor, of the world or of the
  gyro, of any size.  Together with switching sources it represents what no effect explains.

The ordinary sizes are measured on untouched real recordings and printed by
`python tests/benchmarks/diagnosis/bench_remainder_priors.py`.  Each is log-normal: a median, and
`spread` as the standard deviation of the logarithm.  `docs/design/engine.md` describes how all of
this is used.  Where a comment says "source: chosen", or gives neither a source nor a reason, the
value was chosen and not measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, log

import numpy as np

from ahrsd.estimator import locked


@dataclass(frozen=True, slots=True)
class Size:
    """Log-normal prior of the standard deviation of a component's coefficients.

    median: in the component's unit;  spread: standard deviation of the logarithm;  most: upper
    limit, which physics sets
    """

    median: float
    spread: float
    most: float

    def up_to(self) -> float:
        """The 95 % quantile, in the component's unit."""
        return self.median * exp(1.645 * self.spread)


# --- the ordinary remainder: measured on real recordings ----------------------------------------
#: Number of untouched recordings on which the ordinary sizes were measured.
RECORDINGS = 19
#: Prior size of each component of the remainder.  Of the two processes in time it is the standard
#: deviation over the recording; of the others, of the coefficients of functions of unit size.
#: Source: measured (see above).
ORDINARY: Mapping[str, Size] = {
    "world_course": Size(locked.COURSE, 1.53, 0.1),  # gauss: world field in time and place
    "gyro_course": Size(1.28e-03, 1.73, 0.05),  # rad/s: gyro bias in time
    "by_direction": Size(locked.BY_DIRECTION, 1.74, 0.2),  # gauss: harmonics of degree 2 and 3
    "by_change": Size(locked.BY_CHANGE, 1.51, 0.03),  # s: different delays of the axes
    "bending": Size(5.58e-01, 1.10, 3.0),  # usual sizes of the library's flexible mount
    "by_rate_squared": Size(locked.BY_RATE_SQUARED, 2.10, 0.03),  # rad/s at 1 rad/s
    "field_by_rate": Size(locked.FIELD_BY_RATE, 1.72, 0.02),  # gauss at 1 rad/s
    "by_force": Size(2.79e-03, 1.74, 0.03),  # rad/s at 1 g
}
#: Prior standard deviations of the gyro's matrix in the remainder, per element.
#: ORDINARY_MISALIGNMENT_RAD: of the three rotations by which the gyro is misaligned (1.2 degrees).
#: ORDINARY_SCALE: of the three scales and three shears of its axes.
ORDINARY_MISALIGNMENT_RAD, ORDINARY_SCALE = 0.02, 0.012
#: Length of the rotation of that matrix, in ORDINARY_MISALIGNMENT_RAD, beyond which the
#: misalignment is reported as a finding.  Source: of three normal numbers, 5 % are longer.
CROOKED = 2.8

#: Prior standard deviation of the delay between the sensors, s, and the step in which the delay is
#: searched.  Source: 11 ms in BROAD, 25 to 40 ms with a hand-held VN-100, 50 to 100 ms in flights.
ORDINARY_LAG_S = 0.04
#: Turn within one step, rad, beyond which one gyro sample does not determine the rotation: the
#: gap-free run ends before such a step.  Source: if the rate grows from zero to twice its mean
#: within the step, a sixth of the turn remains unknown, 3 degrees.
SAMPLED_TURN_RAD = 0.3
#: Prior standard deviation of the share of a delay that a filter (low-pass) causes, 1 if all of it.
LAG_IS_FILTER = 0.5

#: Intervals at rest, in which a sensor hardly turns.
#: STILL_RAD_S: largest rate, rad/s; hands of BROAD at rest turn by less than 0.05.
#: STILL_PART: largest rate as a share of the root mean square rate; the smaller limit applies.
#: MOSTLY: if the sensor hardly turns for a larger share of the time, this is how it moves, and
#: there are no intervals at rest.
STILL_RAD_S, STILL_PART, MOSTLY = 0.05, 0.2, 0.8
#: SMOOTHED_S: time over which the rate is averaged for that, s.
#: STILL_S: length of the shortest interval at rest, s.
#: MOST_SPELLS: only so many of the longest intervals are kept.
SMOOTHED_S, STILL_S, MOST_SPELLS = 0.5, 3.0, 4

# --- prior odds and priors of effects, processes and sources --------------------------------------
#: Readings near a step that are left out because something was being moved.  Both are sizes of the
#: form of the step (its component for the transition), in standard deviations of a reading.
#: MOVED: the form has to exceed this somewhere.
#: MOVED_LEAST: the omitted interval extends as far as the form exceeds this.
MOVED, MOVED_LEAST = 10.0, 2.0
#: Prior odds of any one effect of the library.  Source: the requirements of the engine, 1 in 60.
EFFECT = 1.0 / 60.0
#: Prior odds of a delay between the sensors: recordings ordinarily have one.
DELAY = 0.5
#: Time, s, within which two steps of one kind are one step, and within which a step at either end
#: of the recording is not proposed.
TRANSITION_S = 2.0
#: Time, s, before and after a step in which the source of the step may be anywhere: a strong magnet
#: is visible from half a metre on, and a movement by hand takes its time.
APPROACH_S = 4.0
#: Prior odds of each further step of a kind that is already in the model: what was put on is also
#: taken off.  It replaces EFFECT for effects that recur.
AGAIN = 0.3
#: From this number on, steps of one kind are one source with a changing level, which is unknown.
#: It is also the least number of change points of such a source.
CHANGES = 3
#: Prior odds of a free process in one frame, and of any other source that no effect explains.
COURSE = 1.0 / 20.0
#: Prior probability that a recording has the ordinary remainder, as real ones do and simulations
#: do not.
REAL = 0.5
#: Unit of the size of a free process or a source, by frame: gauss, gauss and rad/s.
COURSE_UNIT: Mapping[str, float] = {"sensor": 1e-3, "world": 1e-3, "gyro": 1e-4}
#: Bounds of that size, in this unit; between them the prior is uniform in the logarithm.
COURSE_SIZES = (1e-2, 5e2)
#: Bounds of the corner of a free process's spectrum, in half waves per recording.
COURSE_CORNERS = (1.0, 40.0)
#: Corner, in half waves per recording, below which a free process is a drift.  Source: a random
#: walk has its corner at one half wave.
DRIFT_CORNER = 3.0
#: A source that comes and goes: a two-state Markov chain in time.
#: SPELL_S: mean time for which it is on, s.
#: BETWEEN_S: mean time for which it is off, s; also the mean time between the changes of a source
#: with a changing level.
#: SPELL_PIECE_S: piece of time in which the chain has one state, s; also the shortest half wave.
#: SPELL_CORNERS: bounds of the corner of its spectrum, in half waves per second.
SPELL_S, BETWEEN_S, SPELL_PIECE_S, SPELL_CORNERS = 2.0, 20.0, 0.2, (0.1, 10.0)
#: MOST_ON: share of the time for which such a source is on, beyond which it does not come and go
#: and is not used.
#: MOST_WAVES: largest number of half waves of all of its intervals together; also the largest
#: number of change points of a source with a changing level.
MOST_ON, MOST_WAVES = 0.3, 100
#: Number of directions that noise along one direction may have: its evidence costs log of this.
DIRECTIONS = 100.0
#: Difference, s, below which two times are the same: settings are rounded to 1 ms.
SAME_MOMENT_S = 2e-3
#: Prior probability that a switching source is outside the vehicle (fixed in the world).  Source:
#: 3 nats, as an earlier rule of the engine had.
SWITCHES_OUTSIDE = 0.05
#: Least chi square (three axes) of a jump of the mean between two windows at which the level of a
#: source may change.  Source: one in 1e6 by chance.
JUMPS = 31.0
#: Bounds of the size of an effect, in multiples of its usual scale; uniform in the logarithm.
EFFECT_SIZES = (1e-2, 10.0)
#: The sizes over which a candidate is averaged where candidates are only ranked.
EFFECT_GRID = (0.01, 0.033, 0.1, 0.33, 1.0, 3.0)
#: Shifts in time, s, at which a logged cause is tried (positive: its log is delayed).  Source: the
#: averages of loggers; the motor current of a flight was logged with a delay of 0.32 s.
LOGGED_LATE_S = (-0.4, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4)
#: A column whose logger averaged it.
#: LOGGED_MEANS_S: averaging times, s, from which the search starts: a log at 1 to 5 Hz.
#: LOGGED_LOST: noise-to-signal power ratio of the Wiener filter that undoes the average: where the
#: average passes less power than this, the frequency stays suppressed.  Source: chosen.
LOGGED_MEANS_S, LOGGED_LOST = (0.2, 0.4, 0.8), 0.02
#: Lag, s, beyond which the clock of a column is searched: shorter lags are covered by
#: LOGGED_LATE_S.
ON_TIME_S = 1.0
#: Ordinary time, s, over which a logger averages.  It scales the form of a logged cause.  Source: a
#: battery monitor filters over a tenth of a second.
LOGGED_BLUR_S = 0.05
#: Prior odds, per axis, that iron has one particular magnetisation from before the recording.
#: Source: it is one of twenty values.
REMEMBERED = 1.0 / 20.0

#: Factor by which an effect's coefficient varies, in time or in attitude: standard deviation
#: relative to the coefficient.
#: VARIES: beyond this the coefficient is not constant, and the effect stands for another source.
#: VARIES_MOST: upper bound of the prior.
#: Source: in time, twelve effects that were present have 0.1 at most; wrong ones 0.36 to 1.3.
VARIES, VARIES_MOST = 0.25, 10.0

# --- noise --------------------------------------------------------------------------------------
#: Prior standard deviations of the logarithm of the noise power.
#: NOISE_STEP_CLEAN: of its change from octave to octave, for a sensor's own noise.
#: NOISE_STEP_REAL: the same in a model with the ordinary remainder.
#: NOISE_STEP_FREE: the same where only a delay and logged causes are in the model.
#: NOISE_TOP: of the highest octave about the filter's noise, and of the changes into and out of
#: narrow bands, which may have any power.
NOISE_STEP_CLEAN, NOISE_STEP_REAL, NOISE_STEP_FREE, NOISE_TOP = 0.25, 0.6, 1.5, 3.0
#: Where a fit of the noise starts: if an octave's log power exceeds the highest octave's by more
#: than this, the noise contains an effect that the model lacks, and no octave starts above the
#: highest octave's power.
LOUD = 2.0
#: Ratio of the noise power of a narrow band to that of its sides, from which on the band is an
#: unknown source and not coloured noise.
STANDS_OUT = 3.0
#: Bounds of the log power of each octave.
NOISE_RANGE = (-9.0, 9.0)
#: Degrees of freedom that are tried for the readings given their noise level, next to normal ones.
#: Source: 3 in a flight.
FREEDOMS = (3.0, 5.0, 8.0, 15.0)
#: LEVEL_S: width of the moving median that gives the noise level, s.
#: LEVELS: bounds of the noise power, relative to its median.
LEVEL_S, LEVELS = 4.0, (0.02, 50.0)
#: Largest number of octaves of the noise's spectrum.
BANDS = 7
#: Prior standard deviation of the log noise power of a magnetometer's axis, relative to the mean of
#: the three.  Source: up to 0.5 on eight of eleven untouched recordings; 0.6, 0.7, 1.2 on the
#: others.
AXES_DIFFER = 0.4
#: Number of cosines, scaled by the share of readings, below which an octave is left out of the fit
#: of noise along one direction.
DIRECTED_COSINES = 12
#: Powers of noise along one direction, relative to the other noise of the octave, over which it is
#: averaged.
DIRECTED_SHARES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
#: Nats from which on noise along one direction is an unknown source in a model with the ordinary
#: remainder.  Source: eleven untouched recordings have up to 106.
DIRECTED_REAL = 200.0
#: An effect and something unknown are one source if both act along one direction.
#: ONE_SOURCE: least share of the effect's contribution that has one direction.
#: SAME_DIRECTION: least cosine between the two directions: twenty degrees, as near as six of a
#: hundred random directions are.
ONE_SOURCE, SAME_DIRECTION = 0.8, 0.94
#: The same as ONE_SOURCE, of the contribution of something unknown.  It is smaller, because a free
#: process takes up noise along the other axes as well.
MAINLY_ONE = 0.5

#: Size of a free process by frame, gauss, up to which it is ordinary in a model with the remainder:
#: only a larger one is a finding.  Source: one in ten untouched recordings is beyond (same command
#: as ORDINARY).  Of an effect the size is `ordinary` in the library.
ORDINARY_COURSE: Mapping[str, float] = {"sensor": 0.017}

# --- point of linearisation -----------------------------------------------------------------------
#: Step to the model's maximum, in standard deviations of calibration and delay, below which the
#: linearisation has converged.
NEAR = 0.7
#: If the readings point from a delay back towards zero by more standard deviations than this, the
#: delay is not accepted.
POINTS_BACK = 2.0

# --- the decision -------------------------------------------------------------------------------
#: NAME_ODDS: log odds required of an effect; a false finding costs more than a missed one.
#: FORM_ODDS: log odds required of a factor by which an effect's coefficient varies.
NAME_ODDS, FORM_ODDS = 3.0, 3.0
#: Log odds required of anything unknown, because a free process explains all in the noise that its
#: law lacks.  Source: null simulations of other authors' generators had 4, 7, 9, 14 and 37 (slow
#: noise, host stamps that jitter); the others had less than 3.
UNKNOWN_ODDS = 12.0
#: Log odds required of an effect, a factor or anything unknown in a model with the ordinary
#: remainder: its laws are not exact, so a few nats show nothing.  Also the gain required of each
#: step of the delay, and of each correction of a column for its logger.
ODDS_REAL = 12.0
#: Prior odds that a wider effect takes exactly the form of a narrower one, which no reading can
#: tell apart: one cause may change all axes of a gyro alike, but more often they differ.
SAME_FORM = 0.5
#: Share of the evidence of something unknown that an effect in the same model has to have.  Source:
#: wrong effects had 0.25 and 0.46, one that was present 0.75.
BESIDE_UNKNOWN = 0.5
#: Least share, of the power of an effect with its form, that the effect's own columns have to hold.
#: Source: 0.92 (pulses that grow and fade) and 1.0; 0.29 for a square current taken for pulses.
OWN_PART = 0.5
#: Largest number of coefficients of a set that is fitted: the time grows with the cube.  Source:
#: the current and the added magnets of a flight were found with sets of up to 770.
WIDEST = 800
#: Nats.  The search does not expand a set whose score is more than ten times this below the best of
#: its class (with the remainder or without).
MOVE = 2.0
#: A filter is the cause of a delay if its share of the delay differs from 1 by less than this (or
#: by less than two standard deviations, if that is more).
NEARLY_ALL = 0.25
#: Prior odds that a delay is exactly half a step of the recording, because the gyro reports the
#: rate at an instant.
HALF_STEP = 0.1

# --- checks of an answer -------------------------------------------------------------------------
#: PARTS: number of parts of a recording, each predicted from the others.
#: STRETCH_S: length of the intervals that are dealt to the parts in turn, s: longer than a whitened
#: reading remembers, shorter than the passage of an object.
PARTS, STRETCH_S = 5, 2.0
#: Shares of a recording by which copies of a cause are shifted in time.  Simple fractions are
#: avoided, because a cause that recurs would coincide with itself.
SHIFTS = (0.236, 0.382, 0.472, 0.618, 0.764, 0.854)
#: Smallest detectable coefficient, in its standard deviations: it would have been found nine times
#: in ten.
SHOWN_AT = 6.5
#: Probability that any bin of any regime is outside its band if nothing is left.
BINS_OUTSIDE = 0.01
#: Longest time for which an object that is passed is visible, s: a noise level that rises while it
#: is passed is no fact about the noise.
PASSING_S = 30.0
#: A logged column is listed as moving with an unknown process if both conditions hold.
#: CHANCE: the p-value of the correlation is below this.
#: ALIKE: the absolute correlation is above this.
CHANCE, ALIKE = 0.2, 0.5

# --- simulations of the null model that an answer is compared with --------------------------------
# Smaller probabilities and more nats make the engine report less (`answer/null_simulations.py`).
#: If an answer without a finding has a smaller p-value than this, it is compared with simulations
#: all the same.  Source: chosen.
FAMILY_P = 1e-3
#: Evidence, nats, that simulations of the calibration alone show at least.  Source: of 300 null
#: simulations with five noise laws three have more, because of gyros whose bias walks.
ALONE_NATS = 9.0
#: Turn of the field in a step due to the gyro's noise, in standard deviations of a reading, from
#: which on an answer is compared with simulations.  Source: every real recording that was looked at
#: is below, and simulations that were found to differ from themselves are above.
CHANCE_LOUD = 2.0
#: The same for the bias of the calibration by the gyro's noise, in the calibration's own standard
#: deviations.
#: Source: 0.6 to 0.9 in simulations that hardly tilt, 0.2 at most in those that tilt, next to
#: nothing in real recordings except one that never moves.
CHANCE_BENT = 0.3
#: CHANCE_FITS: number of simulations to which the calibration alone is fitted.  If the recording's
#: own fit lies in the bands of these, nothing is reported.
#: CHANCE_COPIES: how many of these are diagnosed at most.
#: Source: chosen.
CHANCE_FITS, CHANCE_COPIES = 16, 5
#: Probability that a finding by chance is reported.
#: CHANCE_P: once all CHANCE_COPIES copies are diagnosed.
#: CHANCE_EARLY_P: at each earlier copy, for the remaining copies not to be diagnosed.
#: Source: evidence by chance has an exponential tail of unknown scale.  So it has to be four times
#: the largest of five copies, or 43 times the larger of two.
CHANCE_P, CHANCE_EARLY_P = 1 / 126, 1e-3

# --- checks of the residual ----------------------------------------------------------------------
#: Probability that any two-sided statistic of a further simulation is outside its band.
CHECKS_OUTSIDE = 0.01
#: Upper end of the band of a statistic that is a largest value, in standard deviations of 16 copies
#: above their mean (of their logarithms, where the largest of many differences is compared).
#: Source: Gumbel's law: one further value stays below in 999 of 1000 draws, so that ten statistics
#: share 1 %; drawn in tests/diagnosis/answer/test_predictive_checks.py.
CHECKS_LARGEST_REACH = 6.5
#: Power of the residual's means over segments, relative to that of noise, beyond which these means
#: are no noise and are left out of the noise law.  Source: chosen.
SLOW_BEYOND = 2.0
#: If the magnetometer's noise is at its floor and the mean square of the innovations is below this,
#: the assumed noise is not there, and the omnibus tests are not made.  Source: two of three axes
#: have the gyro's noise, so the mean square is 2 / 3 if the magnetometer has none.
ABSENT_NOISE = 0.8
#: p-value below which a test of the innovations has failed.  Source: chosen.
TEST_FAILED = 1e-4

# --- what a finding states -----------------------------------------------------------------------
#: Largest log odds from which a confidence is computed.  Source: chosen.
SUREST_ODDS = 30.0
#: Probability, given the place, above which an alternative effect is reported.  Source: chosen.
SMALLEST_SHARE = 0.01
#: Share of the power of one component's columns that may lie outside the span of another's, if the
#: other contains them; also for a logged cause, whether its shift in time matters.  Source: chosen.
COLUMNS_ALIKE = 1e-3
#: Prior standard deviation of each number of a setting, in units of the change from which its slope
#: is computed (`inference/search/near_settings.py`).  Source: chosen.
SETTING_OFF = 25.0
#: Number of settings among which one was chosen; they share the prior odds.
#: SOUGHT_SETTINGS: of a refined setting, at least (its square for both ends of an interval).
#: PROPOSED_ONSETS: of a step at an onset that the data proposed.
SOUGHT_SETTINGS, PROPOSED_ONSETS = 40, 200
#: Place of an effect.
#: ACTS_ON_AXIS: it acts on an axis whose contribution exceeds this share of the largest axis's.
#: ACTS_IN_STRETCH: it acts in a segment of time whose contribution exceeds this share of the
#: largest.
#: ACTS_EVERYWHERE: if these segments cover a larger share of the time, it acts everywhere.
ACTS_ON_AXIS, ACTS_IN_STRETCH, ACTS_EVERYWHERE = 0.2, 0.15, 0.6
#: Intervals in which a process in time departs from its usual level.
#: DEPARTED: distance from the usual level, as a share of the largest distance.
#: STILL_DEPARTED: an interval is extended as far as the departure exceeds so many standard
#: deviations.
DEPARTED, STILL_DEPARTED = 0.25, 2.0
#: Range that a quantity has to have for the residual to be tested by it.  The unit is in its name.
REGIME_RANGE: Mapping[str, float] = {
    "heading_deg": 60.0,
    "pitch_deg": 10.0,
    "roll_deg": 10.0,
    "rate_rad_s": 0.05,
}
#: Horizontal share of the field.
#: LEVEL_SHARE: assumed where no accelerometer shows what is horizontal: that at 60 degrees of dip.
#: LEVEL_LEAST_SHARE: the least that is used to convert an added field to a change of heading.
LEVEL_SHARE, LEVEL_LEAST_SHARE = 0.5, 0.1

# --- a narrow band -------------------------------------------------------------------------------
#: Power of a band, relative to both sides.  Source: noise of a few coefficients is not so steep.
BAND_STANDS_OUT = 3.0
#: Lower limit of such a band, Hz: below are processes in time and the rates of the motion itself.
BAND_LOWEST_HZ = 0.75
#: Share of the band's power along the field, below which the source is an error of the gyro, which
#: turns the field and does not change its size; for others it is about a third.
BAND_ALONG = 0.1

# --- a specification that is compared with the recording ------------------------------------------
#: Factors between the noise in a specification and the scatter of successive readings.
#: NOISE_AGREES: beyond it a note says so; slow noise scatters less, a shaken magnetometer more.
#: NOISE_IMPOSSIBLE: the magnetometer's noise is not used if the readings scatter by more than this.
#: Source: chosen; with a hundredth of the scatter no calibration came near the readings.
NOISE_AGREES, NOISE_IMPOSSIBLE = 5.0, 30.0

# --- a simulation that is compared with the recording ---------------------------------------------
#: Time that both have to have in common, s.  Source: chosen.
OVERLAP_S = 20.0
#: Correlation of the two gyros, above which the motion is the same; another motion is far below.
SAME_MOTION = 0.8
#: Standard deviation of what an axis turns without the others, as a share of the rates of all axes,
#: above which it is judged by itself.  Source: chosen; cross-axis errors are a few per cent.
TURNS_BY_ITSELF = 0.02
#: Standard deviations: if all parameters differ by less, two effects are the same.  Source: chosen.
SAME_SIGMAS = 4.0
#: Deviation of the difference of what two effects add over time, as a share of what one adds, below
#: which they act at the same times, beyond the uncertainty of their sizes; the same of the time
#: series of two unknown causes, which a free process draws.  Source: chosen; a step in the middle
#: of 200 s that comes 3 s later differs by 0.25.
SAME_COURSE, SAME_UNKNOWN = 0.25, 0.5

# --- the calibration -----------------------------------------------------------------------------
#: Prior standard deviations of the 11 parameters: 5 of soft iron about the identity, 3 of hard iron
#: about 0 (gauss), 3 of gyro bias (rad/s).  Source: they are a thousand times too wide to matter
#: where the motion determines a parameter at all.
CALIBRATION_DEVIATION = np.array([0.15] * 5 + [0.5] * 3 + [0.03] * 3)
CALIBRATION_DEVIATION.flags.writeable = False
#: Scatter of the field over its size, above which the field determines the iron; below, the prior
#: of the iron is narrowed in proportion, as a sensor that never turns does not show iron.
IRON_TURNED = 0.1
#: Number of readings per independent one, from which on the deviations of the prior are divided by
#: its square root.
REPEATED = 3.0
#: Prior standard deviation of the gyro bias about the mean of the gyro at rest, rad/s, if the field
#: shows that it rests.
STILL_BIAS_RAD_S = 1e-3
#: Fit of the centre of a sphere.
#: SPHERE_ROWS: number of independent rows that a recording counts for.
#: SPHERE_OFF: standard deviation of the squared field from that of a sphere, of its mean square.
#: Source: chosen.
SPHERE_ROWS, SPHERE_OFF = 100, 0.1
#: Least number of steps for a fit.  Source: chosen.
FIT_STEPS = 15
#: Prior standard deviation of the field at the first row of a gap-free run that has no reading, in
#: any direction and relative to its size.
UNSEEN_FIELD = 0.5

# --- levels of noise -----------------------------------------------------------------------------
#: Largest noise of the gyro, in multiples of the noise that the differences of its readings show.
#: Source: without a limit the noise absorbs every drift of the gyro.
GYRO_NOISE_CAP = 1.5
#: Prior standard deviation of the logarithm of the gyro's noise about that of its differences.
#: GYRO_NOISE_TRUST: in either direction.
#: SHAKEN_TRUST: below it, if the differences are mostly motion.
GYRO_NOISE_TRUST, SHAKEN_TRUST = 0.25, 1.5
#: Largest random walk of the gyro bias, rad/s per square root of a second, that counts as noise: 50
#: deg/h after 400 s.
WALK_CAP_RAD_S_SQRT_S = 1.2e-5
#: Nats that a walk of the bias has to gain.  Source: two standard deviations are not enough.
WALK_NATS = 6.0
#: Noise of the magnetometer, gauss, if its readings are too far apart to be compared.
USUAL_MAG_GAUSS = 1e-3
#: Least noise of magnetometer (gauss) and gyro (rad/s).  Source: below the magnetometer's, what the
#: linear filter leaves out would exceed the noise.
FLOOR_MAG_GAUSS, FLOOR_GYRO_RAD_S = 2e-5, 1e-5

# --- a higher noise level for a while -------------------------------------------------------------
#: Log likelihood ratio, nats, required of a change of level against none.  Source: of 400 s, with
#: 20,000 possible intervals, one recording of one level in ten thousand shows such a change.
LOUDER_NATS = 17.0
#: Least ratio of the two variances.  Source: chosen.
LOUDER_RATIO = 1.3
#: Standard deviations at which a difference is clipped, so that a single outlier is no higher
#: level.
LOUDER_OUTLIER = 3.0
#: BURST_SHARE: share of the recording that a single burst may last; longer, the level changed.
#: BURST_FILLED: several intervals are bursts if they fill less than this of the time from the first
#: to the last; otherwise the level is high throughout.
#: Source: chosen.
BURST_SHARE, BURST_FILLED = 0.4, 0.7
#: Correlation of successive differences, above which they are no noise.  Source: -1/2 if white.
NOISE_OPPOSED = -0.3
#: Ratio of the variance to that of the specification, from which on it is too high.  Source:
#: chosen.
LEVEL_RATIO = 1.15

# --- what a gyro's readings are ------------------------------------------------------------------
#: CONING_QUIETEST_RAD_S: rad/s, noise per sample that every gyro exceeds.
#: CONING_LOST: if the summed square of the coning (less its mean) is below this multiple of the
#: square of that noise, no gyro shows it, and no correction is made.
CONING_QUIETEST_RAD_S, CONING_LOST = 1e-4, 10.0
#: CONING_RESOLVED: standard deviations between no coning and all of it that the estimate has to
#: resolve.
#: CONING_OFF: standard deviations beyond all of it (with a margin of half), from which on the
#: readings show something else.
CONING_RESOLVED, CONING_OFF = 3.0, 4.0
#: Root mean square change of the rate from sample to sample, relative to the rate, beyond which the
#: samples do not resolve the motion, and products of neighbours show nothing of the time between.
CONING_UNRESOLVED = 0.5
#: If a tenth of the seconds have less noise than this multiple of the usual level, the differences
#: of the gyro's readings are mostly motion (the gyro is shaken): noise has the same level in every
#: second.  Source: eleven of twelve real recordings have a tenth of their seconds below 0.67, and
#: none of 120 simulated motions has it below 0.76.
SHAKEN_STEADY = 0.7
#: SHAKEN_WRONG: if the fitted noise of the magnetometer exceeds this multiple of that of its
#: differences, something else is wrong, and the gyro's noise is left as it was.
#: SHAKEN_QUIETER: if the gyro's noise is below this multiple of that of its differences, the
#: differences are motion.
SHAKEN_WRONG, SHAKEN_QUIETER = 1.5, 0.7

# --- a gyro that stands still --------------------------------------------------------------------
#: 1 - |mean direction| of the field in the sensor, below which the field hardly turns: directions
#: within about 5 degrees.
REST_SPREAD = 4e-3
#: Random walk of an ordinary gyro's bias, rad/s per square root of a second.  Source: 20 deg/h in
#: 400 s is noise and is not reported.
ORDINARY_WALK_RAD_S_SQRT_S = 5e-6
#: Effects that may move the bias of a gyro at rest, and their log prior odds.  Source: a recording
#: seldom begins when the power comes on, as a start-up needs.
REST_CAUSES: Mapping[str, float] = {
    "gyro_bias_temperature": 0.0,
    "gyro_bias_drift": 0.0,
    "gyro_bias_step": 0.0,
    "gyro_startup": -5.0,
}
#: Prior standard deviation of the constant bias, rad/s.
REST_BIAS_RAD_S = 1e-2
#: REST_S: number of seconds at rest that are required.
#: REST_SCATTER: largest scatter within a second at rest, relative to the median of all seconds.
#: REST_AWAY_RAD_S: largest distance of a second's mean rate from the median, rad/s.
REST_S, REST_SCATTER, REST_AWAY_RAD_S = 60, 3.0, 0.01
#: Nats required of a cause of the bias over a random walk alone, each candidate averaged over its
#: sizes: odds of 50 to 1.
REST_NATS = 4.0
#: Change of the bias, in standard deviations of an ordinary walk, below which it is one.
REST_LARGE = 3.0
#: Probability, above which an alternative cause is reported.  Source: chosen.
REST_SMALLEST_SHARE = 0.005
#: Share of the integral of the gyro's rate that the field follows, beyond which the vehicle does
#: turn.
REST_TURNS = 0.3

# --- a delay -------------------------------------------------------------------------------------
#: STEPS_ALIKE: steps of a recording are alike if they differ from the median by less than this
#: share.
#: STEPS_ALIKE_SHARE: least share of the steps that have to be alike for a regular step to exist.
STEPS_ALIKE, STEPS_ALIKE_SHARE = 0.25, 0.95
#: If a delay differs from half a step by less than this share of it, it is half a step and the
#: gyro's alone.
HALF_STEP_WITHIN = 0.1
#: Longest ordinary delay of a magnetometer, s.  Readings nearer than this to the beginning of a run
#: are left out.  Source: see ORDINARY_LAG_S.
BEGIN_S = 0.1
#: Share of a run from which on those readings are too many to be left out.  Source: chosen.
BEGIN_SHARE = 0.1

# --- logged columns ------------------------------------------------------------------------------
#: Longest gap in a column that is interpolated, s.  Source: a column of 1 Hz next to samples of
#: 25 Hz has such gaps; a failed logger has longer ones.
COLUMN_GAP_S = 2.0
#: Share of rows without a value, beyond which a column is left out.  Source: chosen.
COLUMN_MISSING = 0.98
#: The same for a column with longer gaps, of which only the rows with values are used: with more
#: gaps than values it shows too little.
COLUMN_HOLES = 0.5
#: Rows for which a column of 0 and 1 stays on, beyond which it is a switch; otherwise it is a train
#: of pulses.
SWITCH_ROWS = 4
#: Longest time between new values of a column for it to be held between them, s: what changes more
#: seldom is a level.
COLUMN_HELD_S = 5.0
#: COLUMN_REGULAR: least share of the values of a held column that come one period after the last.
#: COLUMN_MISS: how far from one period they may come, as a share of it.
COLUMN_REGULAR, COLUMN_MISS = 0.6, 0.25
#: Least number of new values that shows how a column was logged.
COLUMN_UPDATES = 20
#: Standard deviations by which the high frequencies of a column may depart from a flat spectrum,
#: and from a Gaussian fourth moment, to be noise of the logger.
COLUMN_NOISE_SCATTER = 3.0
#: Least share of a column's variance that remains after this noise was filtered out.
COLUMN_COURSE = 0.8
#: A column whose clock may be off is one that explains an unknown process at a shifted time.
#: CLOCK_SHARE: least share of the process that it explains.
#: CLOCK_SURE: how many times the root mean square at all other shifts its correlation must be
#: (both as the inverse hyperbolic tangent).
CLOCK_SHARE, CLOCK_SURE = 0.5, 4.0
#: Nats required of a column's corrected clock over the column as logged, and of a drift of the
#: clock over a constant lag.
CLOCK_NATS = 30.0
#: Lag of a column, s, below which its clock has no error, unless it drifts.
CLOCK_SMALLEST_S = 0.1

# --- data quality: confidence of a fact ----------------------------------------------------------
#: Confidence of a fact that is counted or compared: a limit, coarse steps, time stamps, axes,
#: units.
SURE_OF_READINGS = 0.99
#: The same for lost turns and a higher noise level, which are found against noise.
SURE_OF_NOISE = 0.98
#: The same for doubled samples, for the rate of one clock against another, and for time that runs
#: backwards, in this order.
SURE_OF_DOUBLED, SURE_OF_CLOCK, SURE_BACKWARDS = 0.95, 0.95, 0.9

# --- data quality: time stamps -------------------------------------------------------------------
#: Share of missing samples from which on they are reported.  Source: chosen.
MISSING_SHARE = 1e-3
#: Scatter of the stamps as a share of the step.  From this on it is jitter, unless the field shows
#: that the steps are as stamped; below, only if the field shows that the steps are equal.
JITTER_SHARE = 0.03
#: Correlation of neighbouring steps, below which their scatter is jitter.  Source: -1/2 for
#: delayed stamps.
JITTER_OPPOSED = -0.25
#: Nats that are needed to show that the steps are as stamped, or that they are equal.
STAMPED_NATS = 5.0
#: Changes of the field that are more standard deviations off than this are left out of that test.
STAMPED_OUTLIER = 5.0
#: Relative rate between two clocks, from which on it is reported.
CLOCK_RATE = 2e-4
#: BREAK_BELIEVED_S: length of a gap, s, up to which it is always believed.  A gap that is longer
#: than this and than all recorded time is a jump of the clock.
#: BREAK_LEFT_S: length of the gap that replaces such a jump, s.
BREAK_BELIEVED_S, BREAK_LEFT_S = 60.0, 10.0
#: Limits from which on a fact about time stamps is a finding and no note.
#: MISSING_FINDING_SHARE: share of missing samples.
#: JITTER_FINDING_SHARE: scatter of the stamps as a share of the step.
#: Source: with correct stamps they are part of the recording and no difference from its simulation,
#: which has the same stamps, unless there are so many.
MISSING_FINDING_SHARE, JITTER_FINDING_SHARE = 0.02, 0.05

# --- data quality: lost turns --------------------------------------------------------------------
# A turn is lost if a gyro sample is missing and the stamps do not show it: the innovation of the
# field then jumps by the turn of whole steps.
#: Averages of the innovation before and after a jump, tried in this order.  Each is a number of
#: samples, and the turn of one step that it needs, in standard deviations of such a mean.  Source:
#: over more samples fewer jumps occur by chance.
LOST_TURN_AVERAGED = ((3, 7.0), (12, 5.0))
#: Distance of a jump from a whole number of steps, at most, in steps.
LOST_TURN_NEAR = 0.3
#: Least number of jumps.  Source: of 18 untouched recordings and 240 simulations (eight draws of
#: two worlds) none without lost samples has so many that also reach the nats below.
LOST_TURNS_FEWEST = 3
#: Nats by which the jumps are whole steps rather than noise.  Source: true ones have 160 and more.
LOST_TURNS_NATS = 12.0
#: Nats per jump, in the mean.  Source: a gyro that reads 3 % too little is ahead all the time, and
#: on a path through a room 13 jumps had 2.4 each; lost turns have 3.8 and more.
LOST_TURN_EACH_NATS = 3.0
#: JUMP_CLEAR: size of a jump, in standard deviations of a mean, that no noise reaches.
#: JUMP_ACROSS: share of such a jump across the turn, beyond which no lost turn causes it.
JUMP_CLEAR, JUMP_ACROSS = 8.0, 0.5
#: Size of a jump, in standard deviations, beyond which many turns in a row were lost, too many to
#: count.
JUMP_LONG = 30.0
#: Nats required of a single lost turn beyond log of the ratio of rows to lost turns.  Source:
#: chosen.
LOST_TURN_BEYOND_SHARE_NATS = 3.0
#: Least number of rows, in multiples of those averaged: otherwise the spread of the means is not
#: known.
LOST_TURN_ROWS = 10
#: Cost, nats, of each further step of a gap: one gap in four is longer by one step.
LONGER_GAP_NATS = log(4.0)
#: Largest chi square (two axes) of a jump's part across the turn.  Source: one in 400 is beyond.
JUMP_ACROSS_CHI2 = 12.0
#: Cost, nats, of taking back a step that was counted twice.  Source: one in twenty is, and it must
#: be more certain than chance.
COUNTED_TWICE_NATS = 6.0
#: Largest evidence, nats, of one jump: several have to agree, not a field that jumps once.
JUMP_MOST_NATS = 6.0
#: Size of a jump, in steps, in means over rows that contain only a part of it.
#: LOST_TURN_PART: of a lost turn.
#: OTHER_PARTS: sizes of jumps that are no lost turns, which have to explain the data less well.
LOST_TURN_PART, OTHER_PARTS = 0.7, (0.3, 1.4)
#: LOST_TURNS_TOGETHER_NATS: nats required of all jumps together, for lost turns.
#: LOST_TURNS_BACKWARD: weight with which the nats of backward jumps are subtracted.
#: Source: 3.5 is the most of 370 recordings without lost turns.
LOST_TURNS_TOGETHER_NATS, LOST_TURNS_BACKWARD = 12.0, 3.0

# --- data quality: limits and steps of the numbers -----------------------------------------------
#: Least number and least share of samples at a limit of a sensor.  Source: chosen.
LIMIT_FEWEST, LIMIT_SHARE = 8, 1e-3
#: Samples at a limit, in multiples of those at each number just inside it, at least.  Source:
#: chosen.
LIMIT_PILED = 6.0
#: Distance from a limit, within which readings are biased and not used: the smaller of so many
#: noise levels and of this share of the limit.
LIMIT_MARGIN_NOISE, LIMIT_MARGIN_SHARE = 5.0, 0.02
#: Steps of coarse numbers: the numbers just inside a limit are taken from at least so far.  Also
#: the largest usual change of coarse numbers, in steps; a stuck sensor jumps by more.
LIMIT_TOP_STEPS = 1.5
#: Width of a cluster of readings at a limit, in noise levels, if noise is added behind the limit.
LIMIT_HEAP_NOISE = 7.0
#: LIMIT_SIDES: least number of sides of axes that end at a shared limit.
#: LIMIT_ALIKE: largest difference of their limits, as a share.
LIMIT_SIDES, LIMIT_ALIKE = 3, 0.01
#: Least share of distinct readings for numbers to be fine.
FINE_NUMBERS = 0.5
#: Step of the numbers, in standard deviations of the noise, beyond which they are coarse.
COARSE_STEPS = 2.0

# --- data quality: axes and units ----------------------------------------------------------------
# The cost of a frame (axes and signs of the gyro) is the power of the field's changes that the
# rates in this frame leave, relative to that without any motion.
#: Largest cost of the best frame.  Source: chosen.
FRAME_EXPLAINED = 0.6
#: The frame as recorded is wrong if its cost is that many times the best one's, and the best one is
#: more probable by that many nats.  Source: chosen.
FRAME_BETTER, FRAME_NATS = 1.5, 20.0
#: Ratio of costs up to which the frame as recorded is kept: the fit leaves out soft iron, which may
#: favour another frame.
FRAME_BENT = 3.0
#: FAST_RAD_S: rate, rad/s, that no vehicle has for a tenth of the time.
#: DEGREES_NEAR: factor from the ratio of degrees to radians, within which the rates are in degrees.
FAST_RAD_S, DEGREES_NEAR = 3.0, 1.1
#: Factor from a unit's own ratio, within which the gyro has that unit.
SAME_UNIT = 1.2
#: Factor of the gyro's scale, beyond which it has another unit.
OTHER_UNIT = 2.0
#: Largest share of noise in the variance of the rates for which a factor that belongs to no unit is
#: reported.
RATES_NOISE_SHARE = 0.05
#: Cost below which a part of a recording is explained.  Source: chosen.
PART_EXPLAINED = 0.1
#: GRAVITY_EXPLAINED: largest cost of the best frame of the gyro relative to the accelerometer, and
#: of a free linear map between gyro and magnetometer.
#: GRAVITY_BETTER: least cost of the second-best frame of the accelerometer, relative to the best.
#: Source: chosen.
GRAVITY_EXPLAINED, GRAVITY_BETTER = 0.5, 1.5
#: A fit of an ellipsoid needs more readings than this.  Source: chosen.
ELLIPSOID_READINGS = 100
#: Sine of the inclination that decides whether the field points up or down.
STEEP = 0.15
#: Angle, degrees, from every quarter turn, from which on a sensor is mounted askew; less is a
#: misalignment.
ASKEW_DEG = 10.0
#: A map is a rotation that is no quarter turn if both hold.
#: ASKEW_ROUND: its largest singular value over its smallest is at most this.
#: ASKEW_TOLD: its angle from the quarter turn is at least so many standard deviations.
ASKEW_ROUND, ASKEW_TOLD = 1.25, 4.0
#: Cosine between the axis of a rotation and an axis of the sensor, beyond which the text names that
#: axis.
ASKEW_ABOUT = 0.97

# --- data quality: stuck, held and doubled readings ----------------------------------------------
#: A reading should certainly have changed if the expected change exceeds both: this share of the
#: field, and so many noise levels.  Source: chosen.
STUCK_MOVED_SHARE, STUCK_MOVED_NOISE = 0.1, 8.0
#: The same in steps of coarse numbers, which repeat where the sensor turns least.
STUCK_MOVED_STEPS = 20.0
#: Turn by the gyro, rad, beyond which a magnetometer that never changed is stuck.  Source: chosen.
STUCK_TURNED_RAD = 0.3
#: Rows that one axis, or the gyro, has to repeat.  Source: chosen.
AXIS_STUCK_ROWS = 8
#: An axis of the gyro that never changes is dead if the field shows a turn about it.
#: DEAD_AXIS_SHOWN: share of the unexplained changes of the field that this turn explains, at least.
#: DEAD_AXIS_NOISE: scatter of these changes in noise levels, at least.
#: DEAD_AXIS_TURNED_RAD: angle of the turn, rad, at least.
DEAD_AXIS_SHOWN, DEAD_AXIS_NOISE, DEAD_AXIS_TURNED_RAD = 0.5, 3.0, 0.1
#: Range of the usual field, in the recording's unit: it holds for every unit from tesla to
#: nanotesla.
FIELD_READINGS = (1e-6, 1e6)
#: IMPOSSIBLE_FIELD: readings beyond so many times the usual field are left out.
#: IMPOSSIBLE_RATE: so are rates beyond so many times the 99.9 % quantile of the rates, if they also
#: exceed the next constant.
#: IMPOSSIBLE_RAD_S: rad/s, a rate that is quick in any unit.
IMPOSSIBLE_FIELD, IMPOSSIBLE_RATE, IMPOSSIBLE_RAD_S = 100.0, 100.0, 40.0
#: Length of a stuck reading: at least so many rows, and so many times the usual time from one new
#: reading to the next.
STUCK_ROWS, STUCK_LONGER = 8, 5.0
#: Noise levels by which the field has to turn during the repetition.  Source: chosen.
STUCK_TURNED_NOISE = 8.0
#: Total time, s, from which on a stuck magnetometer is a finding.  Source: a reading held for less
#: was delayed and is not used; that is no fault of the sensor unless it recurs.
STUCK_FINDING_S = 0.25
#: Steps of coarse numbers by which the field has to turn for a new reading to be expected.
HELD_STEPS = 3.0
#: Least number of repeated readings.  Source: chosen.
HELD_REPEATS = 20
#: Share of repeated readings while the sensor turns, relative to the whole recording, at least.
#: Source: coarse numbers change while it turns, and a held reading does not.
HELD_MOVING_SHARE = 0.7
#: Time between new readings of a magnetometer, s, below which it has an ordinary rate of its own.
#: Source: 202 readings a second in all recordings of BROAD, rows at 286.
HELD_ORDINARY_S = 0.01
#: Variance of the time from one new reading to the next, relative to chance, below which they come
#: at regular intervals.
HELD_CLOCKWORK = 0.3
#: That variance is computed from sums of such times.
#: HELD_FEWEST_SUMS: least number of sums.
#: HELD_MOST_VARIANCES: largest square that one sum counts with, in variances of chance.
#: Source: chosen.
HELD_FEWEST_SUMS, HELD_MOST_VARIANCES = 15, 4.0
#: Least share of doubled samples.  Source: chosen.
DOUBLED_SHARE = 2e-3
#: Least number of doubled samples, in multiples of what chance gives if each sensor repeats by
#: itself.  Source: with a slow turn it is nearly two.
DOUBLED_BEYOND_CHANCE = 5.0
#: Noise levels of the gyro beyond which the sensor turns.  Source: chosen.
DOUBLED_TURNING_NOISE = 5.0
