"""Evidence that noise may produce, compared with simulations of the null model.

The filter takes the measured rates for the true ones.  If the gyro's noise turns the field between
two readings by more than the magnetometer's noise, that noise is in every column and every
evidence (a regression on noisy regressors), and evidence no longer follows the law by which it is
judged elsewhere.  If the motion hardly determines the calibration, far less noise has the same
effect: a sensor that turns slowly and is hardly tilted determines the scale of its vertical axis
from turns as small as the noise.  Then calibrations that are a tenth of a gauss off are more
likely, with a flexible mount and viscous iron to explain the remainder.

Readings in steps that are coarser than their noise have rounding errors that follow the motion:
they keep their value for as long as the field stays within a step.  The likelihood takes them for
noise of one spectrum at all times, so they may appear as an unknown process in time.

Therefore the distribution of the evidence is measured (a parametric bootstrap).  The fitted
calibration alone is simulated along the recording's own motion, with its time stamps, its columns
and the fitted noise, rounded if the recording's readings are.  First the calibration is fitted to
each copy as it was to the recording.  If the residuals of the recording are like those of the
copies, recording and calibration agree, whatever else was found.  If not, the first copies are
diagnosed as well, and a finding must be far beyond what is found in these.  Calibration and noise
are those of the fit without any effect or of the fit with the effects, whichever has the noisier
gyro relative to its magnetometer: the residual of a missing effect is not magnetometer noise.

The motion is the expected value of the gyro's readings without their noise
(`time_series.wiener_filter`), aligned by field and accelerometer.  A copy has no mismatch, so
whatever is found in it is chance.
Evidence that is too large by an unknown factor has an exponential tail of unknown scale: it is t
times the largest of n such with probability n! / ((1 + t) ... (n + t)), whatever that scale: 1 in
126 for four times the largest of five.  If the evidence is far beyond that of the first copies, the
others need not be diagnosed: 1 in 1000 is required at each of them (43 times the larger of two).
With all of these looks about 1 in 94 of chance findings is reported.  A copy without findings
counts with the evidence below which nothing is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.diagnosis import priors, time_series
from ahrsd.diagnosis.answer.diagnosis import Check, Diagnosis, Finding, Unexplained
from ahrsd.diagnosis.answer.predictive_checks import (
    check_null,
    compare_with_refits,
    constant_level_noise,
)
from ahrsd.diagnosis.calibration_fit.null_fit import NullFit, fit_null
from ahrsd.diagnosis.calibration_fit.problem import Problem, build_problem, model_of_samples
from ahrsd.diagnosis.data_quality.preparation import detectable_faults
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
from ahrsd.diagnosis.model import Noise, NullModel, Term
from ahrsd.diagnosis.repaired_model import forward
from ahrsd.diagnosis.track import Track
from ahrsd.samples import Array

LOUD = "the gyro is noisier than the magnetometer"
ROUNDED = "the readings come in steps that are coarser than their noise"
NOT_DIAGNOSED = "a simulation of the calibration model alone, with this noise, cannot be diagnosed"
BENT = "the gyro's noise biases the calibration, which this motion hardly determines"


@dataclass(frozen=True, slots=True, eq=False)
class FittedDiagnosis:
    """A diagnosis, with the calibration that was fitted before any effect.

    problem, start: None where nothing was fitted
    rounding: the quantisation steps of the readings as a term, where they are coarse
    """

    found: Diagnosis
    problem: Problem | None = None
    start: NullFit | None = None
    rounding: tuple[Term, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class RefitComparison:
    """The fit of the calibration alone, compared with fits to simulations of it.

    checks:  empty where fewer than half of the simulations could be fitted
    p_value: of the recording's fit among those of the simulations
    """

    checks: dict[str, Check]
    p_value: float
    copies: int
    fitted: int

    @staticmethod
    def of(problem: Problem, start: NullFit, copies: Sequence[Track]) -> RefitComparison:
        """Compare the recording's fit with fits of the calibration to the copies."""
        fits = [fit for one in copies if (fit := _fit_copy(one, problem)) is not None]
        enough = 2 * len(fits) >= len(copies)
        checked, p_value = compare_with_refits(start, fits) if enough else ({}, 1.0)
        return RefitComparison(checked, p_value, len(copies), len(fits))

    @property
    def undecided(self) -> str | None:
        """Why the recording's fit cannot be compared with theirs; None where it can."""
        if self.checks:
            return None
        return (
            f"of {self.copies} simulations of the calibration model alone, with this noise, only "
            f"{self.fitted} can be fitted"
        )

    @property
    def differs(self) -> bool:
        """Whether the residuals of the recording's fit differ from those of the simulations."""
        return any(not check.inside_after for check in self.checks.values())


