"""The library held against one state: in whose noise the candidates are ranked."""

from mismatch_trials import Trial, made

from ahrsd.mismatch.effects.library import EFFECTS
from ahrsd.mismatch.limits import LIMITS
from ahrsd.mismatch.null import fit_null
from ahrsd.mismatch.problem import problem_of
from ahrsd.mismatch.regression import evidence_of
from ahrsd.mismatch.search import State, survey
from ahrsd.mismatch.track import Spec


def surveyed(**trial):
    track = made(Trial(3, samples=8_000, **trial)).track
    problem, cold = problem_of(track, Spec(), EFFECTS, LIMITS)
    return survey(State(problem, fit_null(problem.track, problem.spec, cold, walk=False)))


def test_what_an_effect_does_is_no_noise_to_the_names_for_it():
    seen = surveyed(effects=(("flexible_mount", 0.4),))
    best = seen.candidates[0]
    assert best.name == "flexible_mount"
    assert seen.basis.colour > 2.0  # of all that the calibration leaves, the effect with it
    with_it = evidence_of(seen.basis, best)
    assert best.evidence > 0.8 * seen.basis.colour * with_it
    judged = next(j for j in seen.judged if j.candidate is best)
    assert abs(judged.evidence - best.evidence) < 1e-6


def test_red_noise_stays_noise_to_whatever_is_strongest_in_it():
    seen = surveyed(noise="red")
    assert seen.basis.colour > 1.1
    assert not any(one.accepted for one in seen.judged)
    assert seen.candidates[0].evidence < LIMITS.evidence_nats
