"""When a write is allowed: the policy that a person sets, and the present obstacles to a write.

**Safeguards**: conditions on device, vehicle and journal for anything to be sent. They fail closed:
what is unknown, stale or unreadable counts as a no. Whether the vehicle is at rest (`Stillness`) is
judged from its own samples.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from ahrsd.calibration import Estimate
from ahrsd.events import GateResult
from ahrsd.samples import Array, SampleBlock
from ahrsd.writeback.composition import GYRO, MAG, Proposal
from ahrsd.writeback.journal_history import JournalHistory, Now, least_ages_s
from ahrsd.writeback.states import Mode, Purpose
from ahrsd.writeback.trial import TrialPolicy
from drivers.vn100.commands import Command, Identity, Word, Write
from drivers.vn100.registers import Values, same

# -- Policy and budgets ----------------------------------------------------------------------------


DAY_S: Final = 86400.0
CLEAR_SIGMAS: Final = 4.0  # of the estimate: a smaller change contradicts nothing
VERDICT_AGE_S: Final = 600.0  # a save, like an approval, needs a recent verdict


@dataclass(frozen=True, slots=True)
class StillPolicy:
    """Conditions of rest for VNWNV, during which the device's attitude filter gets no data.

    gyro_rad_s, accel_m_s2: limits on the rate less bias, and on the standard deviation of the
    specific force [0.01, 0.05]; duration_s: for this long [3 s]; max_age_s: largest age of the
    newest sample when VNWNV is sent, because the output is paused before it [2 s]
    """

    gyro_rad_s: float = 0.01
    accel_m_s2: float = 0.05
    duration_s: float = 3.0
    max_age_s: float = 2.0


@dataclass(frozen=True, slots=True)
class WriteBackPolicy:
    """Settings of the write-back. The defaults write nothing.

    mode:              upper limit of what may be sent [OBSERVE]
    configure_stream:  session settings (registers 6, 7, 75 to 77) may be changed [False]
    approval:          who approves: "operator" types the candidate's id, "auto" needs no one and
                       is limited to `max_change_auto_deg` [operator]
    armed_at_start:    start a run armed; else an operator must send `arm` or an approval in that
                       run first [False]
    commit_unattended: write flash without an operator's approval [False]
    serial:            write only to this device; None: the first one of this run [None]
    keep_on_stop:      leave unsaved values in RAM when the daemon stops [False: they are undone]
    min_change_deg, min_gyro_change_rad_s: smaller changes are not worth a write [0.5, 0.002]
    max_change_auto_deg: larger changes of heading need an operator [5]
    min_interval_s, ram_writes_per_day, flash_writes_per_day, flash_writes_lifetime: budget
    cooldown_s:        no write for this long after a rollback [86400]
    margin_after_rollback: factor on the required change after a rollback [2]
    rollbacks_to_lock: so many in a row lock the write-back [2]
    interlock_max_age_s: an older interlock signal counts as no [1]
    reply_timeout_s:   how long one reply may take [0.4]
    recheck_s:         interval of reading identity and registers again while the output runs, in
                       every mode but passive [10 s]
    """

    mode: Mode = Mode.OBSERVE
    configure_stream: bool = False
    approval: Literal["operator", "auto"] = "operator"
    armed_at_start: bool = False
    commit_unattended: bool = False
    serial: int | None = None
    keep_on_stop: bool = False
    min_change_deg: float = 0.5
    min_gyro_change_rad_s: float = 0.002
    max_change_auto_deg: float = 5.0
    min_interval_s: float = 600.0
    ram_writes_per_day: int = 6
    flash_writes_per_day: int = 1
    flash_writes_lifetime: int = 200
    cooldown_s: float = DAY_S
    margin_after_rollback: float = 2.0
    rollbacks_to_lock: int = 2
    interlock_max_age_s: float = 1.0
    reply_timeout_s: float = 0.4
    recheck_s: float = 10.0
    trial: TrialPolicy = field(default_factory=TrialPolicy)
    still: StillPolicy = field(default_factory=StillPolicy)


def margin(policy: WriteBackPolicy, history: JournalHistory) -> float:
    """Factor on the required change or gain: larger after a rollback."""
    return policy.margin_after_rollback if history.rollbacks else 1.0


def worth_writing(policy: WriteBackPolicy, history: JournalHistory, proposal: Proposal) -> bool:
    """Whether the change is large enough for a write."""
    factor = margin(policy, history)
    return (
        proposal.heading_change_deg >= factor * policy.min_change_deg
        or proposal.gyro_change_rad_s >= factor * policy.min_gyro_change_rad_s
    )


def contradicts(policy: WriteBackPolicy, proposal: Proposal, estimate: Estimate) -> bool:
    """Whether an estimate clearly contradicts the values in force.

    By twice the change that is worth a write, and beyond its own uncertainty.
    """
    heading_deg = max(2.0 * policy.min_change_deg, CLEAR_SIGMAS * estimate.heading_sigma_deg)
    gyro_rad_s = max(
        2.0 * policy.min_gyro_change_rad_s, CLEAR_SIGMAS * float(estimate.sigma[9:].max())
    )
    return proposal.heading_change_deg > heading_deg or proposal.gyro_change_rad_s > gyro_rad_s


def ram_budget(
    policy: WriteBackPolicy, history: JournalHistory, now: Now, *, again: bool = False
) -> list[str]:
    """Why RAM must not be written now; empty if it may. Ages by `least_ages_s`: a clock that
    was wrong or was set cannot make one longer.

    again: the values were in RAM just now and were undone for a client's save, so the minimum
           interval is not required; the write still counts in the day's number
    """
    reasons: list[str] = []
    if history.locked is not None:
        reasons.append(f"locked: {history.locked}; unlock to go on")
    if history.broken is not None:
        reasons.append(f"the journal's {history.broken} record cannot be understood")
    *writes_s, _ = least_ages_s((*history.ram_writes_at, history.newest_at), now)
    if writes_s and not again and writes_s[-1] < policy.min_interval_s:
        reasons.append(
            f"the last write was {writes_s[-1]:.0f} s ago, wait for {policy.min_interval_s:.0f} s"
        )
    today = sum(passed < DAY_S for passed in writes_s)
    if today >= policy.ram_writes_per_day:
        reasons.append(f"{today} RAM writes in a day, limit {policy.ram_writes_per_day}")
    if history.rollback_at is not None:
        since_s, _ = least_ages_s((history.rollback_at, history.newest_at), now)
        if since_s < policy.cooldown_s:
            reasons.append(
                f"a rollback was {since_s / 3600.0:.1f} h ago, wait for "
                f"{policy.cooldown_s / 3600.0:.1f} h"
            )
    return reasons


def flash_budget(policy: WriteBackPolicy, history: JournalHistory, now: Now) -> list[str]:
    """Why flash must not be written now; empty if it may."""
    reasons: list[str] = []
    *flashes_s, _ = least_ages_s((*history.flashes_at, history.newest_at), now)
    today = sum(passed < DAY_S for passed in flashes_s)
    if today >= policy.flash_writes_per_day:
        reasons.append(f"{today} flash writes in a day, limit {policy.flash_writes_per_day}")
    if history.flashes >= policy.flash_writes_lifetime:
        reasons.append(
            f"{history.flashes} flash writes of this device, limit {policy.flash_writes_lifetime}"
        )
    return reasons


# -- Rest of the vehicle ---------------------------------------------------------------------------


_SLOTS_PER_WINDOW = 30  # the window is stored as sums over this many parts: bounded memory


class Stillness:
    """Whether the vehicle is at rest, by rate (less bias) and force in a window of `duration_s`.

    It does not count as at rest without an accelerometer, without samples, after a gap or with a
    rate over the limit.
    """

    def __init__(self, policy: StillPolicy) -> None:
        self._policy = policy
        self._since_s: float | None = None  # device time of the first sample at rest
        self._device_s = self._host_s = -np.inf
        self._slots: deque[tuple[float, int, Array, Array]] = deque()

    def reset(self) -> None:
        """Forget the window."""
        self._since_s = None
        self._slots.clear()

    def update(self, block: SampleBlock, gyro_bias_rad_s: Array) -> None:
        """Take samples of the raw sensor."""
        if not len(block):
            return
        if block.gap_before:
            self.reset()
        rate = np.linalg.norm(block.gyro_b_rad_s - gyro_bias_rad_s, axis=1)
        at_rest = (rate < self._policy.gyro_rad_s) & np.isfinite(block.accel_b_m_s2).all(axis=1)
        moving = np.flatnonzero(~at_rest)
        if len(moving):
            self.reset()
        first = int(moving[-1]) + 1 if len(moving) else 0
        if first < len(block):
            self._extend(block.time_s[first:], block.accel_b_m_s2[first:])
        self._device_s, self._host_s = float(block.time_s[-1]), float(block.host_s[-1])

    def find_motion(self, host_s: float) -> str | None:
        """Why the vehicle does not count as at rest at this instant; None if it does."""
        policy = self._policy
        age_s = host_s - self._host_s
        if not age_s <= policy.max_age_s:
            return f"the newest sample is {age_s:.1f} s old, limit {policy.max_age_s} s"
        if self._since_s is None or self._device_s - self._since_s < policy.duration_s:
            still_s = 0.0 if self._since_s is None else self._device_s - self._since_s
            return f"still for {still_s:.1f} s, needed {policy.duration_s} s"
        spread = self._spread()
        if not spread < policy.accel_m_s2:
            return f"the specific force varies by {spread:.3f} m/s^2, limit {policy.accel_m_s2}"
        return None

    def _extend(self, time_s: Array, accel_m_s2: Array) -> None:
        if self._since_s is None:
            self._since_s = float(time_s[0])
        slot_s = self._policy.duration_s / _SLOTS_PER_WINDOW
        for index in np.unique(np.floor(time_s / slot_s)):
            part = accel_m_s2[np.floor(time_s / slot_s) == index]
            self._slots.append(
                (float(index * slot_s), len(part), part.sum(axis=0), (part**2).sum(axis=0))
            )
        newest_s = float(time_s[-1])
        while self._slots and newest_s - self._slots[0][0] > self._policy.duration_s + slot_s:
            self._slots.popleft()

    def _spread(self) -> float:
        """Standard deviation over the window, of the worst axis."""
        count = sum(slot[1] for slot in self._slots)
        mean = np.sum([slot[2] for slot in self._slots], axis=0) / count
        variance = np.sum([slot[3] for slot in self._slots], axis=0) / count - mean**2
        return float(np.sqrt(max(float(variance.max()), 0.0)))


# -- Safeguards ------------------------------------------------------------------------------------


HSI_CONTROL, HSI_APPLIED = 44, 3
UNEXAMINED_S = 2.0  # longest lag of the estimate: samples that are not in it may contain a step
SAVE_CHECKS_S = 0.5  # always allowed for the checks before VNWNV, which pause the samples
SAVE_CHECKS_PER_ASKING = 6.0  # or so many quickest looks: the checks need 4 to 5 times the replies
ASKINGS = 5  # newest looks: the quickest had no late reply; more would hide a line that got slower
ROTATION_WAITS = (
    "register 26 was changed and acts only once it is saved and the device has restarted: until "
    "then no sample is used; save it, or put it back, and switch the device off and on (and start "
    "ahrsd again if the stream has no time)"
)
NOT_ARMED = "nobody has armed this run: `ahrsd operator arm`"


class Safeguards:
    """The last known state of device, vehicle and journal; questions take the present time."""

    def __init__(self, policy: WriteBackPolicy) -> None:
        self.policy = policy
        self.stillness = Stillness(policy.still)
        self.journal_ok = False
        self.journal_read = False  # the journal of the device that was read
        self.stopping = False
        self.armed = policy.armed_at_start
        self.gates: tuple[GateResult, ...] = ()
        self.flash_gates: tuple[GateResult, ...] = ()
        self.doubt_s = float("-inf")  # host time of the last doubt about what is in force
        self.judged_s = float("-inf")  # host time of the newest verdict's samples
        self.void = ""  # why the transaction's values are void
        self.disagrees = ""  # how the newest estimate, or a gate, contradicts them
        self.proof_waits = ""  # why they must be proven again
        self.sampled_s: float | None = None  # host time of the newest sample
        self.examined_s: float | None = None  # and of the newest one in the estimate
        self._look_durations_s: deque[float] = deque(maxlen=ASKINGS)  # durations of looks
        self.save_from_s = float("-inf")  # when the save was decided
        self.changed_by_others: frozenset[int] = frozenset()  # registers, in RAM
        self.client_wrote: dict[int, Values] = {}  # values before unsaved client writes
        self.client_registers: frozenset[int] = frozenset()  # of clients' sessions
        self._serial = policy.serial
        self._limits: list[str] = ["no device yet"]
        self._is_ours = False
        self._hsi_applied = True
        self._interlock: tuple[bool, float] | None = None

    @property
    def mode(self) -> Mode:
        """The policy's mode, at most observe while the device or its journal is in doubt."""
        return min(self.policy.mode, Mode.OBSERVE) if self._limits else self.policy.mode

    def set_no_device(self, why: str) -> None:
        """There is no device, so nothing can be written."""
        self._limits, self._is_ours = [why], False

    def bind(
        self,
        identity: Identity,
        registers: Mapping[int, Values],
        journal_readable: bool,
        rotation_waits: bool = False,
    ) -> None:
        """Check a device that was identified and read; writes are bound to the first one.

        rotation_waits: register 26 was changed and the device has not restarted since
        """
        self.journal_ok = self.journal_read = journal_readable
        self.gates = self.flash_gates = ()  # earlier verdicts no longer count
        self._look_durations_s.clear()
        hsi = registers.get(HSI_CONTROL)
        self._hsi_applied = hsi is None or hsi[1] == HSI_APPLIED
        self._serial = identity.serial if self._serial is None else self._serial
        self._limits = []
        self._is_ours = identity.serial == self._serial and identity.profile.writable
        if identity.serial != self._serial:
            self._limits.append(
                f"this is the device {identity.serial}, writes are for {self._serial} only"
            )
        if not identity.profile.writable:
            self._limits.append(f"observe only: {identity.profile.observed_for}")
        if rotation_waits:
            self._limits.append(ROTATION_WAITS)
        if missing := [n for n in (MAG, GYRO, HSI_CONTROL) if n not in registers]:
            self._limits.append(f"registers {missing} could not be read")
        if not journal_readable:
            self._limits.append("the journal cannot be read; see its error")

    def set_armed(self, armed: bool) -> str:
        """Set whether this run may begin a write or a save; returns that in words."""
        self.armed = armed
        return "armed: this run may write" if armed else NOT_ARMED

    def record_client_write(self, number: int, before: Values) -> None:
        """A client wrote this register: store the value before the first such write."""
        self.client_wrote.setdefault(number, before)

    def update_changed_by_others(
        self, changed: frozenset[int], registers: Mapping[int, Values]
    ) -> frozenset[int]:
        """Set the registers changed by others, except those back at their previous value."""
        returned = {
            n for n, before in self.client_wrote.items() if same(n, before, registers.get(n, ()))
        }
        self.changed_by_others = changed - returned
        left = self.client_wrote.keys() & self.changed_by_others
        self.client_wrote = {n: self.client_wrote[n] for n in left}
        return self.changed_by_others

    def mark_doubt(self, host_s: float) -> None:
        """Earlier samples are from before a doubt: no save by their verdict."""
        if self.examined_s is not None:
            self.examined_s = min(self.examined_s, host_s)
        self.flash_gates, self.doubt_s = (), host_s
        self.stillness.reset()

    def set_interlock(self, safe: bool, host_s: float) -> None:
        """Take the interlock signal."""
        self._interlock = (safe, host_s)

    def interlock_obstacle(self, host_s: float) -> str:
        """Why the interlock does not allow a write now; empty if it does."""
        if self._interlock is None:
            return "the vehicle has not said that a write is safe"
        safe, since_s = self._interlock
        if not safe:
            return "the vehicle says that a write is not safe now"
        if not 0.0 <= host_s - since_s <= self.policy.interlock_max_age_s:
            return f"the vehicle's word is {host_s - since_s:.1f} s old"
        return ""

    def interlock_failure(self, host_s: float, since_s: float) -> str:
        """Why what began at `since_s` must end: the interlock says no, or is stale; empty if not.

        After a start the vehicle has `interlock_max_age_s` to send its first signal.
        """
        begun = self._interlock is None or self._interlock[0]
        if begun and host_s - since_s <= self.policy.interlock_max_age_s:
            return ""
        return self.interlock_obstacle(host_s)

    def write_obstacles(
        self, history: JournalHistory, host_s: float, now: Now, *, again: bool = False
    ) -> list[str]:
        """Why no write may begin now, apart from the approval. `again`: see `ram_budget`."""
        reasons = list(self._limits)
        if self.policy.mode < Mode.STAGE:
            reasons.append(
                f"the mode is {self.policy.mode.name.lower()}; stage or commit may write"
            )
        elif self.policy.approval == "auto" and not self.armed:
            reasons.append(NOT_ARMED)
        reasons += [f"gate {gate.gate}: {gate.advice}" for gate in self.gates if not gate.ok]
        if not self.gates:
            reasons.append("no gate has judged yet")
        if self._hsi_applied:
            reasons.append("the on-board estimator is applied; set register 44 to 0,1,5")
        if unsaved := sorted(self.client_wrote.keys() & {MAG, GYRO}):
            reasons.append(
                f"register {', '.join(map(str, unsaved))} holds what a program on a shared port "
                "wrote and did not save: let it save that, or switch the device off and on"
            )
        reasons += ram_budget(self.policy, history, now, again=again)
        return reasons + self._common_obstacles(host_s)

    def rewrite_obstacles(self, history: JournalHistory, host_s: float, now: Now) -> list[str]:
        """Why values that were set aside may not be written again now."""
        reasons = [word for word in (self.void, self.disagrees) if word]
        if not self.armed:
            reasons.append(NOT_ARMED)
        reasons += self._stale_verdict(host_s)
        more = self.write_obstacles(history, host_s, now, again=True)
        return list(dict.fromkeys([*reasons, *more]))

    def save_obstacles(self, history: JournalHistory, host_s: float, now: Now) -> list[str]:
        """Why flash may not be written now."""
        reasons = [] if self.mode >= Mode.COMMIT else ["only the mode commit may write flash"]
        if not self.armed:
            reasons.append(NOT_ARMED)
        unattended = history.open is not None and history.open.approver != "operator"
        if unattended and not self.policy.commit_unattended:
            reasons.append("no operator approved it and commit_unattended is off")
        reasons += [f"gate {gate.gate}: {gate.advice}" for gate in self.flash_gates if not gate.ok]
        if not self.flash_gates:
            reasons.append("no gate has judged for flash yet")
        reasons += flash_budget(self.policy, history, now)
        reasons += self._validity_obstacles(host_s)
        if still := self.stillness.find_motion(host_s):
            reasons.append(still)
        return reasons + self._common_obstacles(host_s)

    def _validity_obstacles(self, host_s: float) -> list[str]:
        """Why the values in force may differ from the judged ones, or be void."""
        reasons = [word for word in (self.void, self.disagrees, self.proof_waits) if word]
        if self.changed_by_others:
            which = ", ".join(map(str, sorted(self.changed_by_others)))
            reasons.append(
                f"somebody else changed register {which} in this run, and a save would make it "
                "permanent; once it is right, switch the device off and on"
            )
        return reasons + self._stale_verdict(host_s) + self.unexamined_obstacles()

    def _stale_verdict(self, host_s: float) -> list[str]:
        old_s = host_s - self.judged_s
        return [f"the newest verdict is {old_s:.0f} s old"] if old_s > VERDICT_AGE_S else []

    def record_look_duration(self, took_s: float) -> None:
        """Record how long a successful look took."""
        self._look_durations_s.append(took_s)

    @property
    def _quickest_look_s(self) -> float:
        """Duration of a look without late replies; samples wait meanwhile."""
        return min(self._look_durations_s, default=0.0)

    def save_too_late(self, host_s: float) -> str:
        """Why the decision to save is too old by now; empty if it is not.

        The checks before VNWNV pause the stream, so nothing shows what happens to the vehicle.
        They may last as long as on this line without late replies, and as long as one reply may
        take if the interlock signal is valid for that time.
        """
        on_this_line_s = SAVE_CHECKS_PER_ASKING * self._quickest_look_s
        reply_s = min(self.policy.reply_timeout_s, self.policy.interlock_max_age_s)
        most_s = max(SAVE_CHECKS_S, on_this_line_s, reply_s)
        if (took_s := host_s - self.save_from_s) <= most_s:
            return ""
        return (
            f"the device's answers were late: {took_s:.1f} s without a sample since the save was "
            f"decided, {most_s:.1f} s are allowed"
        )

    def has_examined(self, to_s: float) -> bool:
        """Whether the estimate has taken the samples up to this host time into account."""
        return self.examined_s is None or self.examined_s >= to_s

    def unexamined_obstacles(self) -> list[str]:
        """Obstacle if the estimate lags behind the samples, which wait for the device."""
        if self.sampled_s is None or self.examined_s is None:
            return []
        late_s = self.sampled_s - self.examined_s
        if late_s <= UNEXAMINED_S + self._quickest_look_s:
            return []
        return [f"the newest {late_s:.0f} s of samples are not judged yet"]

    def mode_for(self, purpose: Purpose) -> Mode:
        """The mode for a command of this purpose: a rollback on our own device needs no journal."""
        if purpose is Purpose.ROLL_BACK and self._is_ours:
            return self.policy.mode
        return self.mode

    def allow(self, command: Command, purpose: Purpose, host_s: float) -> bool:
        """Whether interlock, journal and verdict allow a command of the write-back now.

        A rollback needs neither interlock nor journal: the vehicle worked with the old values.
        """
        if isinstance(command, Write) and purpose is not Purpose.ROLL_BACK:
            return (self.armed or purpose is not Purpose.STAGE) and not self.interlock_obstacle(
                host_s
            )
        if isinstance(command, Word) and command.word == "VNWNV":
            return (
                self.armed
                and self.journal_ok
                and not (self.void or self.disagrees or self.proof_waits or self.changed_by_others)
                and not (self.interlock_obstacle(host_s) or self.stillness.find_motion(host_s))
                and not self.save_too_late(host_s)
            )
        return True

    def _common_obstacles(self, host_s: float) -> list[str]:
        reasons = [word] if (word := self.interlock_obstacle(host_s)) else []
        if not self.journal_ok:
            reasons.append("the journal cannot be written; free the disk, then unlock")
        if self.stopping:
            reasons.append("the daemon is stopping")
        return reasons