def diagnose_beyond_chance(track: Track, diagnose: Callable[[Track], FittedDiagnosis]) -> Diagnosis:
    """Diagnose a track; if noise may produce evidence, report only what is clearly beyond chance.

    diagnose: the diagnosis of a track
    If the gyro is noisy, by itself or for this motion, or the readings are rounded, and there is a
    finding or a failed check, the calibration is fitted to `CHANCE_FITS` copies (seeds 0, 1 and so
    on).  If the recording's fit differs from theirs, `CHANCE_COPIES` of these at most are
    diagnosed.
    """
    first = diagnose(track)
    found, problem, start = first.found, first.problem, first.start
    if problem is None or start is None:
        return found
    recorded = problem.recorded
    models = [model_of_samples(start.model, problem), *([found.model] if found.model else [])]
    model = max(models, key=lambda one: gyro_to_mag_noise(recorded, one))
    if (why := _reason_to_simulate(first, problem, start, model)) is None:
        return found
    truth = noise_free_motion(recorded, model)
    comparison = None
    for noise in _candidate_noises(model, first):
        copies = [
            simulated_copy(recorded, truth, noise, seed, first.rounding)
            for seed in range(priors.CHANCE_FITS)
        ]
        if why == ROUNDED and any(map(_is_fitted, found.findings)):
            break  # the calibration alone is not what these copies would have to look like
        comparison = RefitComparison.of(problem, start, copies)
        if not comparison.differs:
            note = _agreement_note(why, found, comparison)
            return _null_answer(first, problem, start, comparison, note, comparison.undecided)
    evidence = _evidence_by_chance(found, why)
    if not evidence:
        return replace(found, posterior_predictive=comparison.checks) if comparison else found
    shown, bound = _evidence_in_copies(copies[: priors.CHANCE_COPIES], diagnose, evidence, why)
    note = _comparison_note(why, found, shown, bound)
    if max(evidence) <= bound:
        if comparison is None:
            return replace(found, unexplained=Unexplained(False), notes=(*found.notes, note))
        undecided = None if np.isfinite(bound) else NOT_DIAGNOSED
        return _null_answer(first, problem, start, comparison, note, undecided)
    weak = [
        one.effect for one in found.findings
        if why != ROUNDED and _is_fitted(one) and one.evidence_nats <= bound
    ]  # fmt: skip
    note = f"{note}; doubtful for this reason: {', '.join(weak)}" if weak else note
    return replace(found, notes=(*found.notes, note))


def _reason_to_simulate(
    answered: FittedDiagnosis, problem: Problem, start: NullFit, model: NullModel
) -> str | None:
    """Why the answer may rest on noise; None where it does not, or where nothing was found.

    Rounding errors resemble an unknown process in time, and no effect's own form.
    """
    found = answered.found
    fitted = any(map(_is_fitted, found.findings))
    if answered.rounding and (found.unexplained.detected or (found.failed_checks and not fitted)):
        return ROUNDED
    seen = fitted or found.unexplained.detected or found.failed_checks
    if not seen and found.p_value >= priors.FAMILY_P:
        return None
    if gyro_to_mag_noise(problem.recorded, model) >= priors.CHANCE_LOUD:
        return LOUD
    return BENT if calibration_bend(start) >= priors.CHANCE_BENT else None


def gyro_to_mag_noise(track: Track, model: NullModel) -> float:
    """Turn of the field in a step by gyro noise, in deviations of the magnetometer's noise."""
    field_b = np.linalg.solve(model.soft_iron, (track.mag_b_gauss - model.hard_iron_gauss).T)
    size = float(np.nanmedian(np.linalg.norm(field_b, axis=0)))
    return size * model.sigma_gyro_rad_s * track.step_s / model.sigma_mag_gauss


def calibration_bend(start: NullFit) -> float:
    """Bias of the calibration by the noise in its columns, in its own standard deviations.

    The fit uses the derivatives of the innovations, which contain the gyro's noise.  Derivatives
    from the smoothed motion contain none, and the difference of the two scores at the fit is due
    to that noise.
    """
    done = start.filtered
    smooth = filtered_for_regression(done, start.context().rate_b_rad_s)
    noisy, clean = (sensitivities(one, nuisance_columns(one)) for one in (done, smooth))
    score = np.einsum("nia,ni->a", noisy - clean, done.whitened)
    known = start.covariance[: len(score), : len(score)]
    return float(np.sqrt(max(score @ known @ score, 0.0)))


