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

NOT_DIAGNOSED = "a simulation of the calibration model alone, with this noise, cannot be diagnosed"


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why an answer may rest on noise.

    of_findings: whether noise may produce a library effect as well; else only what is unknown
    """

    words: str
    of_findings: bool


LOUD = Doubt("the gyro is noisier than the magnetometer", True)
BENT = Doubt("the gyro's noise biases the calibration, which this motion hardly determines", True)
ROUNDED = Doubt("the readings come in steps that are coarser than their noise", False)


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
    if (doubt := _doubt(first, problem, start, model)) is None:
        return found
    truth = noise_free_motion(recorded, model)

    def copies_with(noise: Noise) -> list[Track]:
        seeds = range(priors.CHANCE_FITS)
        return [simulated_copy(recorded, truth, noise, seed, first.rounding) for seed in seeds]

    noises = _candidate_noises(model, first)
    if not doubt.of_findings and any(map(_is_fitted, found.findings)):
        note, bound = _compare_in_copies(doubt, found, copies_with(noises[0]), diagnose)
        unknown = (
            found.unexplained if found.unexplained.evidence_nats > bound else Unexplained(False)
        )
        return replace(found, unexplained=unknown, notes=(*found.notes, note))
    for noise in noises:
        copies = copies_with(noise)
        comparison = RefitComparison.of(problem, start, copies)
        if not comparison.differs:
            note = _agreement_note(doubt, found, comparison)
            return _null_answer(first, problem, start, comparison, note, comparison.undecided)
    if not (evidence := _evidence_by_chance(found, doubt)):
        return replace(found, posterior_predictive=comparison.checks)
    note, bound = _compare_in_copies(doubt, found, copies, diagnose)
    if max(evidence) <= bound:
        undecided = None if np.isfinite(bound) else NOT_DIAGNOSED
        return _null_answer(first, problem, start, comparison, note, undecided)
    weak = [one.effect for one in found.findings if _is_fitted(one) and one.evidence_nats <= bound]
    note = f"{note}; doubtful for this reason: {', '.join(weak)}" if weak else note
    return replace(found, notes=(*found.notes, note))


def _doubt(
    answered: FittedDiagnosis, problem: Problem, start: NullFit, model: NullModel
) -> Doubt | None:
    """Why the answer may rest on noise; None where it does not, or where nothing was found."""
    found = answered.found
    fitted = any(map(_is_fitted, found.findings))
    unknown, failed = found.unexplained.detected, bool(found.failed_checks)
    if fitted or unknown or failed or found.p_value < priors.FAMILY_P:
        if gyro_to_mag_noise(problem.recorded, model) >= priors.CHANCE_LOUD:
            return LOUD
        if calibration_bend(start) >= priors.CHANCE_BENT:
            return BENT
    return ROUNDED if answered.rounding and (unknown or (failed and not fitted)) else None


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


def _agreement_note(doubt: Doubt, found: Diagnosis, comparison: RefitComparison) -> str:
    """The note on what was found, and why it is not reported."""
    seen = _evidence_text(doubt, found) if _evidence_by_chance(found, doubt) else doubt.words
    if (undecided := comparison.undecided) is not None:
        return f"{seen}; {undecided}"
    return (
        f"{seen}; {comparison.fitted} simulations of the calibration model alone, with this noise "
        f"(seeds 0 to {comparison.copies - 1}) and fitted in the same way, look like the "
        "recording, so nothing is reported"
    )


def _evidence_text(doubt: Doubt, found: Diagnosis) -> str:
    """What noise may have produced, and its evidence."""
    effects = [one.effect for one in found.findings if doubt.of_findings and _is_fitted(one)]
    seen = ", ".join([*effects, *(["something unknown"] if found.unexplained.detected else [])])
    nats = max(_evidence_by_chance(found, doubt))
    return f"{doubt.words}: {seen} is worth {nats:.0f} nats here"


def _evidence_by_chance(found: Diagnosis, doubt: Doubt) -> list[float]:
    """The evidence of each reported mismatch that noise may have produced, nats."""
    nats = [one.evidence_nats for one in found.findings if doubt.of_findings and _is_fitted(one)]
    return nats + ([found.unexplained.evidence_nats] if found.unexplained.detected else [])


def required_ratio(copies: int, chance: float) -> float:
    """Ratio to the largest of so many copies that chance exceeds with this probability."""
    from scipy.optimize import brentq  # slow to import, and seldom needed

    orders = np.arange(1, copies + 1)

    def too_likely(log_times: float) -> float:
        return float(np.sum(np.log1p(np.exp(log_times) / orders)) + np.log(chance))

    return float(np.exp(brentq(too_likely, -20.0, -np.log(chance) + 1.0)))


def _compare_in_copies(
    doubt: Doubt,
    found: Diagnosis,
    copies: Sequence[Track],
    diagnose: Callable[[Track], FittedDiagnosis],
) -> tuple[str, float]:
    """The note on what was found and what copies show, and the bound of chance evidence, nats."""
    evidence = _evidence_by_chance(found, doubt)
    shown, bound = _evidence_in_copies(
        copies[: priors.CHANCE_COPIES],
        lambda copy: _evidence_in_copy(copy, diagnose, doubt),
        evidence,
    )
    stays = not doubt.of_findings and any(map(_is_fitted, found.findings))
    unreported = ", so that is not reported" if stays else ", so nothing is reported"
    ending = unreported if max(evidence) <= bound else ""
    return f"{_evidence_text(doubt, found)}; {_shown_text(shown, bound, ending)}", bound


def _evidence_in_copies(
    copies: Sequence[Track], evidence_of: Callable[[Track], float], evidence: Sequence[float]
) -> tuple[list[float], float]:
    """Evidence found in copies, nats, until that decides; and the bound of chance evidence."""
    last = required_ratio(len(copies), priors.CHANCE_P)
    largest, shown = priors.ALONE_NATS, list[float]()
    for count, copy in enumerate(copies[:-1], 1):
        shown.append(evidence_of(copy))
        largest = max(largest, shown[-1])
        early = largest * required_ratio(count, priors.CHANCE_EARLY_P)
        if min(evidence) > early:
            return shown, early
        if max(evidence) <= last * largest:
            return shown, last * largest
    shown.append(evidence_of(copies[-1]))
    return shown, last * max(largest, shown[-1])


def _evidence_in_copy(
    copy: Track, diagnose: Callable[[Track], FittedDiagnosis], doubt: Doubt
) -> float:
    """The largest evidence reported of a copy, nats; infinite if the copy cannot be fitted."""
    try:
        return max(_evidence_by_chance(diagnose(copy).found, doubt), default=0.0)
    except (np.linalg.LinAlgError, ValueError):
        return float("inf")


def _shown_text(shown: Sequence[float], bound: float, ending: str) -> str:
    """What simulations show, and what may be chance given that."""
    count, largest = len(shown), max(shown)
    seeds = "seed 0" if count == 1 else f"seeds 0 to {count - 1}"
    made = "a simulation" if count == 1 else f"{count} simulations"
    simulated = f"{made} of the calibration model alone, with this noise ({seeds}), "
    if not np.isfinite(largest):
        failed = "cannot be diagnosed" if count == 1 else "were tried, the last without a diagnosis"
        return f"{simulated}{failed}"
    shows = "shows" if count == 1 else "show"
    by_chance = f"an effect of up to {largest:.0f} nats" if largest > 0.0 else "no effect"
    return f"{simulated}{shows} {by_chance}; up to {bound:.0f} nats may be chance{ending}"


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
