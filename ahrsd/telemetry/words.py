"""A status in words: its lines for a terminal, and why nothing is written.

`explain_json` and `explain_lines` say which gate holds a write back, since when, and what would
open it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ahrsd.calibration_json import UNKNOWN_HEADING_DEG
from ahrsd.printable import counted

# -- Why nothing is written ------------------------------------------------------------------------


SCHEMA = "ahrsd.explain/1"

#: state of the write-back -> what it means to somebody who stands beside the vehicle
STATES: dict[str, str] = {
    "RECONCILING": "the device is being read and compared with the journal",
    "OBSERVING": "watching; there is no calibration that is worth a write yet",
    "CANDIDATE": "there is a calibration worth writing; some gates hold it back",
    "QUALIFIED": "a calibration passed every gate and waits for approval",
    "PREPARING": "a write is being journalled; nothing was sent",
    "CHECKING": "the device is read once more before the write; nothing was changed",
    "STAGING": "registers 23 and 84 are being written",
    "STAGED": "the device holds the new values in RAM",
    "TRIAL": "the new values are on trial against the old ones, on live data",
    "PROVEN": "the new values are proven better; they are in RAM, not in flash",
    "SAVE_PREPARING": "the save to flash is being journalled",
    "SAVING": "the flash is being written",
    "COMMITTED": "saved; the next reading after a power cycle confirms it",
    "CONFIRMED": "saved, and read back after a restart of the device",
    "ROLLING_BACK": "the old values are being put back",
    "ROLLED_BACK": "the old values are in force again",
    "SET_ASIDE": "the old values are in force while a program saves or resets; then it goes on",
    "FAULT": "ALARM: the device is in a state that this program cannot mend alone",
    "FLASH_TORN": "ALARM: the flash holds neither the old nor the new values",
    "LOCKED": "locked: nothing is written until a person unlocks",
}

#: how the write-back calls a vehicle that says nothing, and what that is without a file for it
UNHEARD = "the vehicle has not said that a write is safe"
NO_INTERLOCK = (
    "no interlock is configured, so nothing is ever written: set interlock.file, a file that the "
    "vehicle keeps rewriting with the word safe"
)

_NEXT = {
    "STAGING": "nothing: the write takes a second or two",
    "STAGED": "nothing: the trial begins by itself",
    "TRIAL": "drive as usual: two turns or ten minutes, then the new values are proven or undone",
    "SAVING": "stand still: the save takes a second",
    "COMMITTED": "nothing: the device's next restart confirms the save",
    "FAULT": "see `ahrsd registers history`, then `ahrsd operator rollback` or "
    "`ahrsd operator unlock REASON`",
    "FLASH_TORN": "see `ahrsd registers history`, write the old values back, then "
    "`ahrsd operator unlock REASON`",
    "LOCKED": "find out why (`ahrsd registers history`), then `ahrsd operator unlock REASON`",
}

#: states in which the new values are in the device, so that what holds is about another write
WRITTEN = frozenset({"STAGING", "STAGED", "TRIAL", "SAVING", "COMMITTED", "CONFIRMED"})


def explain_json(status: Mapping[str, Any]) -> dict[str, object]:
    """`ahrsd.explain/1` out of a status: the state, what holds, and what to do next."""
    back = status["write_back"]
    state = str(back["state"])
    shut, others = holding(status)
    return {
        "schema": SCHEMA,
        "state": state,
        "meaning": STATES[state],
        "mode": status["mode"],
        "mode_now": status["mode_now"],
        "stream": stream_trouble(status),
        "sensors": list(status["sensors"]),
        "estimator": estimator_trouble(status),
        "warm_start": str(status.get("warm_start", "")),
        "files": list(status["complaints"]),
        "mismatch": _mismatch(status),
        "warnings": list((status.get("estimate") or {}).get("warnings", ())),
        "gates": shut,
        "others": others,
        "next": _next(status, state, shut, others),
    }


def holding(status: Mapping[str, Any]) -> tuple[list[Mapping[str, Any]], list[str]]:
    """The gates that hold the next step, and what else does.

    A red gate that guards another step (the flash, a write that nobody approves) holds nothing now.
    """
    gates = {f"gate {gate['gate']}": gate for gate in status["gates"]}
    shut, others = [], []
    for text in status["write_back"]["holds"]:
        gate = gates.get(text.partition(": ")[0])
        if gate is None:
            others.append(
                NO_INTERLOCK if status["interlock"] == "none" and text == UNHEARD else text
            )
        else:
            shut.append(gate)
    return shut, others


def stream_trouble(status: Mapping[str, Any]) -> str:
    """What is wrong with the stream; empty where nothing is."""
    if not status["link"]["open"]:
        return f"no device on {status['link']['port']}: waiting for it"
    refused = status["stream"]["refused"]
    if refused and not status["stream"]["samples"]:
        return str(refused[0])
    if not status["stream"]["samples"]:
        return "no samples yet"
    if waits := status["stream"]["waits_for"]:
        return f"the vehicle does not tell {', '.join(waits)}: nothing is calibrated without it"
    return ""


def estimator_trouble(status: Mapping[str, Any]) -> str:
    """Why there is no estimator now; empty where there is one."""
    found = status["estimator"]
    if found["state"] == "FAILED":
        return (
            f"FAILED: {found['reason']}; nothing is written from it, and it begins anew in "
            f"{found['begins_anew_in_s']:.0f} s"
        )
    return "STUCK: the service manager's watchdog ends it" if found["state"] == "STUCK" else ""


def _mismatch(status: Mapping[str, Any]) -> str:
    """What stepped on the vehicle, while the estimate still rests on data from before it."""
    found = status["mismatch"]
    return str(found["step"]["text"]) if found["open"] else ""


def _next(
    status: Mapping[str, Any],
    state: str,
    shut: Sequence[Mapping[str, Any]],
    others: Sequence[str],
) -> str:
    """One thing to do: what is nearest to the cause comes first."""
    if status["sensors"] and status["link"]["open"]:
        return str(status["sensors"][0])
    if wrong := stream_trouble(status):
        return wrong
    if state in _NEXT:
        return _NEXT[state]
    if shut:
        return str(shut[0]["advice"])
    holds = status["write_back"]["holds"]
    if not status["gates"]:
        return "drive two full circles in calm surroundings: there is no estimate to judge yet"
    if not holds:
        return "nothing: the next step is taken by itself"
    proposal = status["write_back"]["proposal"]
    asks = [text for text in holds if "operator must approve" in text]
    if proposal is not None and asks == list(holds):
        return f"look at it (`ahrsd status`), then: ahrsd operator approve {proposal['id']}"
    return others[0]


def explain_lines(explained: Mapping[str, Any]) -> list[str]:
    """The same for a terminal."""
    mode = explained["mode"]
    if explained["mode_now"] != mode:
        mode = f"{mode} (now {explained['mode_now']})"
    lines = [f"{explained['state']}: {explained['meaning']}", f"mode {mode}"]
    if explained["stream"]:
        lines.append(f"stream: {explained['stream']}")
    lines += [f"sensor: {text}" for text in explained["sensors"]]
    if explained["estimator"]:
        lines.append(f"estimator: {explained['estimator']}")
    if explained["warm_start"]:
        lines.append(f"warm start: {explained['warm_start']}")
    lines += [f"file: {text}" for text in explained["files"]]
    if explained["mismatch"]:
        lines.append(f"mismatch: {explained['mismatch']}")
    lines += [f"estimate: {text}" for text in explained["warnings"]]
    write = "further write" if explained["state"] in WRITTEN else "write"
    gates: Sequence[Mapping[str, Any]] = explained["gates"]
    if gates:
        holds = "1 gate holds" if len(gates) == 1 else f"{len(gates)} gates hold"
        lines.append(f"{holds} a {write} back:")
        lines += _gate_lines(gates)
    if explained["others"]:
        lines.append("also:" if gates else f"what holds a {write} back:")
        lines += [f"  {text}" for text in explained["others"]]
    return [*lines, f"next: {explained['next']}"]


def _gate_lines(gates: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line a gate; gates that cannot be measured for the same reason share one."""
    unmeasured: dict[str, list[str]] = {}
    lines = []
    for gate in gates:
        if gate["value"] is None:
            unmeasured.setdefault(gate["advice"], []).append(gate["gate"])
        else:
            lines.append(_gate_line(gate))
    return lines + [f"  not measured: {', '.join(g)}: {why}" for why, g in unmeasured.items()]