def noise_free_motion(track: Track, model: NullModel) -> Readings:
    """Noise-free readings of a calibration along a track's motion without the gyro's noise."""
    seen = nominal_motion(track, model)
    context = build_context(track, UnfittedMotion(seen))
    rate = _denoised_rate(track, model)
    denoised_motion = replace(seen, orientation=carried_orientation(track, rate))
    R_nb, levelled = attitude(track, denoised_motion)
    along = replace(
        context, R_nb=R_nb, world_levelled=levelled, rate_b_rad_s=rate, field_b=seen.nominal_b
    )
    return forward.noise_free_readings(along)


def _candidate_noises(model: NullModel, answered: FittedDiagnosis) -> list[Noise]:
    """The noise of a model, or two where the magnetometer's is at the least that a fit assumes.

    How much it really is, is then unknown: the noise that the innovations show, and none.
    The noise of rounded readings is that before they were rounded.
    """
    found, start = answered.found, answered.start
    noise = forward.model_noise(model)
    if answered.rounding and found.noise is not None:
        return [found.noise]
    if start is None or start.model.sigma_mag_gauss > priors.FLOOR_MAG_GAUSS:
        return [noise]
    less = min(
        1.0, constant_level_noise(start).mag_gauss / forward.model_noise(start.model).mag_gauss
    )
    return [replace(noise, mag_gauss=less * noise.mag_gauss), replace(noise, mag_gauss=0.0)]


def simulated_copy(
    track: Track, truth: Readings, noise: Noise, seed: int, rounding: Sequence[Term] = ()
) -> Track:
    """The track with simulated readings: those of the truth with noise, rounded by a term."""
    made = forward.simulate_readings(truth, rounding, noise, seed)
    read = np.isfinite(track.mag_b_gauss)
    mag = np.where(read, made.mag_b_gauss, track.mag_b_gauss)
    return replace(track, mag_b_gauss=mag, gyro_b_rad_s=made.gyro_b_rad_s)


def _denoised_rate(track: Track, model: NullModel) -> Array:
    """(N, 3) expected rates without noise; smoothed in runs that are too short for a spectrum."""
    rate = track.gyro_b_rad_s - model.gyro_bias_rad_s
    runs = track.runs or (slice(0, len(track)),)
    out = smoothed_rate(rate, runs, track.step_s, model.sigma_gyro_rad_s)
    for run in runs:
        if run.stop - run.start >= time_series.SPECTRUM_ROWS:
            out[run] = time_series.wiener_filter(rate[run])
    return out


def _is_fitted(one: Finding) -> bool:
    """Whether the finding rests on a fit; for one counted in the readings noise does not matter."""
    return one.term is not None


def _fit_copy(copy: Track, problem: Problem) -> NullFit | None:
    """The calibration alone fitted to a copy, as it was to the recording; None if that fails."""
    try:
        made, cold = build_problem(copy, problem.spec)
        return fit_null(made.track, made.spec, cold, walk=False)
    except (np.linalg.LinAlgError, ValueError):
        return None


def _agreement_note(why: str, found: Diagnosis, comparison: RefitComparison) -> str:
    """The note on what was found, and why it is not reported."""
    seen = _evidence_text(why, found) if _evidence_by_chance(found, why) else why
    if (undecided := comparison.undecided) is not None:
        return f"{seen}; {undecided}"
    return (
        f"{seen}; {comparison.fitted} simulations of the calibration model alone, with this noise "
        f"(seeds 0 to {comparison.copies - 1}) and fitted in the same way, look like the "
        "recording, so nothing is reported"
    )


def _evidence_text(why: str, found: Diagnosis) -> str:
    """What noise may have produced, and its evidence."""
    effects = [one.effect for one in found.findings if why != ROUNDED and _is_fitted(one)]
    seen = ", ".join([*effects, *(["something unknown"] if found.unexplained.detected else [])])
    return f"{why}: {seen} is worth {max(_evidence_by_chance(found, why)):.0f} nats here"


def _evidence_by_chance(found: Diagnosis, why: str) -> list[float]:
    """The evidence of each reported mismatch that noise may have produced, nats."""
    nats = [one.evidence_nats for one in found.findings if why != ROUNDED and _is_fitted(one)]
    left = found.unexplained
    return [*nats, *([left.evidence_nats] if left.detected else [])]


