"""The transitions of the state machine, and the actions on entering each state.

`states.TABLE` maps state and signal to the next state; this module adds the actions on entry.

**Set aside.** Values on trial, while a program on a shared port saves all of RAM or resets the
device.

Only proven values may get to flash, so the values on trial are undone before that save. This is
journaled like any rollback, so recovery after a power cut works as usual. After the save they are
written again as a separate transaction: prepared in the journal, checked, written, read back and
tried from the beginning, because samples in between are not of the new values. The approval is
carried over, and with it all conditions of a write (`Flow.rewrite_obstacles`). It counts as a write
of the day's budget; only the interval between two writes is not required.

The second write needs the acknowledgement of the client's command and, `SETTLE_S` after it, a
confirmation that the device is the same one with the same registers: a failed save is reported up
to 1.5 s late. Before a reset the values are undone in the same way, so that no transaction is open
when the device restarts. Then it is identified and read as after any restart, and its trial stays
set aside only if it is the same device with the same registers. Any other loss of the device ends
it: a restart that no program requested, a lost link, a doubt about the device.

**Client's write.** A client's write of calibration registers, if its share has
`calibration = "pass"`.

It is a change by another program and is treated as one. It is journaled before it is sent, with the
values before and after. While it is under way, the registers in force are unknown. After it,
whatever the reply, the device is read again, which also detects changes by others. Registers
changed in this way are not saved by a save of ahrsd's.

It is refused while values of ahrsd are in RAM, are about to be, or wait for their confirmation:
otherwise the result of an undo would depend on the order of the writes. An operator ends the trial
first. A transaction that begins later has the client's values as its old ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

from ahrsd.calibration import Affine, Estimate
from ahrsd.writeback.actions import ActionOutbox, CalibrateAnew, IdentifyAgain, SetUpStream
from ahrsd.writeback.composition import (
    GYRO,
    MAG,
    Proposal,
    UnwritableError,
    compose,
    proposal_distance_deg,
)
from ahrsd.writeback.journal_history import RecordKind, Transaction
from ahrsd.writeback.permissions import permitted
from ahrsd.writeback.policy import Safeguards, WriteBackPolicy, contradicts, worth_writing
from ahrsd.writeback.reconcile import TABLE as RECONCILE
from ahrsd.writeback.reconcile import DeviceContents, compare_contents
from ahrsd.writeback.states import (
    LIVED_WITH,
    ON_TIMEOUT,
    TABLE,
    WITHOUT_TRANSACTION,
    Mode,
    Purpose,
    Signal,
    State,
)
from ahrsd.writeback.transaction import ProcedureOutcome, check, roll_back, save, stage
from ahrsd.writeback.trial import Trial, TrialVerdict
from drivers.vn100.commands import Command, Identity, VerifyFailed, differences
from drivers.vn100.registers import COMPENSATING, Unit, Values, register_lines, same

# -- Programs on shared ports ----------------------------------------------------------------------


SETTLE_S: Final = 2.0  # after the acknowledgement, before the device may be asked


@dataclass(slots=True)
class SetAside:
    """A transaction that was undone for a client.

    does:    the client's command: "saves" or "resets"
    holds:   compensating registers that the device must hold until the second write
    until_s: the end of all waiting, host time like the others
    done_s:  when the device acknowledged the client's command
    confirmed_s: time of the newest request that confirmed the device
    """

    transaction: Transaction
    client: str
    does: str
    holds: dict[int, Values] = field(default_factory=dict)
    until_s: float | None = None
    done_s: float | None = None
    confirmed_s: float = float("-inf")

    @property
    def settled_s(self) -> float | None:
        """When the device may be asked; None before the acknowledgement."""
        return None if self.done_s is None else self.done_s + SETTLE_S

    def settled(self, host_s: float) -> bool:
        """Whether the device may be asked now."""
        return self.settled_s is not None and host_s >= self.settled_s

    def waits_for_look(self, doubt_s: float, host_s: float) -> bool:
        """Whether only a confirmation of the device is missing. `doubt_s`: of the last doubt."""
        return self.settled(host_s) and not self.confirmed(doubt_s)

    def confirmed(self, doubt_s: float) -> bool:
        """Whether the device was confirmed after the command and after any doubt."""
        settled_s = self.settled_s
        return settled_s is not None and self.confirmed_s >= max(settled_s, doubt_s)


@dataclass(slots=True)
class ClientWrite:
    """A client's calibration write, as journaled.

    serial, old: the unit it is for, and the register's value at that time
    journaled:   whether the record is on the disk
    dropped:     it will not be sent, whatever the journal answers
    """

    client: str
    number: int
    values: Values
    serial: int | None
    old: Values
    journaled: bool = False
    dropped: bool = False


# -- The state machine -----------------------------------------------------------------------------


RETRY_SAVE_S = 600.0  # wait after a save that was not sent
Answer = tuple[bool, str]  # to an operator: whether it is accepted, and consequences or reason
COUNTED = frozenset({"trial", "interlock", "operator"})  # causes that count against the values
_ASIDE = (State.ROLLING_BACK, State.SET_ASIDE, State.PREPARING)  # states that keep `aside`
_DEVICE_LOST = (Signal.LINK_LOST, Signal.DEVICE_RESET, Signal.IN_DOUBT)


class Flow:
    """The state machine behind `machine.WriteBack`."""

    def __init__(self, policy: WriteBackPolicy) -> None:
        self.policy = policy
        self.safe = Safeguards(policy)
        self.outbox = ActionOutbox(self._allowed)
        self.state = State.RECONCILING
        self.deadline_s: float | None = None
        self.identity: Identity | None = None
        self.registers: dict[int, Values] = {}
        self.session_keys: frozenset[int] = frozenset()
        self.proposal: Proposal | None = None
        self.approver = ""
        self.trial = Trial(policy.trial, 0.0)
        self.trial_passed = ""  # why the trial passed, until the device is confirmed
        self.proven_to_s: float | None = None  # newest sample at that confirmation
        self.waits_for_look = False  # only a confirmation of the device is missing
        self.aside: SetAside | None = None  # undone for a client
        self.client_write: ClientWrite | None = None  # of what calibrates
        self.staging_s = float("-inf")  # when this run last wrote new values
        self._cause = "device"
        self._altered_values: dict[int, Values] = {}  # our values as the device altered them
        self._from_fault = self._resumed = False
        self._against_since_s: float | None = None
        self._since_s = 0.0
        self._save_from_s = float("-inf")
        self._on_entry: dict[State, Callable[[str], None]] = {
            State.RECONCILING: self._enter_reconciling,
            State.OBSERVING: self._enter_rest,
            State.CANDIDATE: self._enter_candidate,
            State.QUALIFIED: self._enter_qualified,
            State.PREPARING: self._enter_preparing,
            State.CHECKING: self._enter_checking,
            State.STAGING: self._enter_staging,
            State.STAGED: self._enter_staged,
            State.TRIAL: self._enter_trial,
            State.PROVEN: self._enter_proven,
            State.SAVE_PREPARING: lambda _: self.outbox.record(RecordKind.FLASH_SENT),
            State.SAVING: self._enter_saving,
            State.COMMITTED: self._enter_rest,
            State.CONFIRMED: self._enter_rest,
            State.ROLLING_BACK: self._enter_rolling_back,
            State.ROLLED_BACK: self._enter_rest,
            State.SET_ASIDE: self._enter_set_aside,
            State.FAULT: self._enter_fault,
        }

    def _allowed(self, command: Command, purpose: Purpose, host_s: float) -> bool:
        """The gate in front of every command of the write-back: permissions, then safeguards."""
        mode, changes = self.safe.mode_for(purpose), self.policy.configure_stream
        if not permitted(command, mode, changes, purpose, self.safe.client_registers):
            return False
        return self.safe.allow(command, purpose, host_s)

    # -- transitions -------------------------------------------------------------------------------

    def signal(self, signal: Signal, reason: str) -> None:
        """Move to the state that the table gives; a signal that it does not name is ignored."""
        target, aside = TABLE[self.state].get(signal), self.aside
        if target is None:
            self.outbox.note("debug", f"{signal.value} is ignored in {self.state.value}: {reason}")
        elif target is not self.state:
            set_aside = self.state is State.SET_ASIDE
            self.enter(target, reason)
            if set_aside and signal is Signal.CLIENT_RESET:
                self.aside = aside
            elif set_aside and target is State.RECONCILING:
                self._note_not_rewritten(reason)
        elif signal in _DEVICE_LOST:
            self.forget_aside(reason)

    def enter(self, state: State, reason: str) -> None:
        """Enter a state. Cancels a procedure of the old one."""
        self.outbox.cancel_running()
        self.aside = self.aside if state in _ASIDE else None
        old, self.state = self.state, state
        self._from_fault, self._resumed = old is State.FAULT, old is State.RECONCILING
        self._since_s = self.outbox.host_s
        wait = ON_TIMEOUT.get(state)
        self.deadline_s = None if wait is None else self.outbox.host_s + wait[0]
        self.outbox.emit_state_change(old.value, state.value, reason)
        if state in self._on_entry:
            self._on_entry[state](reason)

    def take_due_step(self) -> None:
        """Take the step that only waits for a condition, if the condition holds now."""
        now = (self.outbox.history, self.outbox.host_s, self.outbox.now)
        self.waits_for_look = False
        if self.state is State.QUALIFIED and self.approver:
            if self.client_write is None and not self.safe.write_obstacles(*now):
                self.signal(Signal.APPROVED, f"approved: {self.approver}")
        elif self.watches_interlock and (
            word := self.safe.interlock_failure(self.outbox.host_s, self._since_s)
        ):
            self.roll_back("interlock", word)
        elif self.state is State.SET_ASIDE:
            self._rewrite_if_allowed()
        elif self.state is State.TRIAL and self.proven_to_s is not None:
            if self.safe.has_examined(self.proven_to_s) and not self.safe.disagrees:
                self.safe.proof_waits = ""
                self.outbox.record(RecordKind.PROVEN, reason=self.trial_passed)
                self.signal(Signal.TRIAL_PASSED, self.trial_passed)
        elif self.state is State.PROVEN and self.safe.void:  # became void during the save
            self.roll_back("void", self.safe.void)
        elif self.state is State.PROVEN and self.outbox.host_s >= self._save_from_s:
            if not (holds := self.safe.save_obstacles(*now)):
                self.signal(Signal.SAVE_DUE, "proven, safe and still")
            self.waits_for_look = bool(holds) and holds == self.safe.unexamined_obstacles()

    @property
    def watches_interlock(self) -> bool:
        """Whether the interlock must be closed all the time now."""
        on_trial = self.state in (State.STAGED, State.TRIAL, State.SET_ASIDE)
        on_trial |= self.state is State.RECONCILING and self.aside is not None
        return self.policy.trial.interlock and on_trial

    def on_timeout(self) -> None:
        """The state's time limit expired."""
        if self.state is State.RECONCILING:  # keep waiting
            self.deadline_s = None
            if self.outbox.history.open is not None:
                self.outbox.note("error", "a transaction is open and the device does not come back")
            return
        self._cause = "device"
        if self.state is State.STAGING:
            self.outbox.record(RecordKind.RAM_FAILED, reason="no end")
        holds = self.rewrite_obstacles() if self.state is State.SET_ASIDE else []
        self.signal(Signal.TIMEOUT, "; ".join(holds) or "nothing came in time")

    def roll_back(self, cause: str, reason: str) -> None:
        """Restore the old values if the state allows it; out of FAULT only for an operator."""
        by_hand = cause == "operator"
        if self.state is State.RECONCILING:  # the old values are restored, if any were set aside
            self.forget_aside(reason)
        if Signal.ROLL_BACK in TABLE[self.state] and (by_hand or self.state is not State.FAULT):
            self._cause = cause
            self.signal(Signal.TRIAL_FAILED if cause == "trial" else Signal.ROLL_BACK, reason)

    def roll_back_by_hand(self) -> Answer:
        """Restore the old values for an operator."""
        if self.aside is not None:  # the old values are in RAM or soon will be: keep them
            why, txn, self.aside = "an operator asked for it", self.aside.transaction.id, None
            self.outbox.record(
                RecordKind.ROLLBACK, txn=txn, reason=why, cause="operator", counts=True
            )
            self._lock_after_rollbacks()
            self.signal_if(Signal.ROLL_BACK, why)
            return True, "the old values stay"
        if Signal.ROLL_BACK not in TABLE[self.state]:
            return False, (
                f"nothing to roll back in {self.state.value}; for values that are in flash use "
                "the registers rollback command"
            )
        self.roll_back("operator", "an operator asked for it")
        return True, "the old values are being put back"

    # -- the candidate -----------------------------------------------------------------------------

    def consider_estimate(self, estimate: Estimate, gyro_is_raw: bool) -> None:
        """Decide whether a new estimate is worth a write and qualifies for it.

        A qualified candidate is kept unchanged, so that an operator approves what will be written,
        until the estimate differs from it by the smallest change that is worth a write.
        """
        fresh = self._compose(estimate, gyro_is_raw, self.registers)
        if fresh is None or not worth_writing(self.policy, self.outbox.history, fresh):
            self.signal_if(Signal.NOT_WORTH_WRITING, "the registers are right as they are")
            return
        self.signal_if(
            Signal.WORTH_WRITING, f"heading changes by {fresh.heading_change_deg:.1f} deg"
        )
        if red := [gate.gate for gate in self.safe.gates if not gate.ok]:
            self.signal_if(Signal.GATES_FAILED, f"gates not met: {', '.join(red)}")
        elif self.safe.gates:
            kept = self.proposal
            if (
                kept is not None
                and proposal_distance_deg(kept, fresh, estimate) > self.policy.min_change_deg
            ):
                self.signal_if(Signal.GATES_FAILED, "the estimate moved on")
            if self.state is State.CANDIDATE:
                self.proposal = fresh
            self.signal_if(Signal.GATES_PASSED, "all gates are met")

    def signal_if(self, signal: Signal, reason: str) -> None:
        """Send the signal if the state has it; else do nothing, without a note."""
        if signal in TABLE[self.state]:
            self.signal(signal, reason)

    def approve(self, text: str) -> Answer:
        """Approve the candidate with this id; valid while it stays qualified."""
        if self.state is not State.QUALIFIED or self.proposal is None:
            return False, f"no candidate to approve in {self.state.value}"
        if text.strip().lower() != self.proposal.id:
            return False, f"{text!r} is not the candidate, it is {self.proposal.id}"
        if self.policy.mode < Mode.STAGE:
            return False, self.mode_forbids
        self.approver, self.safe.armed = "operator", True
        said = f"{self.proposal.id} approved"
        self.outbox.note("info", said)
        held = self.safe.write_obstacles(self.outbox.history, self.outbox.host_s, self.outbox.now)
        waits = f"; it is written once this is over: {'; '.join(held)}" if held else ""
        return True, f"{said}{waits}"

    @property
    def mode_forbids(self) -> str:
        """Why nothing can be written in this run."""
        return f"the mode is {self.policy.mode.name.lower()}: nothing is written in this run"

    def _compose(
        self, estimate: Estimate, gyro_is_raw: bool, registers: Mapping[int, Values]
    ) -> Proposal | None:
        if not estimate.converged:
            return None
        try:
            return compose(estimate, registers, gyro_is_raw=gyro_is_raw)
        except UnwritableError as error:
            self.outbox.note("warning", f"this estimate cannot be written: {error}")
            return None

    # -- judging the values in force ---------------------------------------------------------------

    def compare_estimate(self, estimate: Estimate, gyro_is_raw: bool) -> None:
        """Compare the present estimate and its gates with the written values.

        The smallest disagreement delays the end of a trial and a save. A clear disagreement that
        lasts for `worse_for_s` ends them.
        """
        self.safe.disagrees, clear = self._disagreement(estimate, gyro_is_raw, self.registers)
        if not clear:
            self._against_since_s = None
        elif self._against_since_s is None:
            self._against_since_s = self.outbox.host_s
        elif self.outbox.host_s - self._against_since_s >= self.policy.trial.worse_for_s:
            self.void_calibration(f"{clear}, for {self.policy.trial.worse_for_s:.0f} s")

    def _disagreement(
        self, estimate: Estimate, gyro_is_raw: bool, registers: Mapping[int, Values]
    ) -> tuple[str, str]:
        """How the present estimate or its gates contradict these registers; again, if clearly."""
        if red := [gate.gate for gate in self.safe.gates if not gate.ok]:
            reason = f"gates not met: {', '.join(red)}"
            return reason, reason
        if (fresh := self._compose(estimate, gyro_is_raw, registers)) is None:
            return "there is no present estimate to compare with what was written", ""
        if not worth_writing(self.policy, self.outbox.history, fresh):
            return "", ""
        reason = (
            f"the present estimate asks for another {fresh.heading_change_deg:.1f} deg and "
            f"{fresh.gyro_change_rad_s:.4f} rad/s"
        )
        return reason, reason if contradicts(self.policy, fresh, estimate) else ""

    def void_calibration(self, reason: str) -> None:
        """The calibration is void: unsaved values are undone."""
        if self.state in WITHOUT_TRANSACTION:
            self.signal_if(Signal.GATES_FAILED, reason)
            return
        self.safe.void = reason
        self.roll_back("void", reason)

    def prove_again(self, reason: str) -> None:
        """After a doubt the registers must be proven again."""
        if self.state in LIVED_WITH:
            self.trial = Trial(self.policy.trial, self.transaction().heading_change_deg)
            self.trial_passed, self.proven_to_s = "", None
            self.safe.proof_waits = f"{reason}: what is in force is on trial again"
        elif self.aside is not None:
            self.roll_back("client", f"{reason}: what was set aside is not written again")

    def judge_proof(self, finding: TrialVerdict, reason: str) -> None:
        """Judge proven values further, until they are saved."""
        if finding is TrialVerdict.FAILED:
            self.roll_back("trial", reason)
        elif finding is TrialVerdict.PASSED:
            self.safe.proof_waits = ""

    # -- a client saves or resets ------------------------------------------------------------------

    def set_aside(self, client: str, does: str) -> None:
        """A client saves all of RAM, or resets the device: undo values on trial first.

        They are written again after that, unless something contradicts them already.
        """
        against = self.safe.void or self.safe.disagrees or self.trial.currently_worse
        if self.state in (State.TRIAL, State.PROVEN) and not against:
            self.aside = SetAside(self.transaction(), client, does)
        self.roll_back("client", f"{client} {does}, and the old values are in force before that")

    def client_command_ended(self, does: str, why_not: str = "") -> None:
        """The client's command was acknowledged, or failed for this reason."""
        if self.aside is None or self.state not in (State.SET_ASIDE, State.RECONCILING):
            return
        self.aside.does = does
        if why_not:
            self.roll_back("client", f"{self.aside.client} {does}, and that failed: {why_not}")
        else:
            self.aside.done_s = self.outbox.host_s

    def forget_aside(self, reason: str) -> None:
        """Drop what was set aside; the old values are in RAM already."""
        if self.aside is not None:
            self.aside = None
            self._note_not_rewritten(reason)

    def _note_not_rewritten(self, reason: str) -> None:
        self.outbox.note("info", f"what was on trial is not written again: {reason}")

    def judge_aside(self, estimate: Estimate, gyro_is_raw: bool) -> None:
        """Compare the present estimate with what was set aside."""
        if self.aside is None:
            return
        registers = {**self.registers, **self.aside.transaction.new}
        if against := self._disagreement(estimate, gyro_is_raw, registers)[0]:
            self.roll_back("client", against)

    def rewrite_obstacles(self) -> list[str]:
        """Why what was set aside is not written again now; empty if it may be."""
        if self.aside is None or self.aside.done_s is None:
            return ["what the client asked for is not acknowledged"]
        if not self.aside.confirmed(self.safe.doubt_s):
            return ["the device did not say again what it holds"]
        return self.safe.rewrite_obstacles(self.outbox.history, self.outbox.host_s, self.outbox.now)

    def _rewrite_if_allowed(self) -> None:
        """Write the values again as soon as there is no obstacle."""
        if self.aside is None:
            return
        self.waits_for_look = self.aside.waits_for_look(self.safe.doubt_s, self.outbox.host_s)
        if not self.rewrite_obstacles():
            done = {"saves": "has saved", "resets": "has reset the device"}[self.aside.does]
            self.signal(Signal.GO_ON, f"{self.aside.client} {done}; what was on trial is again")

    def _keep_set_aside(self) -> bool:
        """After a client's reset: whether the trial stays set aside, as the device is the same."""
        if self.aside is None:
            return False
        changed = sorted(differences(self.aside.holds, self.expected_values(self.aside.holds)))
        if not self.aside.transaction.is_of(self._require_identity().unit):
            self.forget_aside("another device answers")
        elif changed:
            which = ", ".join(map(str, changed))
            self.forget_aside(f"after the reset register {which} is not as it was before")
        elif (why := self.outbox.history.locked) is not None:
            self.forget_aside(f"locked: {why}")
        return self.aside is not None

    # -- calibration writes of clients -------------------------------------------------------------

    def client_write_refusal(self, number: int) -> str | None:
        """Why a client may not write this register now; "" if it may; None: not yet."""
        if self.safe.mode < Mode.STAGE:
            why = f"the mode is {self.policy.mode.name.lower()}"
            return why if self.policy.mode < Mode.STAGE else "the device or its journal is in doubt"
        if self.outbox.history.locked is not None:
            return f"locked: {self.outbox.history.locked}"
        if self.outbox.history.open is not None or self.state is State.SET_ASIDE:
            return (
                f"a calibration of ahrsd's is {self.state.value}, and what calibrates is nobody "
                "else's until that has ended"
            )
        if self.state not in WITHOUT_TRANSACTION:
            return None if self.state is State.RECONCILING else f"the state is {self.state.value}"
        if self.approver:
            return "a calibration is approved and about to be written"
        if not self.safe.journal_ok:
            return "the journal cannot be written"
        return "" if number in self.registers else f"register {number} could not be read"

    def journal_client_write(self, client: str, number: int, values: Values) -> None:
        """Journal a client's write, with the register's value before it."""
        old, serial = self.registers[number], self._require_identity().serial
        self.client_write = ClientWrite(client, number, values, serial, old)
        self.outbox.record(
            RecordKind.CLIENT_WRITES,
            client=client,
            serial=serial,
            old={str(number): list(old)},
            new={str(number): list(values)},
        )

    def on_client_write_journaled(self, journaled: bool) -> None:
        """That record is on the disk; if not, nothing is sent."""
        write = self.client_write
        if write is not None and (write.dropped or not journaled):
            self.client_write = None
        elif write is not None:
            write.journaled = True

    @property
    def client_write_ready(self) -> bool:
        """Whether the client's write is journaled for this unit and its present register."""
        write = self.client_write
        if write is None or not write.journaled or self.identity is None:
            return False
        holds = self.registers.get(write.number)
        return (write.serial, write.old) == (self.identity.serial, holds)

    def drop_client_write(self) -> None:
        """Drop the client's write. Its record stays; the journal may still answer."""
        if self.client_write is not None and not self.client_write.journaled:
            self.client_write.dropped = True
        else:
            self.client_write = None

    def on_client_wrote(self) -> None:
        """The client's write was answered, refused or lost: read the device again."""
        write, self.client_write = self.client_write, None
        if write is not None:
            self.safe.record_client_write(write.number, self.registers[write.number])
        if write is not None and self.state is not State.RECONCILING:
            self.reread_device(f"{write.client} wrote register {write.number}")

    # -- locks -------------------------------------------------------------------------------------

    def lock(self, reason: str) -> Answer:
        """Forbid writes from now on; values that are only in RAM are undone first."""
        self.outbox.record(RecordKind.LOCKED, reason=reason)
        if self.state is not State.FAULT:
            self.roll_back("operator", reason)
        self.signal_if(Signal.LOCK, reason)
        return True, f"locked: {reason}"

    def unlock(self, reason: str) -> Answer:
        """Allow writes again. In FAULT: read the device again."""
        self.outbox.record(RecordKind.UNLOCKED, reason=reason)
        if self.state is State.FAULT:
            self.outbox.append(IdentifyAgain())
        self.signal_if(Signal.UNLOCK, reason)
        return True, f"unlocked: {reason}"

    # -- entering states ---------------------------------------------------------------------------

    def _enter_reconciling(self, reason: str) -> None:
        self.proposal, self.approver, self._altered_values = None, "", {}
        self.safe.stillness.reset()

    def _enter_rest(self, reason: str) -> None:
        """Nothing is under way; a transaction that sent no write ends here."""
        self.proposal, self.approver = None, ""
        if self.outbox.history.last is RecordKind.PREPARED:
            self.outbox.record(RecordKind.ABORTED, reason=reason)
        if self.outbox.history.locked is not None:
            self.signal(Signal.LOCK, self.outbox.history.locked)

    def _enter_candidate(self, reason: str) -> None:
        self.proposal, self.approver = None, ""

    def _enter_qualified(self, reason: str) -> None:
        proposal = self._require_proposal()
        small = proposal.heading_change_deg <= self.policy.max_change_auto_deg
        self.approver = "auto" if self.policy.approval == "auto" and small else ""
        may = self.safe.mode >= Mode.STAGE
        self.outbox.note(
            "info",
            f"candidate {proposal.id}, heading changes by up to {proposal.heading_change_deg:.1f} "
            f"deg; {'to write' if may else 'would write'}: {' '.join(proposal.lines)}",
        )

    def _enter_preparing(self, reason: str) -> None:
        self.safe.void = self.safe.disagrees = self.safe.proof_waits = ""
        self._against_since_s = None
        gates = [[gate.gate, gate.value, gate.limit] for gate in self.safe.gates]
        facts: dict[str, object] = {"gates": gates, "interlock": "safe"}
        wall = f"{self.outbox.wall_s:.0f}"
        if self.aside is None:
            transaction = self._new_transaction(wall)
        else:
            before, self.aside = self.aside.transaction, None
            facts["again"] = before.id
            name = f"{before.id.partition('-')[0]}-{wall}"
            transaction = replace(before, id=name, snapshot=self.registers)
        self.outbox.record(RecordKind.PREPARED, **facts, **transaction.facts())

    def _new_transaction(self, wall: str) -> Transaction:
        proposal, identity = self._require_proposal(), self._require_identity()
        return Transaction(
            id=f"{proposal.id}-{wall}",
            serial=identity.serial,
            firmware=identity.firmware,
            old=proposal.old,
            new=proposal.new,
            snapshot=self.registers,
            heading_change_deg=proposal.heading_change_deg,
            approver=self.approver,
            model=identity.model,
        )

    def _enter_checking(self, reason: str) -> None:
        self.outbox.run(
            "check", Purpose.STAGE, partial(check, self.transaction(), self.session_keys)
        )

    def _enter_staging(self, reason: str) -> None:
        self._cause, self._altered_values, self.staging_s = "device", {}, self.outbox.host_s
        self.outbox.set_in_force(None)
        self.outbox.run("write", Purpose.STAGE, partial(stage, self.transaction()))

    def _enter_staged(self, reason: str) -> None:
        transaction = self.transaction()
        self._set_in_force(transaction.new)
        self.outbox.emit_register_writes(transaction.old, transaction.new, "verified")
        self.outbox.record(RecordKind.RAM_VERIFIED, serial=transaction.serial)

    def _enter_trial(self, reason: str) -> None:
        self.trial_passed, self.proven_to_s = "", None
        self.trial = Trial(self.policy.trial, self.transaction().heading_change_deg)

    def _enter_proven(self, reason: str) -> None:
        """Also entered after a save that was not sent: it does not count, and a retry waits.

        Values that were proven before an interruption are proven again before they are saved:
        what happened to the vehicle meanwhile is unknown.
        """
        if self._resumed:
            self.prove_again(reason)
        if self.outbox.history.last is RecordKind.FLASH_SENT:
            self._save_from_s = self.outbox.host_s + RETRY_SAVE_S
            self.outbox.record(RecordKind.PROVEN, reason=reason, unsent=True)

    def _enter_set_aside(self, reason: str) -> None:
        """Entered a second time after a reset; the time limit counts from the first entry."""
        if self.aside is None:
            raise AssertionError("nothing is set aside")
        if self.aside.until_s is None:
            self.aside.until_s = self.deadline_s
            compensating = {n: v for n, v in self.registers.items() if n in COMPENSATING}
            self.aside.holds = compensating
        self.deadline_s = self.aside.until_s

    def _enter_saving(self, reason: str) -> None:
        self.safe.save_from_s = self.outbox.host_s
        make = partial(save, self.transaction(), self.session_keys)
        self.outbox.run("save", Purpose.SAVE, make)

    def _enter_rolling_back(self, reason: str) -> None:
        # a register with neither the old value nor one of ours was written by another program and
        # is not overwritten; out of FAULT it is, because an operator has checked
        last = self.outbox.history.last
        if last is not RecordKind.ROLLBACK:
            self.outbox.record(
                RecordKind.ROLLBACK, reason=reason, cause=self._cause, counts=self._cause in COUNTED
            )
        self.outbox.set_in_force(None)
        make = partial(
            roll_back, self.transaction(), only_ours=not self._from_fault, left=self._altered_values
        )
        self.outbox.run("roll back", Purpose.ROLL_BACK, make)

    def _enter_fault(self, reason: str) -> None:
        transaction = self.outbox.history.open
        by_hand = "" if transaction is None else f": {' '.join(register_lines(transaction.old))}"
        self.outbox.note(
            "error", f"{reason}; the old values, to type in by hand if need be{by_hand}"
        )

    # -- ends of procedures ------------------------------------------------------------------------

    def on_outcome(self, outcome: ProcedureOutcome) -> None:
        """A procedure ended with this outcome."""
        if outcome.other is not None:
            self._on_other_device_in_procedure(outcome.other, outcome.written)
            return
        endings: dict[State, Callable[[ProcedureOutcome], None]] = {
            State.CHECKING: self._on_checked,
            State.STAGING: self._on_written,
            State.SAVING: self._on_saved,
            State.ROLLING_BACK: self._on_rolled_back,
        }
        endings[self.state](outcome)

    def on_other_device(self, unit: Unit) -> None:
        """Another device is on the cable: discard what was judged of the first one."""
        wanted = "nobody knew" if self.identity is None else str(self.identity.unit)
        self.outbox.note(
            "error", f"another device answers: {unit}, not {wanted}; nothing is written"
        )
        self.reread_device(f"another device answers: {unit}")

    def reread_device(self, reason: str) -> None:
        """The device differs from what was expected: identify and read it again."""
        self.outbox.set_in_force(None)
        self.outbox.append(IdentifyAgain())
        self.signal(Signal.IN_DOUBT, reason)

    def expected_values(self, read: Mapping[int, Values]) -> dict[int, Values]:
        """The known values of these registers."""
        return {n: self.registers[n] for n in read if n in self.registers}

    def on_registers_changed(self, numbers: tuple[int, ...]) -> None:
        """Registers of the device changed at an unknown time."""
        which = f"register{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"
        reason = f"{which} changed: the device restarted unseen, or somebody else wrote"
        self.outbox.note("warning", reason)
        self.outbox.append(CalibrateAnew(reason))
        self.reread_device(reason)

    def _on_other_device_in_procedure(self, unit: Unit, written: bool) -> None:
        """Another device answered in a procedure; the open journal is still the first one's."""
        reason = f"another device answers: {unit}"
        if self.state is State.SAVING:
            self.outbox.record(RecordKind.PROVEN, reason=reason, unsent=True)
        elif self.state in (State.CHECKING, State.STAGING) and not written:
            self.outbox.record(RecordKind.ABORTED, reason=reason)
        self.on_other_device(unit)

    def _on_checked(self, outcome: ProcedureOutcome) -> None:
        if outcome.as_expected:
            self.signal(Signal.DONE, "the device holds what the journal says")
            return
        self.outbox.set_in_force(None)
        self.outbox.append(IdentifyAgain())
        self.signal(Signal.DIFFERS, f"somebody else changed the device: {outcome}")

    def _on_written(self, outcome: ProcedureOutcome) -> None:
        if outcome.as_expected:
            self.signal(Signal.DONE, "both registers and the device's identity were read back")
        elif outcome.written:  # a restart or another program between the writes
            self.reread_device(f"after the writes {outcome}")
        else:
            self.signal(Signal.DIFFERS, f"read back: {outcome}")

    def _on_saved(self, outcome: ProcedureOutcome) -> None:
        if outcome.as_expected:
            self.outbox.record(RecordKind.FLASH_ACKED, serial=self.transaction().serial)
            self.signal(Signal.DONE, "the device acknowledged the save")
        else:
            reason = self.safe.save_too_late(self.outbox.host_s) or str(outcome)
            self.outbox.note("warning", f"not saved: {reason}")
            self.signal(Signal.NOT_SENT, reason)
            if outcome.differing:
                self.outbox.append(IdentifyAgain())
        self._set_up_stream()

    def on_failure(self, error: Exception) -> None:
        """A procedure failed: the device may hold old, new or mixed values."""
        reason, saving = str(error), self.state is State.SAVING
        if isinstance(error, VerifyFailed) and error.echoed:
            self._altered_values = {error.register: error.read}
        if self.state is State.STAGING:
            transaction = self.transaction()
            self.outbox.emit_register_writes(transaction.old, transaction.new, "failed")
            self.outbox.record(RecordKind.RAM_FAILED, reason=reason)
        self.signal(Signal.FAILED, reason)
        if saving:
            self._set_up_stream()

    def _set_up_stream(self) -> None:
        """Set up the session's outputs after a save restored the user's."""
        if self.session_keys:
            self.outbox.append(SetUpStream())

    def _on_rolled_back(self, outcome: ProcedureOutcome) -> None:
        transaction = self.transaction()
        if not outcome.as_expected:
            self.reread_device(f"not rolled back: {outcome}")
            return
        self._set_in_force(transaction.old)
        self.outbox.emit_register_writes(transaction.new, transaction.old, "undone")
        self.outbox.record(RecordKind.ROLLED_BACK, serial=transaction.serial)
        self._lock_after_rollbacks()
        if self.aside is None:
            self.signal(Signal.DONE, "the old values were read back")
        else:
            self.signal(Signal.SET_ASIDE, "the old values were read back, for a client alone")

    def _lock_after_rollbacks(self) -> None:
        history = self.outbox.history
        if history.rollbacks >= self.policy.rollbacks_to_lock and history.locked is None:
            self.outbox.record(RecordKind.LOCKED, reason=f"{history.rollbacks} rollbacks in a row")

    # -- after an interruption ---------------------------------------------------------------------

    def reconcile(self, restarted: bool) -> None:
        """Compare journal and device, and move to the resulting state."""
        history = self.outbox.history
        if history.torn:
            self.signal(Signal.TORN, "the flash was torn and nobody unlocked it yet")
        elif history.open is None or history.last is None:
            self._check_last_transaction()
            if self._keep_set_aside():
                self.signal(Signal.SET_ASIDE, "a client reset the device, which is as it was")
            else:
                self.signal(Signal.NOTHING_OPEN, "no transaction is open")
        else:
            holds = compare_contents(history.open.old, history.open.new, self.registers, restarted)
            resolution = RECONCILE[history.last][holds]
            self.outbox.note(resolution.level, resolution.text)
            undoable = self.safe.mode >= Mode.STAGE
            if resolution.signal in (Signal.UNDO, Signal.RESUME_TRIAL) and not undoable:
                self.signal(Signal.UNRESOLVED, f"{resolution.text}, and this mode may not write")
                return
            if resolution.record is RecordKind.FOREIGN:
                self.outbox.record(RecordKind.LOCKED, reason=resolution.text)
            if resolution.record is not None:
                self.outbox.record(resolution.record, reason=resolution.text)
            self.signal(resolution.signal, resolution.text)

    def _check_last_transaction(self) -> None:
        """No transaction is open: note if the device differs from the last one's result."""
        self._check_write_by_hand()
        held = self.outbox.history.holds or {}
        changed = [n for n, v in held.items() if not same(n, v, self.registers.get(n, ()))]
        if changed:
            tried = all(
                self.outbox.history.is_trial_value(n, self.registers.get(n, ())) for n in changed
            )
            cause = (
                "it holds a value of a trial that was undone: the device did not give it up, or "
                "somebody saved it"
                if tried
                else "somebody else wrote or saved it"
            )
            which = ", ".join(map(str, changed))
            self.outbox.note(
                "error", f"register {which} changed since the journal's last record: {cause}"
            )
        factory, history = Affine.identity().to_register(), self.outbox.history
        strange = [
            number
            for number in (MAG, GYRO)
            if (values := self.registers.get(number)) is not None
            and not held
            and not same(number, factory, values)
            and not history.has_value(number, values)
        ]
        if strange and self.safe.journal_ok:
            self.outbox.note(
                "warning",
                f"register {', '.join(map(str, strange))} holds values that are neither the "
                "factory's nor in the journal: somebody calibrated the device before, or a journal "
                "was lost in a trial; then switch the device off and on",
            )

    def _check_write_by_hand(self) -> None:
        """Note if a write by hand was broken off and left some of its values."""
        if (by_hand := self.outbox.history.by_hand) is None:
            return
        if compare_contents(*by_hand, self.registers, False) is DeviceContents.MIXED:
            which = ", ".join(map(str, by_hand[1]))
            self.outbox.note(
                "error",
                f"a write by hand of registers {which}, or its save, was broken off: the device "
                "holds some old and some new values; `ahrsd registers rollback` puts the old ones "
                "back; add --save after a save",
            )

    def transaction(self) -> Transaction:
        """The open transaction; states that use it cannot be entered without one."""
        if self.outbox.history.open is None:
            raise AssertionError(f"{self.state.value} without a transaction")
        return self.outbox.history.open

    def _require_proposal(self) -> Proposal:
        if self.proposal is None:
            raise AssertionError(f"{self.state.value} without a proposal")
        return self.proposal

    def _require_identity(self) -> Identity:
        if self.identity is None:
            raise AssertionError(f"{self.state.value} without a device")
        return self.identity

    def _set_in_force(self, values: dict[int, Values]) -> None:
        self.registers = {**self.registers, **values}
        self.outbox.set_in_force(self.registers)
