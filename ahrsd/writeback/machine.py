"""The write-back: one object that takes inputs and returns actions. Pure and deterministic.

The core calls the `on_...` methods with the host's monotonic time and carries out the returned
`actions` in that order. The gate in front of each command checks interlock and rest at the newest
host time, so `tick` must be called before bytes are given to the session.

Guarantees that the tests check (tests/writeback/test_machine.py):

* PREPARED is on the disk before the first byte of a transaction, FLASH_SENT before VNWNV;
* a rollback needs neither interlock nor journal: the vehicle worked with the old values before;
* in mode `observe` nothing is ever started: QUALIFIED shows the exact bytes of a possible write.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.events import GateResult
from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.actions import Action, IdentifyAgain, Look
from ahrsd.writeback.composition import GYRO, MAG, Proposal
from ahrsd.writeback.device_watch import Recheck, RestartWatch
from ahrsd.writeback.flow import Answer, Flow
from ahrsd.writeback.journal_history import JournalHistory, JournalRecord, RecordKind
from ahrsd.writeback.policy import WriteBackPolicy, margin
from ahrsd.writeback.states import (
    CHANGED_IN_RAM,
    LIVED_WITH,
    ON_TIMEOUT,
    WITHOUT_TRANSACTION,
    Mode,
    Signal,
    State,
)
from ahrsd.writeback.transaction import HSI_RESULT, ProcedureOutcome
from ahrsd.writeback.trial import TrialMetrics, TrialVerdict
from drivers.vn100.commands import Identity, Seen, differences
from drivers.vn100.registers import COMPENSATING, ROTATION, Values, same

RESTS = frozenset(  # states in which a proven restart since the newest record causes a new reading
    {
        State.CANDIDATE,
        State.QUALIFIED,
        State.TRIAL,
        State.PROVEN,
        State.COMMITTED,
        State.FAULT,
        State.LOCKED,
    }
)

_AWAITED = {
    State.PREPARING: RecordKind.PREPARED,
    State.STAGED: RecordKind.RAM_VERIFIED,
    State.SAVE_PREPARING: RecordKind.FLASH_SENT,
}
_CLIENTS_WAIT_IN = CHANGED_IN_RAM | {State.RECONCILING, State.PREPARING, State.CHECKING}
_SWITCH = "switch the device off and on"
_MAY_HOLD = f"the device may hold values of a trial: {_SWITCH}"
_NO_LOOK_IN = (State.RECONCILING, State.SAVE_PREPARING)  # the device is read in these states anyway


class WriteBack:
    """See the module and `states`. Every `on_...` returns the resulting actions, in order."""

    def __init__(self, policy: WriteBackPolicy) -> None:
        self.policy = policy
        self._flow = Flow(policy)
        self._outbox = self._flow.outbox
        self._safe = self._flow.safe
        self._gyro_bias_rad_s: Array = np.zeros(3)
        self._restarts = RestartWatch()
        self._read_after_restart_s = float("-inf")  # when it was read last behind a proven restart
        self.operator_answer: Answer = (False, "no command yet")  # to the newest `on_operator` call
        self._recheck = Recheck(policy.recheck_s)
        self._sampled_to_s = float("-inf")  # when the device was asked
        self._changed_in_run: dict[
            int, frozenset[int]
        ] = {}  # registers by serial number; see `_changed_by_others`
        self._rotations: dict[int, Values] = {}  # by serial number; see `_rotation_waits`
        self._reset_seen = False  # since the device was read
        self.confirmed_s: float | None = None  # see `on_looked`

    # -- read by others ----------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """The state of the write-back."""
        return self._flow.state

    @property
    def proposal(self) -> Proposal | None:
        """The qualified candidate, as an operator approves it; None if there is none."""
        return self._flow.proposal

    @property
    def history(self) -> JournalHistory:
        """Summary of the device's journal."""
        return self._outbox.history

    @property
    def mode(self) -> Mode:
        """The effective mode: at most observe while the device or its journal is in doubt."""
        return self._safe.mode

    @property
    def margin(self) -> float:
        """Factor on the improvement that the gates require."""
        return margin(self.policy, self.history)

    @property
    def deadline_s(self) -> float | None:
        """When `tick` must be called at the latest."""
        deadlines = [self._flow.deadline_s, self._outbox.journal_retry_s, self._recheck.due_s]
        if (aside := self._flow.aside) is not None and not aside.settled(self._outbox.host_s):
            deadlines.append(aside.settled_s)
        if self._flow.watches_interlock:
            deadlines.append(self._outbox.host_s + self.policy.interlock_max_age_s)
        return min((d for d in deadlines if d is not None), default=None)

    @property
    def idle(self) -> bool:
        """Whether nothing is under way that must end before the daemon may stop."""
        return not self._outbox.running and self.state not in CHANGED_IN_RAM - {State.PROVEN}

    @property
    def client_save_refusal(self) -> str | None:
        """Why RAM is not saved for a client; "" if it may be; None: not yet, or values are undone
        first.

        Never while RAM may hold unproven values. After a proven restart RAM equals flash, and a
        save changes nothing.
        """
        history = self.history
        foreign = history.locked is not None and history.last is RecordKind.FOREIGN
        if foreign or self.state in (State.FAULT, State.FLASH_TORN):
            return "the device's registers are in doubt"
        if self.client_reset_refusal is None or self.state is State.RECONCILING:
            return None
        restarted_s = max(self._restarts.fell_s, self._read_after_restart_s)
        if self._flow.identity is None or restarted_s > self._flow.staging_s:
            return ""
        if not self._safe.journal_read:
            return f"the journal cannot be read, so {_MAY_HOLD}"
        registers = self._flow.registers
        tried = [
            n for n in (MAG, GYRO) if n in registers and history.is_trial_value(n, registers[n])
        ]
        which = ", ".join(map(str, tried))
        return (
            f"register {which} holds a value of a trial that was undone: {_SWITCH}" if which else ""
        )

    @property
    def client_reset_refusal(self) -> str | None:
        """The same for a reset, which is harmless even if the registers are unknown."""
        between = self.state in _CLIENTS_WAIT_IN and self.state is not State.RECONCILING
        return None if between or self._outbox.running else ""

    def obstacles(self) -> list[str]:
        """All reasons why the next step is not taken now, each with a remedy."""
        now = (self.history, self._outbox.host_s, self._outbox.now)
        if self.state is State.SET_ASIDE:
            return self._flow.rewrite_obstacles()
        if self.state is State.PROVEN:
            return self._safe.save_obstacles(*now)
        reasons = self._safe.write_obstacles(*now)
        if self.proposal is not None and not self._flow.approver:
            reasons.append(f"an operator must approve {self.proposal.id}")
        return reasons

    # -- inputs ------------------------------------------------------------------------------------

    def tick(self, host_s: float) -> list[Action]:
        """Handle the time: timeouts, a stale interlock, a write or save that may start now."""
        self._outbox.host_s = host_s
        if self._flow.deadline_s is not None and host_s >= self._flow.deadline_s:
            self._flow.on_timeout()
        if (again_s := self._outbox.journal_retry_s) is not None and host_s >= again_s:
            self._outbox.retry_journal()
        if self._recheck.is_due(host_s):
            self._request_look()
        return self._take_actions()

    def on_clock(
        self, wall_s: float, boot_id: str, boot_s: float | None, host_s: float
    ) -> list[Action]:
        """Take the host's other clocks; the wall clock may have been adjusted."""
        self._outbox.host_s = host_s
        self._outbox.set_clocks(wall_s, boot_id, boot_s)
        return self._take_actions()

    def on_device(
        self,
        identity: Identity,
        registers: Mapping[int, Values],
        journal: Sequence[JournalRecord] | None,
        host_s: float,
        *,
        session_keys: frozenset[int] = frozenset(),
        clients: frozenset[int] = frozenset(),
        read_from_s: float = float("inf"),
    ) -> list[Action]:
        """The device was identified and read: at the start, after a reset, after a lost link.

        registers:    all that were read; `session_keys` (which the daemon changes for its session,
                      or `clients` for theirs) with the values that the user had
        read_from_s:  when the reading of them began; see `on_uptime`
        journal:      this device's records, oldest first; None where they cannot be trusted
        """
        flow, self._outbox.host_s = self._flow, host_s
        self._recheck.restart(host_s)
        self._outbox.bind(identity.serial, journal)
        restarted = self._restarts.bind(identity.serial, read_from_s)
        changed = self._changed_by_others(identity, registers, session_keys, restarted)
        if flow.identity is None or flow.identity.serial != identity.serial:
            self._safe.client_wrote = {}
            self._read_after_restart_s = float("-inf")
        if restarted:
            self._read_after_restart_s = host_s
        self._changed_in_run[identity.serial] = self._safe.update_changed_by_others(
            changed, registers
        )
        self._outbox.rotation_waits = self._rotation_waits(identity.serial, registers, restarted)
        self._safe.bind(identity, registers, journal is not None, self._outbox.rotation_waits)
        self._safe.client_registers = clients
        flow.identity, flow.registers, flow.session_keys = identity, dict(registers), session_keys
        self._outbox.set_in_force(registers)
        if self.state is not State.RECONCILING:
            flow.enter(State.RECONCILING, "the device was read again")
        unfinished = self.history.open
        self._safe.armed |= unfinished is not None and unfinished.approver == "operator"
        flow.reconcile(restarted)
        return self._take_actions()

    def on_no_device(self, registers: Mapping[int, Values] | None, host_s: float) -> list[Action]:
        """There is no device to ask: mode passive, or a recording. Registers, if known."""
        self._outbox.host_s = host_s
        self._restarts.on_link_lost()
        self._recheck.stop()
        identity = Affine.identity().to_register()
        self._flow.registers = {MAG: identity, GYRO: identity, **(registers or {})}
        self._safe.set_no_device("there is no device to write to")
        self._flow.signal(Signal.NOTHING_OPEN, "no device to ask")
        return self._take_actions()

    def on_link_lost(self, host_s: float) -> list[Action]:
        """The port was lost."""
        self._outbox.host_s = host_s
        self._restarts.on_link_lost()
        self._flow.signal(Signal.LINK_LOST, "the link was lost")
        return self._take_actions()

    def on_reset(
        self, host_s: float, uptime_s: float | None = None, client: str = ""
    ) -> list[Action]:
        """The device restarted: its RAM equals its flash. `on_device` must follow.

        uptime_s: its time since then, if that showed the restart; it must agree with the journal
        client:   the client whose VNRST it was; empty: none
        """
        self._outbox.host_s = host_s
        self._reset_seen = True
        self._restarts.on_restart(self.history.last_at, self._outbox.stamp, host_s, uptime_s)
        if client:
            self._flow.signal(Signal.CLIENT_RESET, f"{client} reset the device")
        else:
            self._flow.signal(Signal.DEVICE_RESET, "the device restarted")
        return self._take_actions()

    def on_uptime(
        self, uptime_s: float, host_s: float, heard_s: float | None = None
    ) -> list[Action]:
        """Take the device's time since start-up from its stream: detects unnoticed restarts.

        A restart since the registers were read makes that reading void. Only a restart shows what
        a save left in flash, so the device is read again then.

        heard_s: when the message came, if that was before now
        """
        outbox, record = self._outbox, self.history.last_at
        outbox.host_s, heard_s = host_s, host_s if heard_s is None else heard_s
        if outbox.running:
            self._restarts.mark_doubt()
        reason, stamp = self._restarts.on_uptime(uptime_s, heard_s), outbox.stamp_at(heard_s)
        if reason:
            self._restarts.on_restart(record, stamp, heard_s, uptime_s)
        elif (
            self.history.open is not None
            and self.state in RESTS
            and self._restarts.proves_restart(record, stamp, heard_s)
        ):
            self._restarts.on_restart_proven()
            reason = "the device restarted since the journal's newest record"
        elif not self._restarts.is_doubtful(heard_s):
            outbox.device_s = uptime_s + host_s - heard_s
        if reason:
            self._flow.signal(Signal.DEVICE_RESET, reason)
            outbox.append(IdentifyAgain())
        return self._take_actions()

    def on_looked(self, seen: Seen | None, error: str, host_s: float) -> list[Action]:
        """Result of a look: who answered with which registers, or why nobody did.

        If all is as expected, `confirmed_s` is the host time of the request; else None.
        """
        self._outbox.host_s, flow, self.confirmed_s = host_s, self._flow, None
        self._recheck.unanswered = False
        if flow.identity is None or self.state is State.RECONCILING or self._outbox.running:
            return self._take_actions()  # superseded
        if seen is None:
            self._outbox.note(
                "warning", f"the device does not say who it is and what it holds: {error}"
            )
            self._recheck.schedule_soon(host_s)
        elif seen.unit != flow.identity.unit:
            self._restarts.on_other_device()
            flow.on_other_device(seen.unit)
        elif changed := differences(flow.expected_values(seen.values), seen.values):
            flow.on_registers_changed(tuple(changed))
        else:
            self.confirmed_s = self._recheck.asked_s
            self._restarts.on_confirmed(self._recheck.asked_s, host_s)
            self._safe.record_look_duration(host_s - self._recheck.asked_s)
            flow.proven_to_s = self._sampled_to_s if flow.trial_passed else None
            if flow.aside is not None:
                flow.aside.confirmed_s = self._recheck.asked_s
        return self._take_actions()

    def on_waiting(self, span_s: float, host_s: float) -> list[Action]:
        """So many seconds of samples wait until the device is confirmed again.

        A stream that is played faster than real time fills them up sooner than the clock.
        """
        self._outbox.host_s = host_s
        if span_s >= self.policy.recheck_s and not self._recheck.unanswered:
            self._recheck.schedule_soon(host_s)
        return self._take_actions()

    def on_doubt(self, reason: str, host_s: float, *, jumped: bool = False) -> list[Action]:
        """The stream raises a doubt whether this is still the device that was read.

        jumped: its readings jumped, so proven values must be proven again.
        """
        self._outbox.host_s = host_s
        self._outbox.note("debug", f"{reason}: the device is asked again who it is")
        self._safe.mark_doubt(host_s)
        self._restarts.mark_doubt(host_s)
        self._flow.proven_to_s = None
        if jumped:
            self._flow.prove_again(reason)
        self._recheck.schedule_soon(host_s)
        return self._take_actions()

    def on_samples(self, block: SampleBlock) -> list[Action]:
        """Take raw samples, to check whether the vehicle is at rest."""
        if len(block):
            self._safe.sampled_s = float(block.host_s[-1])
        self._safe.stillness.update(block, self._gyro_bias_rad_s)
        return self._take_actions()

    def on_interlock(self, safe: bool, host_s: float) -> list[Action]:
        """Take the interlock signal of the vehicle."""
        self._outbox.host_s = host_s
        self._safe.set_interlock(safe, host_s)
        return self._take_actions()

    def on_verdict(
        self,
        estimate: Estimate,
        gates: tuple[GateResult, ...],
        at_s: float,
        host_s: float,
        *,
        flash_gates: tuple[GateResult, ...] = (),
        gyro_is_raw: bool = True,
        sampled_s: float | None = None,
    ) -> list[Action]:
        """A new estimate and the gates' results: for RAM (no gates: not passed), and for flash.

        gyro_is_raw: see `composition.compose`.
        sampled_s:   host time of the newest sample that was judged; None: now
        """
        self._outbox.host_s, self._outbox.at_s = host_s, at_s
        self._safe.judged_s = host_s if sampled_s is None else sampled_s
        fresh = sampled_s is None or sampled_s > self._safe.doubt_s
        self._safe.gates, self._safe.flash_gates = gates, flash_gates if fresh else ()
        if np.isfinite(estimate.gyro_bias_rad_s).all():
            self._gyro_bias_rad_s = estimate.gyro_bias_rad_s
        if self.state in WITHOUT_TRANSACTION:
            self._flow.consider_estimate(estimate, gyro_is_raw)
        elif self.state in LIVED_WITH:
            self._flow.compare_estimate(estimate, gyro_is_raw)
        elif self.state is State.SET_ASIDE:
            self._flow.judge_aside(estimate, gyro_is_raw)
        return self._take_actions()

    def on_void(self, reason: str, at_s: float, host_s: float) -> list[Action]:
        """Earlier calibrations are void: something on the vehicle changed."""
        self._outbox.host_s, self._outbox.at_s = host_s, at_s
        self._safe.mark_doubt(host_s)
        self._flow.void_calibration(reason)
        return self._take_actions()

    def on_examined(self, sampled_s: float, host_s: float) -> list[Action]:
        """The estimate now includes the samples up to this host time."""
        self._outbox.host_s, self._safe.examined_s = host_s, sampled_s
        return self._take_actions()

    def on_estimator_failed(self, host_s: float) -> list[Action]:
        """The estimator failed: drop estimate and verdict, and end what depends on them."""
        self._outbox.host_s = host_s
        self._safe.gates = self._safe.flash_gates = ()
        self._flow.signal_if(Signal.NOT_WORTH_WRITING, "the estimator failed")
        self._flow.roll_back("estimator", "the estimator failed: nobody judges the new values")
        return self._take_actions()

    def on_limits_changed(self, host_s: float) -> list[Action]:
        """The gates have other limits: their earlier verdict no longer counts."""
        self._outbox.host_s = host_s
        self._safe.gates = self._safe.flash_gates = ()
        self._flow.signal_if(Signal.NOT_WORTH_WRITING, "the limits of the gates were changed")
        return self._take_actions()

    def on_operator(self, verb: str, argument: str, host_s: float) -> list[Action]:
        """An operator's command: arm, disarm, approve ID, lock REASON, unlock REASON, rollback."""
        self._outbox.host_s = host_s
        reason = argument or "no reason given"
        verbs: dict[str, Callable[[], Answer]] = {
            "arm": partial(self._set_armed, True),
            "disarm": partial(self._set_armed, False),
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
            self._outbox.note("warning", f"operator: {verb} refused: {self.operator_answer[1]}")
        return self._take_actions()

    def on_trial_metrics(self, metrics: TrialMetrics, host_s: float) -> list[Action]:
        """Compare the new registers with the old ones on live samples."""
        self._outbox.host_s = host_s
        if self.state in (State.TRIAL, State.PROVEN) and metrics.finite:
            self._flow.deadline_s = host_s + ON_TIMEOUT[self.state][0]
            finding, reason = self._flow.trial.judge(metrics)
            if self.state is State.PROVEN:
                self._flow.judge_proof(finding, reason)
            elif finding is TrialVerdict.FAILED:
                self._flow.roll_back("trial", reason)
            elif finding is TrialVerdict.PASSED and not self._flow.trial_passed:
                self._recheck.schedule_now(host_s)  # to prove what it still holds
                self._request_look()
            if self.state is State.TRIAL:
                self._flow.trial_passed = reason if finding is TrialVerdict.PASSED else ""
                if not self._flow.trial_passed:
                    self._flow.proven_to_s = None
        return self._take_actions()

    def on_client_settings(
        self,
        session_keys: frozenset[int],
        clients: frozenset[int],
        host_s: float,
    ) -> list[Action]:
        """A client set registers for its session.

        session_keys: all registers with values of a session; clients: those of clients
        """
        self._outbox.host_s, self._flow.session_keys = host_s, session_keys
        self._safe.client_registers = clients
        return self._take_actions()

    def on_client_wants(self, client: str, does: str, host_s: float) -> list[Action]:
        """A client "saves" all of RAM or "resets" the device: undo values on trial first."""
        self._outbox.host_s = host_s
        self._flow.set_aside(client, does)
        return self._take_actions()

    def on_client_failed(self, does: str, why: str, host_s: float) -> list[Action]:
        """The device refused that command, or its result is unknown."""
        self._outbox.host_s = host_s
        self._flow.client_command_ended(does, why)
        return self._take_actions()

    def on_client_reset(self, client: str, host_s: float) -> list[Action]:
        """The device acknowledged a client's VNRST; `on_reset` follows."""
        self._outbox.host_s = host_s
        if self._flow.identity is not None:
            self._outbox.record(
                RecordKind.CLIENT_RESET, client=client, serial=self._flow.identity.serial
            )
        self._flow.client_command_ended("resets")
        return self._take_actions()

    @property
    def expected_device(self) -> Seen | None:
        """The device and registers required for a permanent change; None: no device was read."""
        flow = self._flow
        if flow.identity is None:
            return None
        return Seen(
            flow.identity.unit, {n: v for n, v in flow.registers.items() if n in COMPENSATING}
        )

    def on_client_waits(self, reason: str, host_s: float) -> list[Action]:
        """A client's save or write was not sent; `reason`: how the device differs, if it does."""
        self._outbox.host_s = host_s
        self._flow.drop_client_write()
        if reason and self.state is not State.RECONCILING:
            self._outbox.note("warning", f"held back for a client: {reason}")
            self._flow.reread_device(reason)
        return self._take_actions()

    def client_write_refusal(self, number: int) -> str | None:
        """Why a client may not write this register now; "" if it may; None: not yet."""
        return self._flow.client_write_refusal(number)

    def on_client_writes(
        self, client: str, number: int, values: Values, host_s: float
    ) -> tuple[list[Action], bool]:
        """A client's calibration write is next: actions, and whether it may be sent.

        Called again until the journal has it. From then on the registers in force are unknown,
        until `on_client_wrote`. If it is not sent after all: `on_client_dropped`.
        """
        self._outbox.host_s, write = host_s, self._flow.client_write
        if self._flow.client_write_ready:
            self._outbox.set_in_force(None)
            return self._take_actions(), True
        if write is None or write.journaled:
            self._flow.journal_client_write(client, number, values)
        return self._take_actions(), False

    def on_client_dropped(self, host_s: float) -> list[Action]:
        """The journaled write is not sent: its client disconnected, or it waited too long.

        The next one, even of the same values, is a separate write.
        """
        self._outbox.host_s = host_s
        self._flow.drop_client_write()
        return self._take_actions()

    def on_client_wrote(self, host_s: float) -> list[Action]:
        """That write was carried out or refused, or its result is unknown."""
        self._outbox.host_s = host_s
        self._flow.on_client_wrote()
        return self._take_actions()

    def on_client_saved(
        self,
        client: str,
        saved: Mapping[int, Values],
        session_keys: frozenset[int],
        host_s: float,
    ) -> list[Action]:
        """RAM was saved for a client; `saved`: settings of clients, which are the user's now."""
        self._outbox.host_s, self._flow.session_keys = host_s, session_keys
        self._safe.client_registers = frozenset()
        self._flow.registers = {**self._flow.registers, **saved}
        self._safe.changed_by_others = frozenset()  # any change is permanent now
        self._safe.client_wrote = {}
        if self._flow.identity is not None:
            self._changed_in_run.pop(self._flow.identity.serial, None)
            self._outbox.record(
                RecordKind.CLIENT_SAVED, client=client, serial=self._flow.identity.serial
            )
        self._flow.client_command_ended("saves")
        return self._take_actions()

    def on_stop(self, host_s: float) -> list[Action]:
        """The daemon stops: undo values that are only in RAM, unless proven and to be kept."""
        self._outbox.host_s, self._safe.stopping = host_s, True
        self._outbox.retry_journal()
        if not (self.policy.keep_on_stop and self.state is State.PROVEN):
            self._flow.roll_back("stop", "the daemon stops")
        return self._take_actions()

    def on_journal_ok(self, kind: RecordKind, host_s: float) -> list[Action]:
        """The record is on the disk."""
        self._outbox.host_s = host_s
        self._safe.journal_ok = self._outbox.on_journaled(kind)
        if kind is RecordKind.CLIENT_WRITES:
            self._flow.on_client_write_journaled(True)
        if _AWAITED.get(self.state) is kind:
            self._flow.signal(Signal.JOURNALLED, f"{kind.value} is in the journal")
        return self._take_actions()

    def on_journal_failed(self, kind: RecordKind, error: str, host_s: float) -> list[Action]:
        """The record could not be written: the step that waited for it is not taken."""
        self._outbox.host_s, self._safe.journal_ok = host_s, False
        self._outbox.on_journal_failed(kind)
        if kind is RecordKind.CLIENT_WRITES:
            self._flow.on_client_write_journaled(False)
        self._outbox.note("error", f"{kind.value} could not be journalled: {error}")
        if _AWAITED.get(self.state) is kind:
            self._flow.signal(Signal.JOURNAL_FAILED, error)
        return self._take_actions()

    def on_procedure_finished(self, name: str, result: object, host_s: float) -> list[Action]:
        """A procedure ended and returned a ProcedureOutcome."""
        self._outbox.host_s = host_s
        if name == self._outbox.running and isinstance(result, ProcedureOutcome):
            self._outbox.running = ""
            self._restarts.mark_doubt()  # the stream was not watched
            if result.other is not None:
                self._restarts.on_other_device()
            self._flow.on_outcome(result)
            self._recheck.schedule_now(host_s)
        return self._take_actions()

    def on_procedure_failed(self, name: str, error: Exception, host_s: float) -> list[Action]:
        """A procedure broke off: the device may be anywhere between old and new."""
        self._outbox.host_s = host_s
        if name == self._outbox.running:
            self._outbox.running = ""
            self._restarts.mark_doubt()
            self._flow.on_failure(error)
            self._recheck.schedule_now(host_s)  # unknown which device was silent, or refused
        return self._take_actions()

    def _changed_by_others(
        self,
        identity: Identity,
        registers: Mapping[int, Values],
        session_keys: frozenset[int],
        restarted: bool,
    ) -> frozenset[int]:
        """Registers that other programs changed in RAM in this run; a restart clears them.

        Registers of an open transaction are judged by `reconcile`.
        """
        before = self._flow.identity
        changed = (
            frozenset() if restarted else self._changed_in_run.get(identity.serial, frozenset())
        )
        if before is not None and before.serial == identity.serial and not restarted:
            known = self._flow.registers
            written = set() if self.history.open is None else set(self.history.open.new)
            compared = known.keys() & registers.keys() - session_keys - written - {HSI_RESULT}
            changed |= {n for n in compared if not same(n, known[n], registers[n])}
        return changed

    def _rotation_waits(
        self, serial: int, registers: Mapping[int, Values], restarted: bool
    ) -> bool:
        """Whether register 26 was changed in this run: unlike all others it acts after a restart.

        What it held when this run read it first counts as what acts.
        """
        if (rotation := registers.get(ROTATION)) is None:
            return False
        if restarted or self._reset_seen:
            self._rotations[serial] = rotation
        self._reset_seen = False
        return not same(ROTATION, self._rotations.setdefault(serial, rotation), rotation)

    def _request_look(self) -> None:
        """Request a look at identity and registers, unless something else runs."""
        flow, now_s = self._flow, self._outbox.host_s
        self._recheck.restart(now_s)
        if self._safe.sampled_s is not None:
            self._sampled_to_s = self._safe.sampled_s
        if flow.identity is None or self._outbox.running or self.state in _NO_LOOK_IN:
            self._recheck.schedule_soon(now_s)
            return
        expected = {n: flow.registers[n] for n in COMPENSATING if n in flow.registers}
        self._recheck.unanswered = True
        self._outbox.append(Look(flow.identity.unit, expected))

    def _set_armed(self, armed: bool) -> Answer:
        """Set whether this run may begin a write or a save; nothing under way is undone."""
        text = self._safe.set_armed(armed)
        self._outbox.note("info", text)
        if armed and self.policy.mode < Mode.STAGE:
            return False, f"{self._flow.mode_forbids}"
        return True, text if armed else "disarmed: this run writes nothing by itself"

    def _take_actions(self) -> list[Action]:
        """Take the steps that are due now; returns all actions."""
        self._flow.take_due_step()
        if self._flow.waits_for_look:
            self._recheck.schedule_soon(self._outbox.host_s)
        return self._outbox.take_actions()