def _gate_line(gate: Mapping[str, Any]) -> str:
    value, unit = gate["value"], f" {gate['unit']}" if gate["unit"] else ""
    held = f", since {_span(gate['for_s'])}" if gate["for_s"] is not None else ""
    limit = gate["limit"]
    allowed = "" if limit is None else f" (limit {limit:.3g}{unit})"
    return f"  {gate['gate']:<28} {value:.3g}{unit}{allowed}{held}: {gate['advice']}"


def _span(seconds: float) -> str:
    if seconds < 120.0:
        return f"{max(seconds, 0.0):.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


# -- The status in lines ---------------------------------------------------------------------------


Status = Mapping[str, Any]


def status_lines(status: Status) -> list[str]:
    """How the daemon stands, for a person: device, stream, motion, estimate, write-back."""
    lines = [device_line(status), stream_line(status), errors_line(status)]
    lines += share_lines(status)
    lines += [f"sensor: {text}" for text in status["sensors"]]
    lines += [motion_line(status), estimator_line(status), *estimate_lines_of(status)]
    lines += [f"warm start: {status.get('warm_start', '')}"]
    lines += [mismatch_line(status), write_back_line(status), *candidate_lines(status)]
    lines += [f"file: {text}" for text in status["complaints"]]
    lines += [f"warning: {text}" for text in status["warnings"]]
    return [line for line in lines if not line.endswith(": ")]


