"""Lost turns beside the names: which search is believed, and what slow turns leave."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mismatch_trials import Trial, made

from ahrsd.diagnosis.answer.diagnosis import Where
from ahrsd.diagnosis.calibration_fit.null import fit_null
from ahrsd.diagnosis.calibration_fit.problem import problem_of
from ahrsd.diagnosis.data_quality.facts import Fact
from ahrsd.diagnosis.data_quality.missing import price
from ahrsd.diagnosis.limits import LIMITS
from ahrsd.diagnosis.rules.lost import _as_seen, believed, beyond_lost
from ahrsd.diagnosis.rules.search import State
from ahrsd.diagnosis.track import Spec

LOST = Fact("dropped_samples", "", Where((), (), "link"), 0.98, turned=np.ones(3))
LONG = replace(LOST, setting={"hidden": True, "long": 2})
UNSEEN = replace(LOST, setting={"hidden": True, "unseen": 38.0})
STAMPED = Fact("dropped_samples", "", Where((), (), "link"), 0.98)


def fitted(nats: float) -> SimpleNamespace:
    problem = SimpleNamespace(track=SimpleNamespace(lost_turns=None))
    return SimpleNamespace(fit=SimpleNamespace(log_likelihood=nats), problem=problem)


@pytest.mark.parametrize(
    ("lost", "put_right", "as_it_came", "stays"),
    [([LOST], 59_223.0, 47_066.0, True), ([LOST], 40.0, 60.0, False), ([], 60.0, 40.0, False)],
)
def test_lost_turns_stay_where_the_recording_is_likelier_with_them(
    lost, put_right, as_it_came, stays
):
    assert believed(lost, fitted(put_right), [], fitted(as_it_came)) is stays


def put_right(rows: int, steps: int, of: int = 5673) -> Fact:
    turned = np.ones(of) + 0.008
    turned[np.arange(1, rows + 1) * (of // (rows + 1))] = 1.0 + steps
    return replace(LOST, turned=turned)


def test_lost_turns_have_their_price():
    """33 gaps of eight steps each were 136 nats likelier than a crooked mount: for 490."""
    assert price([]) == price([LOST]) == price([STAMPED]) == 0.0
    assert price([put_right(33, 1)]) == pytest.approx(33 * np.log(5673 / 33))
    many = put_right(33, 8)
    assert price([many]) == pytest.approx(33 * (np.log(5673 / 33) + 7 * np.log(4.0)))
    assert price([many, LOST]) == pytest.approx(price([many]), rel=1e-3)
    assert not believed([many], fitted(8863.8), [], fitted(8728.2))
    assert believed([many], fitted(8863.8), [put_right(60, 8)], fitted(8728.2))


def test_that_more_may_be_lost_makes_no_claim_likelier() -> None:
    """A field that swings: noise of the turn explains some of it, and is no proof."""
    track = made(Trial(3, samples=4_000)).track
    swing = 5e-3 * np.sin(2 * np.pi * track.time_s / 12.0)[:, None] * np.array([0.6, -0.8, 0.0])
    problem, cold = problem_of(
        replace(track, mag_b_gauss=track.mag_b_gauss + swing), Spec(), {}, LIMITS
    )
    plain = State(problem, fit_null(problem.track, problem.spec, cold, walk=False))
    loose = replace(problem.track, lost_turns=np.full(len(problem.track), 0.05))
    free = replace(problem, track=loose)
    claimed = State(free, fit_null(loose, problem.spec, cold, walk=False))
    assert claimed.fit.log_likelihood > plain.fit.log_likelihood + 100.0
    assert _as_seen(claimed) == pytest.approx(plain.fit.log_likelihood, abs=20.0)


@pytest.mark.parametrize(
    ("facts", "frame", "told"),
    [
        ([LOST], "gyro", False),
        ([LOST], "sensor", True),
        ([LONG], "sensor", False),
        ([UNSEEN], "world", False),
        ([STAMPED], "gyro", True),
        ([], "gyro", True),
    ],
)
def test_what_lost_turns_leave_is_an_error_of_the_gyro(facts, frame, told):
    left = SimpleNamespace(
        strongest=SimpleNamespace(frame=frame, evidence=400.0, p_value=0.0),
        bins=(),
        stood_in=None,
        one_source=False,
    )
    assert beyond_lost(left, facts, SimpleNamespace(limits=LIMITS)) is told
