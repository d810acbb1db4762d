"""Two clients at random moments of a write; the long form is clients.py."""

from __future__ import annotations

from dataclasses import replace

import pytest
from client_histories import SHARES, ClientHistory

from ahrsd.sharing import arbiter
from ahrsd.sharing.arbiter import Arbiter
from ahrsd.writeback import flow
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.permissions import WRITES
from ahrsd.writeback.states import Purpose

SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 8))]


@pytest.mark.parametrize("seed", SEEDS)
def test_random_clients_break_no_rule(seed):
    history = played(seed)
    assert history.wrong == {}, history.run.notes[-10:]
    assert history.asked > 200
    assert "TRIAL" in history.run.states


@pytest.mark.parametrize("seed", SEEDS)
def test_random_clients_break_no_rule_when_the_owner_may_calibrate(seed):
    history = ClientHistory(seed, passes=True)
    history.play()
    assert history.wrong == {}, history.run.notes[-10:]
    assert history.let_through > 0


def test_check_detects_a_rollback_over_owner_values(monkeypatch):
    """The owner may write in the middle of a trial, which is then undone and overwrites the
    owner's values.
    """
    undo = flow.roll_back

    def end_the_trial(self):
        self.client_write = None
        self.roll_back("client", "a client wrote")

    monkeypatch.setattr(WriteBack, "client_write_refusal", lambda self, number: "")
    monkeypatch.setattr(flow.Flow, "on_client_wrote", end_the_trial)
    monkeypatch.setattr(flow, "roll_back", lambda what, **_: undo(what, only_ours=False))
    hits = (9, 15, 16)  # from the first two dozen: such a write must occur in a trial
    assert any(played(seed, passes=True).wrong["overwritten"] > 0 for seed in hits)


def test_check_detects_a_save_in_a_trial(monkeypatch):
    monkeypatch.setattr(WriteBack, "client_save_refusal", "")
    assert any(played(seed).wrong["flash"] > 0 for seed in range(4))


def test_check_detects_a_client_calibration_write(monkeypatch):
    monkeypatch.setattr(arbiter, "GUARDED", ())
    monkeypatch.setitem(WRITES, Purpose.CLIENT, (23, 25, 84))
    assert played(0).wrong["calibration"] > 0


class Crossed(Arbiter):
    """Each answer goes to the other client."""

    def take_answers(self):
        other = {"owner": "log", "log": "owner"}
        return [replace(answer, client=other[answer.client]) for answer in super().take_answers()]


def test_check_detects_an_answer_to_the_wrong_client():
    history = ClientHistory(0)
    history.run.core.clients.arbiter = Crossed(SHARES)
    history.play()
    assert history.wrong["wrong answers"] > 0


def played(seed, **options):
    history = ClientHistory(seed, **options)
    history.play()
    return history