def device_line(status: Status) -> str:
    """Which device, on which port."""
    device, link = status["device"], status["link"]
    if not link["open"]:
        return f"device: gone from {link['port']}, waiting for it"
    name = "not asked" if device is None else f"{device['model']} serial {device['serial']}"
    firmware = "" if device is None else f", firmware {device['firmware']}"
    return f"device: {name}{firmware} on {link['port']} at {link['baud']} Bd"


def share_lines(status: Status) -> list[str]:
    """Where other programs find the device, and what became of their commands and their bytes."""
    return [
        f"share: {share['port']} " + ", ".join([*_used(share), *_troubles(share)])
        for share in status.get("shares", ())
    ]


def _used(share: Status) -> list[str]:
    if not share.get("send"):
        used = "in use" if share["open"] else "not open"
        return [used, counted(share["commands"], "command")]
    readers = share["readers"]
    return [share["send"], "sent" if readers is None else counted(readers, "reader")]


_TROUBLES = {
    "refused": "refused",
    "dropped": "dropped",
    "lost_bytes": "bytes lost by a reader that is too slow",
    "turned_away": "turned away",
    "ignored_bytes": "bytes of readers thrown away",
}


def _troubles(share: Status) -> list[str]:
    found = [f"{share[key]} {words}" for key, words in _TROUBLES.items() if share.get(key)]
    return [*found, *filter(None, [share.get("fault")])]


def stream_line(status: Status) -> str:
    """Samples and rate."""
    stream = status["stream"]
    rate = _number(stream["samples_per_s"], "{:.1f} Hz", "rate not known yet")
    refused = f"; {stream['refused'][0]}" if stream["refused"] and not stream["samples"] else ""
    return f"stream: {counted(stream['samples'], 'sample')}, {rate}{refused}"


def errors_line(status: Status) -> str:
    """What went wrong on the wire; ends in ": " where nothing did."""
    stream = status["stream"]
    said = (
        (stream["rejected"], f"{stream['rejected']} rejected"),
        (stream["skipped_bytes"], f"{counted(stream['skipped_bytes'], 'byte')} skipped"),
        (stream["gaps"], counted(stream["gaps"], "gap")),
        (stream["restarts"], counted(stream["restarts"], "device restart")),
        (stream["faults"], f"{stream['faults']} VNERR"),
    )
    return "errors: " + ", ".join(words for count, words in said if count)


def motion_line(status: Status) -> str:
    """What the vehicle has shown, and what to do next."""
    motion = status["motion"]
    if motion is None:
        return "motion: nothing yet: drive two full circles"
    shown = [_number(motion["heading_deg"], "{:.0f} of 360 deg of heading", "")]
    shown += [_number(motion[axis], name + " +-{:.0f}", "") for axis, name in _TILTS]
    next_ = f"; next: {motion['next']}" if motion["next"] else ""
    return "motion: " + (", ".join(text for text in shown if text) or "none yet") + next_


_TILTS = (("roll_deg", "roll"), ("pitch_deg", "pitch"))


def heading_line(status: Status) -> str:
    """The heading now and by the new calibration, and how well the new one is known."""
    seen = status.get("readings")
    if seen is None or (old := old_reading(status)):
        return f"heading: {'no samples yet' if seen is None else old}"
    if seen["heading_deg"] is None:
        return "heading: not known, the stream has no acceleration"
    now = f"heading: {seen['heading_deg']:.1f} deg"
    if seen["heading_would_be_deg"] is None:
        return f"{now}; with the new calibration: not known before it has converged"
    change = turned_deg(seen["heading_deg"], seen["heading_would_be_deg"])
    sigma_deg = (status["estimate"] or {}).get("heading_sigma_deg")
    sigma = "" if sigma_deg is None else f" +- {sigma_deg:.2f} deg (1 sigma)"
    return f"{now}; would be {seen['heading_would_be_deg']:.1f}{sigma}, {change:+.1f} deg"


def reading_lines(status: Status) -> list[str]:
    """Attitude, field and rates of turn now; nothing where there are none."""
    seen = status.get("readings")
    if seen is None or old_reading(status):
        return []
    raw, turn = seen["raw_b_gauss"], seen["gyro_b_rad_s"]
    if None in raw or None in turn:
        return ["readings: of no use, the sensor sends what is no number"]
    size = math.hypot(*seen["corrected_b_gauss"])
    lines = [
        "field: raw " + ", ".join(f"{one * 1e3:+.0f}" for one in raw) + " mG; "
        f"corrected {size * 1e3:.0f} mG",
        "turning: " + ", ".join(f"{math.degrees(one):+.1f}" for one in turn) + " deg/s",
    ]
    if seen["roll_deg"] is not None:
        lines[1] += f"; roll {seen['roll_deg']:+.1f}, pitch {seen['pitch_deg']:+.1f} deg"
    return lines


