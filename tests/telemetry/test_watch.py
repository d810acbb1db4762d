"""The live view: what fits on a terminal, the cause first."""

from collections import deque

from rich.console import Console

from ahrsd.cli.watch import event_line, screen
from ahrsd.telemetry.lines import motion_line


def gate(name, ok=False):
    return {
        "gate": name, "value": 2.0, "limit": 1.0, "unit": "deg", "ok": ok, "since_s": 0.0,
        "for_s": 60.0, "advice": f"turn for {name}",
    }  # fmt: skip


def status(count):
    shut = [gate(f"family.gate{k}") for k in range(count)]
    return {
        "mode": "stage",
        "mode_now": "stage",
        "device": {"model": "VN-100", "serial": 7, "firmware": "3.1"},
        "link": {"open": True, "port": "/dev/vn100", "baud": 115200},
        "stream": {
            "samples": 500, "samples_per_s": 40.0, "refused": [], "waits_for": [],
            "rejected": 0, "faults": 0,
            "skipped_bytes": 0, "gaps": 0, "restarts": 0,
        },
        "motion": {"heading_deg": None, "roll_deg": None, "pitch_deg": None, "next": "drive"},
        "sensors": [],
        "estimator": {"state": "RUNNING", "reason": "", "failures": 0, "begins_anew_in_s": 0.0},
        "complaints": [],
        "interlock": "safe",
        "estimate": None,
        "mismatch": {"open": False, "step": None},
        "gates": [*shut, gate("step.auto"), gate("green.one", ok=True)],
        "write_back": {
            "state": "CANDIDATE",
            "holds": [f"gate {one['gate']}: {one['advice']}" for one in shut],
            "proposal": None,
        },
        "warnings": [],
    }  # fmt: skip


def shown(count, most):
    console = Console(width=120, height=50, file=None, record=True, force_terminal=False)
    with console.capture() as captured:
        console.print(screen(status(count), deque(["CANDIDATE -> QUALIFIED: all"]), most))
    return captured.get()


def test_gates_that_hold_are_listed_with_what_to_do_and_what_happened():
    text = shown(2, 10)
    assert "family.gate0" in text
    assert "family.gate1" in text
    assert "step.auto" not in text  # guards a write that nobody approves
    assert "turn for family.gate0" in text
    assert "CANDIDATE -> QUALIFIED: all" in text
    assert "1 of 3 gates are green" in text
    assert "more" not in text


def test_a_long_list_is_cut_and_says_so():
    text = shown(20, 5)
    assert "family.gate4" in text
    assert "family.gate5" not in text
    assert "and 15 more; 1 of 21 gates are green" in text


def test_motion_that_was_not_seen_yet_says_so():
    assert motion_line(status(1)) == "motion: none yet; next: drive"


def test_lines_of_what_happened():
    assert event_line({"record": "note", "level": "warning", "text": "gone"}) == "warning: gone"
    assert "QUALIFIED" in event_line(
        {"record": "state", "old": "CANDIDATE", "new": "QUALIFIED", "reason": "all"}
    )
    assert event_line({"record": "gap", "lost": 3}) == (
        "(this terminal was too slow: 3 records lost)"
    )
    assert event_line({"record": "gates"}) == ""
