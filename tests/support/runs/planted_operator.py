"""An operator who slips a candidate under a live daemon's core, approves it, and then acts."""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Estimate, Observability
from ahrsd.events import GateResult, SamplesSeen, StateChanged
from ahrsd.writeback.states import State


def estimate():
    return Estimate(
        np.diag([1.1, 1.0, 1 / 1.1]), np.array([0.03, 0.04, -0.02]), np.array([0.01, -0.02, 0.01]),
        0.48, False, np.eye(12) * 1e-6, 1e-3, 1e-3, 1.0, 0.1,
        Observability(np.full(12, 0.01), (), 10.0), 10_000, 300.0, True,
    )  # fmt: skip


class Operator:
    """Slips a candidate under the core, approves it, and acts at one state."""

    def __init__(self, live, at, act):
        self.live, self.at, self.act = live, at, act
        self.proposed = self.acted = False
        live.shell.listeners.append(self)

    def __call__(self, event):
        core = self.live.core
        if isinstance(event, SamplesSeen) and not self.proposed:
            self.proposed = core.writeback.state is State.OBSERVING
            if self.proposed:
                green = (GateResult("observability", 3.0, 1.0, True, 0.0, "", ""),)
                actions = core.writeback.on_verdict(estimate(), green, 1.0, core._host_s)
                core._action_queue.add(actions)
                core._report_verdict = lambda *_: None  # what the gates truly say would end it
        elif isinstance(event, StateChanged) and event.new == State.QUALIFIED:
            self.live.daemon.operate("approve", core.writeback.proposal.id)
        if isinstance(event, StateChanged) and event.new == self.at and not self.acted:
            self.acted = True
            self.act()