def required_ratio(copies: int, chance: float) -> float:
    """Ratio to the largest of so many copies that chance exceeds with this probability."""
    from scipy.optimize import brentq  # slow to import, and seldom needed

    orders = np.arange(1, copies + 1)

    def too_likely(log_times: float) -> float:
        return float(np.sum(np.log1p(np.exp(log_times) / orders)) + np.log(chance))

    return float(np.exp(brentq(too_likely, -20.0, -np.log(chance) + 1.0)))


def _evidence_in_copies(
    copies: Sequence[Track],
    diagnose: Callable[[Track], FittedDiagnosis],
    evidence: Sequence[float],
    why: str,
) -> tuple[list[float], float]:
    """Evidence found in copies, nats, until that decides; and the bound of chance evidence."""
    last = required_ratio(len(copies), priors.CHANCE_P)
    largest, shown = priors.ALONE_NATS, list[float]()
    for count, copy in enumerate(copies[:-1], 1):
        shown.append(_evidence_in_copy(copy, diagnose, why))
        largest = max(largest, shown[-1])
        early = largest * required_ratio(count, priors.CHANCE_EARLY_P)
        if min(evidence) > early:
            return shown, early
        if max(evidence) <= last * largest:
            return shown, last * largest
    shown.append(_evidence_in_copy(copies[-1], diagnose, why))
    return shown, last * max(largest, shown[-1])


def _evidence_in_copy(copy: Track, diagnose: Callable[[Track], FittedDiagnosis], why: str) -> float:
    """The largest evidence reported of a copy, nats; infinite if the copy cannot be fitted."""
    try:
        return max(_evidence_by_chance(diagnose(copy).found, why), default=0.0)
    except (np.linalg.LinAlgError, ValueError):
        return float("inf")


def _comparison_note(why: str, found: Diagnosis, shown: Sequence[float], bound: float) -> str:
    """The note on what was found, what simulations show, and what is reported given that."""
    count, largest = len(shown), max(shown)
    seeds = "seed 0" if count == 1 else f"seeds 0 to {count - 1}"
    made = "a simulation" if count == 1 else f"{count} simulations"
    shows = "shows" if count == 1 else "show"
    by_chance = f"an effect of up to {largest:.0f} nats" if largest > 0.0 else "no effect"
    seen = (
        f"{_evidence_text(why, found)}; {made} of the calibration model alone, with this noise "
        f"({seeds}), "
    )
    if not np.isfinite(largest):
        failed = "cannot be diagnosed" if count == 1 else "were tried, the last without a diagnosis"
        return f"{seen}{failed}"
    rest_stays = why == ROUNDED and any(map(_is_fitted, found.findings))
    unreported = ", so that is not reported" if rest_stays else ", so nothing is reported"
    untold = unreported if max(_evidence_by_chance(found, why)) <= bound else ""
    return f"{seen}{shows} {by_chance}; up to {bound:.0f} nats may be chance{untold}"


def _null_answer(
    answered: FittedDiagnosis,
    problem: Problem,
    start: NullFit,
    comparison: RefitComparison,
    note: str,
    undecided: str | None,
) -> Diagnosis:
    """The answer of the calibration alone, with what was counted in the readings.

    note: to be added;  undecided: why not even that can be decided, None where it can
    """
    found = answered.found
    counted = tuple(one for one in found.findings if not _is_fitted(one))
    fitted = {one.term for one in found.findings if _is_fitted(one)}
    terms = tuple(term for k, term in enumerate(found.terms) if k not in fitted)
    model, drawn = model_of_samples(start.model, problem), found.drawn
    if drawn is not None:
        drawn = replace(drawn, after=drawn.before, after_gauss=drawn.before_gauss, contributions=())
    more = () if counted else detectable_faults(problem.recorded)
    return replace(
        found,
        mismatch=bool(counted),
        p_value=found.p_value if counted else comparison.p_value,
        findings=counted,
        unexplained=Unexplained(False),
        posterior_predictive=comparison.checks or check_null(start),
        undecided=None if counted else undecided,
        notes=(*found.notes, note, *more),
        model=model,
        noise=_candidate_noises(model, answered)[0],
        terms=terms,
        drawn=drawn,
        omnibus={k: replace(one, p_after=one.p_before) for k, one in found.omnibus.items()},
        validation=None,
        regime_map=tuple(replace(one, after=one.before) for one in found.regime_map),
    )
