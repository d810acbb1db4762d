"""What is told beside a loud gyro, held against what the model alone shows there by chance.

The filter takes the measured rates for those that turn the field.  Where the gyro's noise turns it
by more from one reading to the next than the magnetometer scatters, that noise is in every column
and every evidence (a regression on noisy regressors), and the law by which evidence is judged
elsewhere is not the one it follows.  Where the motion hardly shows the calibration far less noise
does the same: a sensor that turns slowly and is hardly tilted has the scale of its vertical axis
from turns that are as small as the noise, and calibrations a tenth of a gauss off are likelier,
with a mount that gives and iron that lags for the rest.

So the law of what is told is measured (a parametric bootstrap): the fitted
calibration alone is simulated along the recording's own motion, with its stamps, its columns and
the noise that was fitted.  First the calibration is fitted to each copy as it was to the recording:
where what it leaves of the recording is like what it leaves of the copies, the two agree, whatever
else is told.  Where it is not, the same question is asked of the first copies, and what is told
must be far beyond what is told of these.  Calibration and noise are those of the fit without
any name or beside the names, whose magnetometer is the quieter one: what a missing name leaves is
no noise, and louder copies show more by chance.

The motion is what the gyro's readings are expected to be without their noise
(`time_series.denoised`), held by field and accelerometer.  Nothing is different in a copy, so
whatever is told of one is chance.
Evidence that is too large by an unknown factor has an exponential tail of unknown scale: it is t
times the largest of n such with the chance n! / ((1 + t) ... (n + t)), whatever that scale: 1 in
126 for four times the largest of five.  Of what is far beyond the first copies the others need not
be asked: 1 in 1000 is enough at each of them (43 times the larger of two), and with all of these
looks about 1 in 94 of what chance makes is told.  A copy of which nothing is told counts with what
is kept untold of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.answer.diagnosis import Check, Diagnosis, Finding, Unexplained
from ahrsd.diagnosis.answer.predictive_checks import beside_refitted, checks, usual_noise
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem, model_at_rate, problem_of
from ahrsd.diagnosis.data_quality.preparation import would_have_shown
from ahrsd.diagnosis.effects.effect import Readings
from ahrsd.diagnosis.innovation_filter.context import (
    UnfittedMotion,
    attitude,
    build_context,
    smoothed_rate,
)
from ahrsd.diagnosis.innovation_filter.innovation import (
    carried_orientation,
    filtered_for_regression,
    nominal_motion,
    nuisance_columns,
    sensitivities,
)
from ahrsd.diagnosis.model import Noise, NullModel
from ahrsd.diagnosis.repaired_model import forward
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

LOUD = "the gyro's noise is louder than the magnetometer's"
NOT_DIAGNOSED = "a simulation of the model alone with this noise cannot be diagnosed"
BENT = "the gyro's noise bends the calibration, which this motion hardly shows"


@dataclass(frozen=True, slots=True, eq=False)
class Answered:
    """An answer, with the calibration that was fitted before any name.

    problem, start: None where nothing was fitted
    """

    found: Diagnosis
    problem: Problem | None = None
    start: NullFit | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Alone:
    """How the fit of the calibration alone compares with fits of simulations of it.

    checks:  empty where fewer than half of the simulations could be fitted
    p_value: of the recording's fit among those of the simulations
    """

    checks: dict[str, Check]
    p_value: float
    copies: int
    fitted: int

    @staticmethod
    def of(problem: Problem, start: NullFit, copies: Sequence[Track]) -> Alone:
        """Of the recording's fit, and of copies, to which a calibration is fitted as to it."""
        fits = [fit for one in copies if (fit := _fit_of(one, problem)) is not None]
        enough = 2 * len(fits) >= len(copies)
        checked, p_value = beside_refitted(start, fits) if enough else ({}, 1.0)
        return Alone(checked, p_value, len(copies), len(fits))

    @property
    def undecided(self) -> str | None:
        """Why the recording's fit cannot be compared with theirs; None where it can."""
        if self.checks:
            return None
        return (
            f"of {self.copies} simulations of the model alone with this noise only {self.fitted} "
            "can be fitted"
        )

    @property
    def differs(self) -> bool:
        """Whether the recording's fit leaves what those of simulations do not."""
        return any(not check.inside_after for check in self.checks.values())


