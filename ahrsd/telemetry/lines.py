"""A status in lines for a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ahrsd.printable import counted
from ahrsd.report.calibration_json import UNKNOWN_HEADING_DEG
from ahrsd.telemetry.explain import STATES, holding

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
    counts = {
        "rejected": stream["rejected"],
        "bytes skipped": stream["skipped_bytes"],
        "gaps": stream["gaps"],
        "device restarts": stream["restarts"],
        "VNERR": stream["faults"],
    }
    return "errors: " + ", ".join(f"{count} {name}" for name, count in counts.items() if count)


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
    """The estimate with its sigmas."""
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
    """What would be written, to be looked at before it is approved."""
    proposal = status["write_back"]["proposal"]
    if proposal is None:
        return []
    change = _number(proposal["heading_change_deg"], "heading changes by up to {:.1f} deg", "")
    return [
        f"candidate: {proposal['id']}, {change}; it would be written as",
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
