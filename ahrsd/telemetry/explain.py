"""Why nothing is written, in words: which gate holds, since when, and what would open it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

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
