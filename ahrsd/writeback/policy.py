"""When a write is allowed: what a person sets, and the reasons that hold a write back now."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from ahrsd.calibration import Estimate
from ahrsd.writeback.clocks import Now, passed_s
from ahrsd.writeback.composition import Proposal
from ahrsd.writeback.permissions import Mode
from ahrsd.writeback.transaction import JournalHistory

DAY_S: Final = 86400.0
CLEAR_SIGMAS: Final = 4.0
VERDICT_AGE_S: Final = 600.0  # a save must be of what is true now, as an approval must


@dataclass(frozen=True, slots=True)
class TrialPolicy:
    """How written registers prove themselves. Times are of the device's clock.

    duration_s, turns: whichever comes first ends the trial; longer proves more [600 s, 2 turns]
    worse_percent, worse_for_s: undo where the live figure is worse than the old registers' on the
                       same samples by this, for this long [10 %, 60 s]
    max_wrong_percent, wrong_sigmas: undo where an error of the calibration explains more of the
                       corrected field than this, by so many of the figure's own sigmas [0.5 %, 2.5]
    max_spread_percent: undo where std/mean of the corrected field exceeds this, whatever explains
                       it [10 %]
    max_jump_deg:      undo where the heading jumped by this much more than predicted [5 deg]
    interlock:         undo where the vehicle withdraws its word; false lets the trial live through
                       driving, for vehicles whose word is only about the moment of writing [true]
    """

    duration_s: float = 600.0
    turns: float = 2.0
    worse_percent: float = 10.0
    worse_for_s: float = 60.0
    max_wrong_percent: float = 0.5
    wrong_sigmas: float = 2.5
    max_spread_percent: float = 10.0
    max_jump_deg: float = 5.0
    interlock: bool = True


@dataclass(frozen=True, slots=True)
class StillPolicy:
    """Our own proof that the vehicle stands, for VNWNV: it starves the attitude filter.

    gyro_rad_s, accel_m_s2: rate less bias, and standard deviation of the specific force, below
    which it rests [0.01, 0.05]; duration_s: for so long [3 s]; max_age_s: the newest sample may be
    this old when VNWNV goes out, because the output is paused before it [2 s]
    """

    gyro_rad_s: float = 0.01
    accel_m_s2: float = 0.05
    duration_s: float = 3.0
    max_age_s: float = 2.0


@dataclass(frozen=True, slots=True)
class WriteBackPolicy:
    """What a person sets about writing. The defaults write nothing.

    mode:              ceiling of what may be sent [OBSERVE]
    configure_stream:  session settings (registers 6, 7, 75 to 77) may be changed [False]
    approval:          who says yes: "operator" types the candidate's id, "auto" needs no one and
                       is limited to `max_change_auto_deg` [operator]
    armed_at_start:    begin a run armed; else a person's word in that run must come first: `arm`,
                       or an approval [False]
    commit_unattended: flash without an operator's yes [False]
    serial:            write only to this device; None: the first one seen in this run [None]
    keep_on_stop:      leave unsaved values in RAM when the daemon stops [False: they are undone]
    min_change_deg, min_gyro_change_rad_s: smaller changes are not worth a write [0.5, 0.002]
    max_change_auto_deg: larger changes of heading need an operator [5]
    min_interval_s, ram_writes_per_day, flash_writes_per_day, flash_writes_lifetime: budget
    cooldown_s:        no write for this long after a rollback [86400]
    margin_after_rollback: and then only for changes so many times as large [2]
    rollbacks_to_lock: so many in a row lock the write-back [2]
    interlock_max_age_s: an older word of the vehicle counts as no [1]
    reply_timeout_s:   how long one reply may take [0.4]
    recheck_s:         who answers and what it holds is read again so often, beside the running
                       output, in every mode but passive [10 s]
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
    """How much larger a change or a gain must be than usual: more after a rollback."""
    return policy.margin_after_rollback if history.rollbacks else 1.0


def worth_writing(policy: WriteBackPolicy, history: JournalHistory, proposal: Proposal) -> bool:
    """Whether the change is large enough."""
    factor = margin(policy, history)
    return (
        proposal.heading_change_deg >= factor * policy.min_change_deg
        or proposal.gyro_change_rad_s >= factor * policy.min_gyro_change_rad_s
    )


def contradicts(policy: WriteBackPolicy, proposal: Proposal, estimate: Estimate) -> bool:
    """Whether an estimate clearly speaks against the values that are in force.

    By twice what is worth a write, and beyond its own uncertainty.
    """
    heading_deg = max(2.0 * policy.min_change_deg, CLEAR_SIGMAS * estimate.heading_sigma_deg)
    gyro_rad_s = max(
        2.0 * policy.min_gyro_change_rad_s, CLEAR_SIGMAS * float(estimate.sigma[9:].max())
    )
    return proposal.heading_change_deg > heading_deg or proposal.gyro_change_rad_s > gyro_rad_s


def ram_budget(
    policy: WriteBackPolicy, history: JournalHistory, now: Now, *, again: bool = False
) -> list[str]:
    """Why RAM must not be written now; empty where it may. Times as `clocks.passed_s` reads them:
    no clock that was wrong, or was set, makes one longer.

    again: the values were in RAM just now and were undone for a client's save, so the pause between
           two writes is not waited for; the write counts in the day's number all the same
    """
    reasons: list[str] = []
    if history.locked is not None:
        reasons.append(f"locked: {history.locked}; unlock to go on")
    if history.broken is not None:
        reasons.append(f"the journal's {history.broken} record cannot be understood")
    *writes_s, _ = passed_s((*history.ram_writes_at, history.newest_at), now)
    if writes_s and not again and writes_s[-1] < policy.min_interval_s:
        reasons.append(
            f"the last write was {writes_s[-1]:.0f} s ago, wait for {policy.min_interval_s:.0f} s"
        )
    today = sum(passed < DAY_S for passed in writes_s)
    if today >= policy.ram_writes_per_day:
        reasons.append(f"{today} RAM writes in a day, limit {policy.ram_writes_per_day}")
    if history.rollback_at is not None:
        since_s, _ = passed_s((history.rollback_at, history.newest_at), now)
        if since_s < policy.cooldown_s:
            reasons.append(
                f"a rollback was {since_s / 3600.0:.1f} h ago, wait for "
                f"{policy.cooldown_s / 3600.0:.1f} h"
            )
    return reasons


def flash_budget(policy: WriteBackPolicy, history: JournalHistory, now: Now) -> list[str]:
    """Why flash must not be written now; empty where it may."""
    reasons: list[str] = []
    *flashes_s, _ = passed_s((*history.flashes_at, history.newest_at), now)
    today = sum(passed < DAY_S for passed in flashes_s)
    if today >= policy.flash_writes_per_day:
        reasons.append(f"{today} flash writes in a day, limit {policy.flash_writes_per_day}")
    if history.flashes >= policy.flash_writes_lifetime:
        reasons.append(
            f"{history.flashes} flash writes of this device, limit {policy.flash_writes_lifetime}"
        )
    return reasons
