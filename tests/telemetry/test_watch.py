"""The live view: fits a terminal, with the cause first."""

from collections import deque

from rich.console import Console
from shown_status import cells, level_ring, motion

from ahrsd.cli.running.watch import Scroll, countdown, event_line, screen
from ahrsd.telemetry.driving import Pace
from ahrsd.telemetry.words import motion_line


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


def shown(count, **changes):
    console = Console(width=80, height=24, file=None, record=True, force_terminal=False)
    with console.capture() as captured:
        console.print(
            screen(status(count) | changes, deque(["CANDIDATE -> QUALIFIED: all"]), Pace())
        )
    return captured.get()


def test_closed_gates_are_listed_with_advice_and_events():
    text = shown(2)
    assert "family.gate0" in text
    assert "family.gate1" in text
    assert "step.auto" not in text  # guards a write that nobody approves
    assert "turn for family.gate0" in text
    assert "CANDIDATE -> QUALIFIED: all" in text
    assert "1 of 3 gates are green" in text


READINGS = {
    "time_s": 10.0, "age_s": 0.2, "raw_b_gauss": [0.2, 0.1, 0.4], "gyro_b_rad_s": [0.0, 0.0, 0.1],
    "corrected_b_gauss": [0.2, 0.0, 0.4], "heading_deg": 12.0, "heading_would_be_deg": 15.5,
    "roll_deg": 1.0, "pitch_deg": -2.0,
}  # fmt: skip


def test_essentials_are_in_the_first_24_lines_of_80_columns():
    text = shown(20, readings=READINGS, motion=motion(cells(level_ring)))
    first = text.splitlines()[:23]
    for words in (
        "turn for family.gate0",
        "heading: 12.0 deg; would be 15.5, +3.5 deg",
        "field: raw +200, +100, +400 mG",
        "turning: +0.0, +0.0, +5.7 deg/s; roll +1.0, pitch -2.0 deg",
        "level circle: 100 % shown",
        "tilts: 0 % shown, not at the present rate",
        "1 of 21 gates are green",
        "family.gate5",
    ):
        assert any(words in line for line in first), words
    assert max(map(len, first)) <= 80


def test_unmeasured_gates_with_one_reason_share_a_line():
    body = status(4)
    for one in body["gates"][1:4]:
        one.update(value=None, advice="keep turning")
    text = shown(0, gates=body["gates"], write_back=body["write_back"])
    assert "family.gate0" in text
    assert "family.gate1 and 2 more" in text
    assert "family.gate2" not in text.split("ahrsd")[0]


def test_further_lines_can_be_scrolled():
    console, scroll = Console(width=80, height=24, force_terminal=False), Scroll()
    whole = screen(status(30), deque(), Pace())
    total = len(console.render_lines(whole))

    def seen():
        with console.capture() as captured:
            console.print(scroll.seen(console, whole, 24), end="")
        return captured.get().splitlines()

    top = seen()
    assert len(top) == 24
    assert top[-1] == f"lines 1-23 of {total}: arrows scroll, q ends"
    scroll.key("down")
    assert seen()[:22] == top[1:23]
    for _ in range(9):
        scroll.key("page down")
    bottom = seen()
    assert bottom[-1] == f"lines {total - 22}-{total} of {total}: arrows scroll, q ends"
    assert "write-back: CANDIDATE" in "".join(bottom)
    scroll.key("home")
    assert seen() == top
    scroll.key("up")
    assert seen() == top
    assert not scroll.ended
    scroll.key("q")
    assert scroll.ended


def test_large_terminal_shows_everything():
    console, scroll = Console(width=120, height=200, force_terminal=False), Scroll()
    whole = screen(status(3), deque(), Pace())
    scroll.key("down")
    assert scroll.seen(console, whole, 200) is whole
    assert scroll.top == 0


def test_countdown_to_the_last_gate_is_shown():
    pace, body = Pace(), status(1)
    for at_s in (0.0, 30.0, 60.0):
        body["gates"][0] |= {"value": at_s, "limit": 300.0}
        pace.take(body | {"at_s": at_s, "motion": None})
    assert countdown(body, pace) == "about 4 min at the present rate (family.gate0 is last)"
    assert countdown(body, Pace()) == ""


def test_missing_motion_is_reported():
    assert motion_line(status(1)) == "motion: none yet; next: drive"


def test_lines_of_events():
    assert event_line({"record": "note", "level": "warning", "text": "gone"}) == "warning: gone"
    assert "QUALIFIED" in event_line(
        {"record": "state", "old": "CANDIDATE", "new": "QUALIFIED", "reason": "all"}
    )
    assert event_line({"record": "gap", "lost": 3}) == (
        "(this terminal was too slow: 3 records lost)"
    )
    assert event_line({"record": "gates"}) == ""