OLD_READING_S = 3.0  # older, a reading says nothing of now


def old_reading(status: Status) -> str:
    """Why the newest reading says nothing of now; empty where it does, or there is none."""
    seen = status.get("readings")
    if seen is None or (seen["age_s"] or 0.0) <= OLD_READING_S:
        return ""
    return f"the newest sample is {seen['age_s']:.0f} s old"


def turned_deg(before_deg: float, after_deg: float) -> float:
    """From one heading to the other, in -180..180; positive to the right."""
    return (after_deg - before_deg + 180.0) % 360.0 - 180.0


def estimate_lines_of(status: Status) -> list[str]:
    """The estimate with its sigmas, and what is wrong with it."""
    estimate = status["estimate"]
    if estimate is None:
        return ["estimate: none yet"]
    done = "converged" if estimate["converged"] else "not converged"
    unseen = ", ".join(estimate["unobservable"])
    held = f"; not determined: {unseen}" if unseen else ""
    sigma = _heading(estimate["heading_sigma_deg"])
    iron = _vector(estimate["hard_iron_gauss"], estimate["sigma_hard_iron_gauss"])
    bias = _vector(estimate["gyro_bias_rad_s"], estimate["sigma_gyro_bias_rad_s"])
    return [
        f"estimate: {done}; {sigma}{held}",
        f"  hard iron {iron} mG",
        f"  gyro bias {bias} mrad/s",
        *(f"  warning: {text}" for text in estimate.get("warnings", ())),
    ]


def estimator_line(status: Status) -> str:
    """That the estimator broke off; ends in ": " where it did not."""
    found = status["estimator"]
    if found["state"] == "STUCK":
        return "estimator: STUCK at one piece of work for longer than any takes"
    if not found["failures"]:
        return "estimator: "
    times = "once" if found["failures"] == 1 else f"{found['failures']} times"
    if found["state"] == "FAILED":
        return (
            f"estimator: FAILED: {found['reason']}; begins anew in "
            f"{found['begins_anew_in_s']:.0f} s (it broke off {times})"
        )
    return f"estimator: runs again; it broke off {times}, last: {found['reason']}"


def candidate_lines(status: Status) -> list[str]:
    """What would be written, to be looked at before it is approved, or what was."""
    back = status["write_back"]
    proposal = back["proposal"]
    if proposal is None:
        return []
    change = _number(proposal["heading_change_deg"], "heading changes by up to {:.1f} deg", "")
    lead = "it would be written" if back["transaction"] is None else "its write is under way,"
    return [
        f"candidate: {proposal['id']}, {change}; {lead} as",
        *(f"  {line}" for line in proposal["lines"]),
    ]


def mismatch_line(status: Status) -> str:
    """What stepped last; ends in ": " where nothing did."""
    step = status["mismatch"]["step"]
    if step is None:
        return "mismatch: "
    ended = "" if status["mismatch"]["open"] else " (calibrated anew since)"
    return f"mismatch: {step['text']}{ended}"


def write_back_line(status: Status) -> str:
    """State and mode."""
    back = status["write_back"]
    count = len(back["holds"])
    holds = f"{counted(count, 'thing')} {'holds' if count == 1 else 'hold'}"
    wait = f"; {holds} a write (ahrsd explain)" if count else ""
    return f"write-back: {back['state']}, mode {status['mode']}: {STATES[back['state']]}{wait}"


def _vector(values: Sequence[float], sigmas: Sequence[float]) -> str:
    return ", ".join(
        f"{v * 1e3:+.2f} +- {s * 1e3:.2f}" for v, s in zip(values, sigmas, strict=True)
    )


def _heading(sigma_deg: float | None) -> str:
    """How well the heading is known; a sigma beyond any use is no figure."""
    if sigma_deg is None or not sigma_deg < UNKNOWN_HEADING_DEG:
        return "heading not known"
    return f"heading known to {sigma_deg:.2f} deg (1 sigma)"


def _number(value: float | None, text: str, missing: str) -> str:
    return missing if value is None else text.format(value)


def service_line(status: Status) -> str:
    """One line for `systemctl status`; it changes only when something changes for a person."""
    if not status["link"]["open"]:
        return "waiting for the device"
    shut, _ = holding(status)
    waits = f", waits for {shut[0]['gate']}" if shut else ""
    flowing = "" if status["stream"]["samples"] else ", no samples yet"
    return f"{status['write_back']['state']}, mode {status['mode']}{waits}{flowing}"
