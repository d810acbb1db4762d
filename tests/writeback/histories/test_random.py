"""Thousands of random inputs in random order never break the invariants."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.writeback.states import Mode, State
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import Word, Write

STEPS = 120


class Watchman:
    """Checks every command that reaches the device."""

    def __init__(self, rig, rng):
        self.rig, self.rng = rig, rng
        self.green, self.still_at_s = False, -1e9
        self.stages = self.saves = 0

    def __call__(self, command):
        rig = self.rig
        if isinstance(command, Write):
            assert command.register in (23, 84)
            assert rig.policy.mode >= Mode.STAGE
            assert "PREPARED" in rig.kinds
            if rig.wb.state is State.STAGING:
                self.stages += 1
                assert rig.safe
                assert self.green
                assert rig.kinds[-1] == "PREPARED"
            else:
                assert rig.wb.state is State.ROLLING_BACK
                assert rig.kinds[-1] == "ROLLBACK" or rig.disk_full
        if isinstance(command, Word) and command.word == "VNWNV":
            self.saves += 1
            assert rig.policy.mode is Mode.COMMIT
            assert rig.safe
            assert rig.now_s - self.still_at_s <= rig.policy.still.max_age_s
            assert rig.kinds[-1] == "FLASH_SENT"
            assert rig.wb.state is State.SAVING
        assert command != Word("VNRST")
        return 7 if self.rng.random() < 0.003 else None


def act(rig, watchman, rng):
    """One random event in the world."""
    what = rng.integers(14)
    if what <= 3:
        watchman.green = rng.random() < 0.7
        shift = np.array([0.03 * (1 + (rng.random() < 0.1)), 0.04, -0.02])
        rig.verdict(gates=rig.GREEN if watchman.green else rig.RED, hard_iron_gauss=shift)
    elif what <= 5 and rig.wb.proposal is not None:
        rig.approve()
    elif what == 6:
        rig.live(field_spread=rng.choice([0.005, 0.005, 0.5]), turns=rng.uniform(0, 3))
    elif what == 7:
        watchman.still_at_s = rig.now_s + 4.0
        rig.stand_still()
    elif what == 8:
        rig.safe = bool(rng.random() < 0.8)
    elif what == 9:
        rig.disk_full = bool(rng.random() < 0.2)
    elif what == 10:
        rig.back(rng.choice(["all", "device", "program"], p=[0.2, 0.4, 0.4]))
    elif what == 11:
        verb = rng.choice(["lock", "unlock", "unlock", "rollback", "approve", "nonsense"])
        rig.do(rig.wb.on_operator(str(verb), "", rig.now_s))
    elif what == 12:
        rig.now_s += 10.0 ** rng.uniform(-1, 5)
    else:
        rig.pass_time(float(rng.uniform(0.0, 2.0)))


@pytest.mark.parametrize("mode", [Mode.OBSERVE, Mode.STAGE, Mode.COMMIT])
@pytest.mark.parametrize("histories", [30, pytest.param(120, marks=pytest.mark.slow)])
def test_invariants_hold_for_random_inputs(make_rig, mode, histories):
    stages = saves = 0
    for seed in range(histories):
        rng = np.random.default_rng(seed)
        trial = TrialPolicy(interlock=bool(seed % 2))
        rig = make_rig(mode, trial=trial, cooldown_s=0.0, min_interval_s=0.0)
        watchman = Watchman(rig, rng)
        rig.device.refuse = watchman
        rig.connect()
        for _ in range(STEPS):
            act(rig, watchman, rng)
            if rig.wb.state in (State.TRIAL, State.PROVEN):
                assert rig.device.held()[23] != rig.device.held("flash")[23]
        assert rig.device.flash_writes <= rig.wb.history.flashes
        stages, saves = stages + watchman.stages, saves + watchman.saves
    assert (stages > 100 * histories / 60) is (mode >= Mode.STAGE)
    assert (saves > histories / 12) is (mode is Mode.COMMIT)