def beyond_chance(track: Track, ask: Callable[[Track], Answered]) -> Diagnosis:
    """The answer about a track; beside a loud gyro only what is clearly beyond chance is told.

    ask: answers about a track.  Where the gyro is loud, by itself or for this motion, and something
    is told or a check fails, the calibration is fitted to `CHANCE_FITS` copies (seeds 0, 1 and so
    on); where the recording's fit is not like theirs, `CHANCE_COPIES` of these at most are asked
    about as well
    """
    first = ask(track)
    found, problem, start = first.found, first.problem, first.start
    told = max(_told(found), default=0.0)
    seen = told > 0.0 or found.failed_checks or found.p_value < priors.FAMILY_P
    if problem is None or start is None or not seen:
        return found
    recorded = problem.recorded
    models = [model_at_rate(start.model, problem), *([found.model] if found.model else [])]
    model = max(models, key=lambda one: loudness(recorded, one))
    loud = loudness(recorded, model) >= priors.CHANCE_LOUD
    if not loud and bent(start) < priors.CHANCE_BENT:
        return found
    why = LOUD if loud else BENT
    truth = motion_of(recorded, model)
    for noise in _noises_of(model, start):
        copies = [copy_of(recorded, truth, noise, seed) for seed in range(priors.CHANCE_FITS)]
        alone = Alone.of(problem, start, copies)
        if not alone.differs:
            break
    if not alone.differs:
        return _agreeing(
            first, problem, start, alone, _alike(why, found, told, alone), alone.undecided
        )
    if told <= 0.0:
        return replace(found, posterior_predictive=alone.checks)
    shown, bound = _shown(copies[: priors.CHANCE_COPIES], ask, found)
    said = _words(why, found, told, shown, bound)
    if told <= bound:
        untold = None if np.isfinite(bound) else NOT_DIAGNOSED
        return _agreeing(first, problem, start, alone, said, untold)
    weak = [one.effect for one in found.findings if _fitted(one) and one.evidence_nats <= bound]
    said = f"{said}, so that this is doubted: {', '.join(weak)}" if weak else said
    return replace(found, notes=(*found.notes, said))


def loudness(track: Track, model: NullModel) -> float:
    """By how much the gyro's noise turns the field in a step, in the magnetometer's deviations."""
    field_b = np.linalg.solve(model.soft_iron, (track.mag_b_gauss - model.hard_iron_gauss).T)
    size = float(np.nanmedian(np.linalg.norm(field_b, axis=0)))
    return size * model.sigma_gyro_rad_s * track.step_s / model.sigma_mag_gauss


def bent(start: NullFit) -> float:
    """How far the noise in the columns moves a calibration, in the deviations to which it is known.

    The fit follows the slopes of the innovations, in which the gyro's noise is; slopes of the
    smoothed motion have none, and what they say otherwise at the fit is what that noise does.
    """
    done = start.filtered
    smooth = filtered_for_regression(done, start.context().rate_b_rad_s)
    noisy, clean = (sensitivities(one, nuisance_columns(one)) for one in (done, smooth))
    score = np.einsum("nia,ni->a", noisy - clean, done.whitened)
    known = start.covariance[: len(score), : len(score)]
    return float(np.sqrt(max(score @ known @ score, 0.0)))


def motion_of(track: Track, model: NullModel) -> Readings:
    """Noise-free readings of a calibration along a track's motion without the gyro's noise."""
    seen = nominal_motion(track, model)
    context = build_context(track, UnfittedMotion(seen))
    rate = _without_noise(track, model)
    quiet = replace(seen, orientation=carried_orientation(track, rate))
    R_nb, levelled = attitude(track, quiet)
    along = replace(
        context, R_nb=R_nb, world_levelled=levelled, rate_b_rad_s=rate, field_b=seen.nominal_b
    )
    return forward.noise_free_readings(along)


def _noises_of(model: NullModel, start: NullFit) -> list[Noise]:
    """The noise of a model; where the magnetometer has less than a fit believes at least, how much
    is not known: what the innovations say, and none."""
    noise = forward.model_noise(model)
    if start.model.sigma_mag_gauss > priors.FLOOR_MAG_GAUSS:
        return [noise]
    less = min(1.0, usual_noise(start).mag_gauss / forward.model_noise(start.model).mag_gauss)
    return [replace(noise, mag_gauss=less * noise.mag_gauss), replace(noise, mag_gauss=0.0)]


def copy_of(track: Track, truth: Readings, noise: Noise, seed: int) -> Track:
    """The track with other readings: those of the truth with noise."""
    made = forward.simulate_readings(truth, (), noise, seed)
    read = np.isfinite(track.mag_b_gauss)
    mag = np.where(read, made.mag_b_gauss, track.mag_b_gauss)
    return replace(track, mag_b_gauss=mag, gyro_b_rad_s=made.gyro_b_rad_s)


def _without_noise(track: Track, model: NullModel) -> Array:
    """(N, 3) rates as they are expected to be; in runs too short for a spectrum, smoothed."""
    rate = track.gyro_b_rad_s - model.gyro_bias_rad_s
    runs = track.runs or (slice(0, len(track)),)
    out = smoothed_rate(rate, runs, track.step_s, model.sigma_gyro_rad_s)
    for run in runs:
        if run.stop - run.start >= time_series.SPECTRUM_ROWS:
            out[run] = time_series.wiener_filter(rate[run])
    return out


def _fitted(one: Finding) -> bool:
    """Whether it rests on a fit; what was counted in the readings is no matter of noise."""
    return one.term is not None


def _fit_of(copy: Track, problem: Problem) -> NullFit | None:
    """The calibration alone fitted to a copy, as it was to the recording; None where it cannot."""
    try:
        made, cold = problem_of(copy, problem.spec)
        return fit_null(made.track, made.spec, cold, walk=False)
    except (np.linalg.LinAlgError, ValueError):
        return None


