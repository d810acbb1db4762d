"""Two clients at random moments of a write-back; the long form is tests/benchmarks/clients.py."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from client_histories import SHARES, ClientHistory

from ahrsd.sharing import client_commands
from ahrsd.sharing.arbiter import Arbiter
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.permissions import WRITES, Purpose


@pytest.mark.parametrize("seed", range(8))
def test_nothing_that_must_not_be(seed):
    history = played(seed)
    assert history.wrong == {}, history.run.notes[-10:]
    assert history.asked > 200
    assert "TRIAL" in history.run.states


def test_a_save_in_the_middle_of_a_trial_would_be_seen(monkeypatch):
    monkeypatch.setattr(WriteBack, "client_may_save", True)
    wrong = sum((played(seed).wrong for seed in range(4)), Counter())
    assert wrong["flash"] > 0


def test_a_client_that_may_write_what_calibrates_would_be_seen(monkeypatch):
    monkeypatch.setattr(client_commands, "GUARDED", ())
    monkeypatch.setitem(WRITES, Purpose.CLIENT, (23, 25, 84))
    assert played(0).wrong["calibration"] > 0


class Crossed(Arbiter):
    """Each answer goes to the other client."""

    def take_answers(self):
        other = {"owner": "log", "log": "owner"}
        return [replace(answer, client=other[answer.client]) for answer in super().take_answers()]


def test_an_answer_to_the_wrong_client_would_be_seen():
    history = ClientHistory(0)
    history.run.core.clients.arbiter = Crossed(SHARES)
    history.play()
    assert history.wrong["wrong answers"] > 0


def played(seed):
    history = ClientHistory(seed)
    history.play()
    return history
