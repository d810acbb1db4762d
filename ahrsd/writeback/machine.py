"""The write-back: one object, driven by inputs, that answers with actions. Pure and deterministic.

The core calls the `on_...` methods with the host's monotonic time and carries out what they return
(`actions`), in that order. The gate in front of each command judges interlock and stillness at the
newest time that was told, so `tick` comes before bytes are given to the session.

Order of things, which the tests hold (tests/test_writeback_machine.py):

* PREPARED is on the disk before the first byte of a transaction, FLASH_SENT before VNWNV;
* a rollback needs neither interlock nor journal: the old values are what the vehicle lived with;
* in mode `observe` nothing is ever started: QUALIFIED says what would be written, to the byte.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.events import GateResult
from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.actions import Action, IdentifyAgain
from ahrsd.writeback.composition import GYRO, MAG, Proposal
from ahrsd.writeback.flow import Answer, Flow
from ahrsd.writeback.journal_history import History, JournalRecord
from ahrsd.writeback.permissions import Mode
from ahrsd.writeback.policy import WriteBackPolicy, margin
from ahrsd.writeback.reconcile import Kind
from ahrsd.writeback.safeguards import NOT_ARMED
from ahrsd.writeback.states import (
    CHANGED_IN_RAM,
    ON_TIMEOUT,
    WITHOUT_TRANSACTION,
    Signal,
    State,
)
from ahrsd.writeback.transaction import Outcome
from ahrsd.writeback.trial import Finding, TrialMetrics
from drivers.vn100.procedures import Identity
from drivers.vn100.registers import Values

UPTIME_MARGIN_S = 0.5  # what a message may take to get here

_AWAITED = {
    State.PREPARING: Kind.PREPARED,
    State.STAGED: Kind.RAM_VERIFIED,
    State.SAVE_PREPARING: Kind.FLASH_SENT,
}


class WriteBack:
    """See the module and `states`. Every `on_...` returns the actions that follow, in order."""

    def __init__(self, policy: WriteBackPolicy) -> None:
        self.policy = policy
        self._flow = Flow(policy)
        self._desk = self._flow.desk
        self._safe = self._flow.safe
        self._gyro_bias_rad_s: Array = np.zeros(3)
        self._saw_reset = False
        self.operator_answer: Answer = (False, "no command yet")  # to the newest `on_operator`
        self._read_from_s = float("inf")  # since when the registers were being read; inf: told

    # -- what others ask ---------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """Where the write-back stands."""
        return self._flow.state

    @property
    def proposal(self) -> Proposal | None:
        """What would be written: the qualified candidate, as a person approves it."""
        return self._flow.proposal

    @property
    def history(self) -> History:
        """The device's journal, summed up."""
        return self._desk.history

    @property
    def mode(self) -> Mode:
        """What is possible now: observe at most while the device or its journal is in doubt."""
        return self._safe.mode

    @property
    def margin(self) -> float:
        """How much clearer than usual an improvement must be: the gates multiply by it."""
        return margin(self.policy, self.history)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` must be called at the latest."""
        deadlines = [self._flow.deadline_s]
        if self._flow.watches_interlock:
            deadlines.append(self._desk.host_s + self.policy.interlock_max_age_s)
        return min((d for d in deadlines if d is not None), default=None)

    @property
    def idle(self) -> bool:
        """Nothing of ours is under way; a daemon that stops may go."""
        return not self._desk.running and self.state not in CHANGED_IN_RAM - {State.PROVEN}

    def holds(self) -> list[str]:
        """Every reason why the next step is not taken now, each with what helps."""
        now = (self.history, self._desk.host_s, self._desk.wall_s)
        if self.state is State.PROVEN:
            return self._safe.save_holds(*now)
        reasons = self._safe.write_holds(*now)
        if self.proposal is not None and not self._flow.approver:
            reasons.append(f"an operator must approve {self.proposal.id}")
        return reasons

    # -- inputs ------------------------------------------------------------------------------------

    def tick(self, host_s: float) -> list[Action]:
        """Time passed: silence, an interlock that went stale, a write or save that may go now."""
        self._desk.host_s = host_s
        if self._flow.deadline_s is not None and host_s >= self._flow.deadline_s:
            self._flow.on_timeout()
        return self._answer()

    def on_device(
        self,
        identity: Identity,
        registers: Mapping[int, Values],
        journal: Sequence[JournalRecord] | None,
        host_s: float,
        wall_s: float,
        *,
        uptime_s: float | None = None,
        session_keys: frozenset[int] = frozenset(),
        read_from_s: float = float("inf"),
    ) -> list[Action]:
        """The device was identified and read: at the start, after a reset, after a lost link.

        registers:    all that were read; `session_keys` (which the daemon changes for its session)
                      with the values that the user had
        read_from_s:  when the reading of them began; see `on_uptime`
        journal:      this device's records, oldest first; None where they cannot be trusted
        wall_s:       the wall clock at `host_s`; only for budgets that span restarts
        uptime_s:     the device's own time since its start-up, where its stream says it
        """
        flow, self._desk.host_s = self._flow, host_s
        self._desk.bind(identity.serial, journal, wall_s)
        self._safe.bind(identity, registers, journal is not None)
        flow.identity, flow.registers, flow.session_keys = identity, dict(registers), session_keys
        self._desk.in_force(registers)
        age_s = wall_s - self.history.last_wall_s
        restarted = self._saw_reset or (uptime_s is not None and 0.0 <= uptime_s < age_s)
        self._read_from_s = float("inf") if self._saw_reset else read_from_s
        self._saw_reset = False
        if self.state is not State.RECONCILING:
            flow.enter(State.RECONCILING, "the device was read again")
        unfinished = self.history.open
        self._safe.armed |= unfinished is not None and unfinished.approver == "operator"
        flow.reconcile(restarted)
        return self._answer()

    def on_no_device(self, registers: Mapping[int, Values] | None, host_s: float) -> list[Action]:
        """There is nobody to ask: mode passive, or a recording. Registers where they are known."""
        self._desk.host_s = host_s
        identity = Affine.identity().to_register()
        self._flow.registers = {MAG: identity, GYRO: identity, **(registers or {})}
        self._safe.no_device("there is no device to write to")
        self._flow.signal(Signal.NOTHING_OPEN, "no device to ask")
        return self._answer()

    def on_link_lost(self, host_s: float) -> list[Action]:
        """The port went away."""
        self._desk.host_s = host_s
        self._flow.signal(Signal.LINK_LOST, "the link was lost")
        return self._answer()

    def on_reset(self, host_s: float) -> list[Action]:
        """The device restarted: its RAM is what its flash holds. `on_device` must follow."""
        self._desk.host_s, self._saw_reset = host_s, True
        self._flow.signal(Signal.DEVICE_RESET, "the device restarted")
        return self._answer()

    def on_uptime(self, uptime_s: float, host_s: float) -> list[Action]:
        """The device's time since its start-up, once its stream tells: a restart nobody saw.

        One since the registers were read (the output of before had no device time) makes that
        reading void. And only a restart shows what a save left in flash, so it is asked again then.
        """
        self._desk.host_s = host_s
        if uptime_s < host_s - self._read_from_s - UPTIME_MARGIN_S:
            self._saw_reset = True
            self._flow.signal(Signal.DEVICE_RESET, "the device restarted since it was read")
            self._desk.ask(IdentifyAgain())
            return self._answer()
        age_s = self._desk.wall_s - self.history.last_wall_s
        open_save = self.history.last in (Kind.FLASH_SENT, Kind.FLASH_ACKED)
        resting = self.state in (State.FAULT, State.COMMITTED)
        if open_save and resting and 0.0 <= uptime_s < age_s:
            self._saw_reset = True
            self._flow.signal(Signal.DEVICE_RESET, "the device restarted since the save")
            self._desk.ask(IdentifyAgain())
        return self._answer()

    def on_samples(self, block: SampleBlock) -> list[Action]:
        """Raw samples: for the proof that the vehicle stands still."""
        self._safe.stillness.update(block, self._gyro_bias_rad_s)
        return self._answer()

    def on_interlock(self, safe: bool, host_s: float) -> list[Action]:
        """The vehicle's word."""
        self._desk.host_s = host_s
        self._safe.hear_interlock(safe, host_s)
        return self._answer()

    def on_verdict(
        self,
        estimate: Estimate,
        gates: tuple[GateResult, ...],
        at_s: float,
        host_s: float,
        *,
        flash_gates: tuple[GateResult, ...] = (),
        gyro_is_raw: bool = True,
    ) -> list[Action]:
        """A new estimate and what the gates say: for RAM (none at all is no pass), and for flash.

        gyro_is_raw: see `composition.compose`.
        """
        self._desk.host_s, self._desk.at_s = host_s, at_s
        self._safe.gates, self._safe.flash_gates = gates, flash_gates
        if np.isfinite(estimate.gyro_bias_rad_s).all():
            self._gyro_bias_rad_s = estimate.gyro_bias_rad_s
        if self.state in WITHOUT_TRANSACTION:
            self._flow.consider(estimate, gyro_is_raw)
        return self._answer()

    def on_estimator_failed(self, host_s: float) -> list[Action]:
        """There is no estimate, nor what the gates said of it: what rests on it ends."""
        self._desk.host_s = host_s
        self._safe.gates = self._safe.flash_gates = ()
        self._flow.signal_if(Signal.NOT_WORTH_WRITING, "the estimator failed")
        self._flow.roll_back("estimator", "the estimator failed: nobody judges the new values")
        return self._answer()

    def on_limits_changed(self, host_s: float) -> list[Action]:
        """The gates have other limits: what they said before allows nothing."""
        self._desk.host_s = host_s
        self._safe.gates = self._safe.flash_gates = ()
        self._flow.signal_if(Signal.NOT_WORTH_WRITING, "the limits of the gates were changed")
        return self._answer()

    def on_operator(self, verb: str, argument: str, host_s: float) -> list[Action]:
        """A person's command: arm, disarm, approve ID, lock REASON, unlock REASON, rollback."""
        self._desk.host_s = host_s
        reason = argument or "no reason given"
        verbs: dict[str, Callable[[], Answer]] = {
            "arm": partial(self._arm, True),
            "disarm": partial(self._arm, False),
            "approve": partial(self._flow.approve, argument),
            "lock": partial(self._flow.lock, reason),
            "unlock": partial(self._flow.unlock, reason),
            "rollback": self._flow.roll_back_by_hand,
        }
        if verb in verbs:
            self.operator_answer = verbs[verb]()
        else:
            self.operator_answer = False, f"{verb!r} is no command; possible: {', '.join(verbs)}"
        if not self.operator_answer[0]:
            self._desk.note("warning", f"operator: {verb} refused: {self.operator_answer[1]}")
        return self._answer()

    def on_trial_metrics(self, metrics: TrialMetrics, host_s: float) -> list[Action]:
        """The new registers against the old ones on live samples."""
        self._desk.host_s = host_s
        if self.state is State.TRIAL and metrics.finite:
            self._flow.deadline_s = host_s + ON_TIMEOUT[State.TRIAL][0]
            finding, reason = self._flow.trial.judge(metrics)
            if finding is Finding.FAILED:
                self._flow.roll_back("trial", reason)
            elif finding is Finding.PASSED:
                self._desk.record(Kind.PROVEN, reason=reason)
                self._flow.signal(Signal.TRIAL_PASSED, reason)
        return self._answer()

    def on_stop(self, host_s: float) -> list[Action]:
        """The daemon ends: what is only in RAM is undone, unless it is proven and to be kept."""
        self._desk.host_s, self._safe.stopping = host_s, True
        if not (self.policy.keep_on_stop and self.state is State.PROVEN):
            self._flow.roll_back("stop", "the daemon stops")
        return self._answer()

    def on_journal_ok(self, kind: Kind, host_s: float) -> list[Action]:
        """The record is on the disk."""
        self._desk.host_s, self._safe.journal_ok = host_s, True
        if _AWAITED.get(self.state) is kind:
            self._flow.signal(Signal.JOURNALLED, f"{kind.value} is in the journal")
        return self._answer()

    def on_journal_failed(self, kind: Kind, error: str, host_s: float) -> list[Action]:
        """The record is not on the disk. What waited for it does not happen."""
        self._desk.host_s, self._safe.journal_ok = host_s, False
        self._desk.note("error", f"{kind.value} could not be journalled: {error}")
        if _AWAITED.get(self.state) is kind:
            self._flow.signal(Signal.JOURNAL_FAILED, error)
        return self._answer()

    def on_procedure_finished(self, name: str, result: object, host_s: float) -> list[Action]:
        """A conversation ended and returned an Outcome."""
        self._desk.host_s = host_s
        if name == self._desk.running and isinstance(result, Outcome):
            self._desk.running = ""
            self._flow.on_outcome(result)
        return self._answer()

    def on_procedure_failed(self, name: str, error: Exception, host_s: float) -> list[Action]:
        """A conversation broke off: the device may be anywhere between old and new."""
        self._desk.host_s = host_s
        if name == self._desk.running:
            self._desk.running = ""
            self._flow.on_failure(str(error))
        return self._answer()

    def _arm(self, armed: bool) -> Answer:
        """Whether this run may begin a write or a save; what is under way is not undone."""
        self._safe.armed = armed
        text = "armed: this run may write" if armed else NOT_ARMED
        self._desk.note("info", text)
        if armed and self.policy.mode < Mode.STAGE:
            return False, f"{self._flow.mode_forbids}"
        return True, text if armed else "disarmed: this run writes nothing by itself"

    def _answer(self) -> list[Action]:
        """Take the steps that are due now, then hand over everything that was asked for."""
        self._flow.watch()
        return self._desk.take()