def _alike(why: str, found: Diagnosis, told: float, alone: Alone) -> str:
    """What was seen, and why it is not told."""
    seen = f"{why}: {_names(found)} is worth {told:.0f} nats here" if told > 0.0 else why
    if (untold := alone.undecided) is not None:
        return f"{seen}; {untold}"
    return (
        f"{seen}; {alone.fitted} simulations of the model alone with this noise (seeds 0 to "
        f"{alone.copies - 1}), fitted as the recording was, look like it, so that nothing is told"
    )


def _names(found: Diagnosis) -> str:
    """What is told and rests on a fit."""
    names = [one.effect for one in found.findings if _fitted(one)]
    return ", ".join([*names, *(["something unknown"] if found.unexplained.detected else [])])


def _told(found: Diagnosis) -> list[float]:
    """The evidence of each that is told and was fitted, nats."""
    nats = [one.evidence_nats for one in found.findings if _fitted(one)]
    left = found.unexplained
    return [*nats, *([left.evidence_nats] if left.detected else [])]


def times_beyond(copies: int, chance: float) -> float:
    """How many times the largest of so many must be surpassed for so small a chance."""
    from scipy.optimize import brentq  # dear to import, and seldom needed

    orders = np.arange(1, copies + 1)

    def too_likely(log_times: float) -> float:
        return float(np.sum(np.log1p(np.exp(log_times) / orders)) + np.log(chance))

    return float(np.exp(brentq(too_likely, -20.0, -np.log(chance) + 1.0)))


def _shown(
    copies: Sequence[Track], ask: Callable[[Track], Answered], found: Diagnosis
) -> tuple[list[float], float]:
    """What copies show, nats, until that decides; and up to how many nats it may be chance."""
    told, last = _told(found), times_beyond(len(copies), priors.CHANCE_P)
    largest, shown = priors.ALONE_NATS, list[float]()
    for count, copy in enumerate(copies[:-1], 1):
        shown.append(_shown_by(copy, ask))
        largest = max(largest, shown[-1])
        early = largest * times_beyond(count, priors.CHANCE_EARLY_P)
        if min(told) > early:
            return shown, early
        if max(told) <= last * largest:
            return shown, last * largest
    shown.append(_shown_by(copies[-1], ask))
    return shown, last * max(largest, shown[-1])


def _shown_by(copy: Track, ask: Callable[[Track], Answered]) -> float:
    """What is told of a copy, nats; without end where its fit finds none."""
    try:
        return max(_told(ask(copy).found), default=0.0)
    except (np.linalg.LinAlgError, ValueError):
        return float("inf")


def _words(why: str, found: Diagnosis, told: float, shown: Sequence[float], bound: float) -> str:
    """What was seen, what simulations show, and what is told beside that."""
    count, largest = len(shown), max(shown)
    seeds = "seed 0" if count == 1 else f"seeds 0 to {count - 1}"
    made = "a simulation" if count == 1 else f"{count} simulations"
    shows = "shows" if count == 1 else "show"
    by_chance = f"up to {largest:.0f} nats of such" if largest > 0.0 else "nothing"
    seen = (
        f"{why}: {_names(found)} is worth {told:.0f} nats here; {made} of the "
        f"model alone with this noise ({seeds}) "
    )
    if not np.isfinite(largest):
        return f"{seen}were asked, and the last cannot be diagnosed"
    untold = ", and nothing is told" if told <= bound else ""
    return f"{seen}{shows} {by_chance}; up to {bound:.0f} nats may be chance{untold}"


def _agreeing(
    answered: Answered,
    problem: Problem,
    start: NullFit,
    alone: Alone,
    said: str,
    undecided: str | None,
) -> Diagnosis:
    """The answer of the calibration alone, with what was counted in the readings.

    said: for the notes;  undecided: why not even that can be told, None where it can
    """
    found = answered.found
    counted = tuple(one for one in found.findings if not _fitted(one))
    fitted = {one.term for one in found.findings if _fitted(one)}
    terms = tuple(term for k, term in enumerate(found.terms) if k not in fitted)
    model, drawn = model_at_rate(start.model, problem), found.drawn
    if drawn is not None:
        drawn = replace(drawn, after=drawn.before, after_gauss=drawn.before_gauss, contributions=())
    more = () if counted else would_have_shown(problem.recorded)
    return replace(
        found,
        mismatch=bool(counted),
        p_value=found.p_value if counted else alone.p_value,
        findings=counted,
        unexplained=Unexplained(False),
        posterior_predictive=alone.checks or checks(start),
        undecided=None if counted else undecided,
        notes=(*found.notes, said, *more),
        model=model,
        noise=forward.model_noise(model),
        terms=terms,
        drawn=drawn,
        omnibus={k: replace(one, p_after=one.p_before) for k, one in found.omnibus.items()},
        validation=None,
        regime_map=tuple(replace(one, after=one.before) for one in found.regime_map),
    )
