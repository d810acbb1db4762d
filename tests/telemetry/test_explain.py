"""Text for every state, and one next step."""

import pytest

from ahrsd.telemetry.words import (
    NO_INTERLOCK,
    STATES,
    candidate_lines,
    estimator_line,
    explain_json,
    explain_lines,
    write_back_line,
)
from ahrsd.writeback.machine import WriteBack
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import State


def status(**changes):
    """A status of a healthy daemon, with changes."""
    body = {
        "mode": "commit",
        "mode_now": "commit",
        "link": {"open": True, "port": "/dev/vn100"},
        "stream": {"samples": 5000, "refused": [], "waits_for": []},
        "mismatch": {"open": False, "step": None},
        "sensors": [],
        "estimator": {"state": "RUNNING", "reason": "", "failures": 0, "begins_anew_in_s": 0.0},
        "complaints": [],
        "interlock": "safe",
        "gates": [],
        "write_back": {"state": "CANDIDATE", "holds": [], "proposal": None},
    }
    return body | changes


GATE = {
    "gate": "heldout_heading.rms",
    "value": 2.71,
    "limit": 1.5,
    "unit": "deg",
    "ok": False,
    "since_s": 100.0,
    "for_s": 720.0,
    "advice": "turn again elsewhere",
}


def test_every_state_has_a_description():
    assert set(STATES) == {state.value for state in State}


def test_closed_gate_is_shown_with_value_limit_age_and_advice():
    held = {"state": "CANDIDATE", "proposal": None}
    held["holds"] = ["gate heldout_heading.rms: turn again elsewhere", "the mode is observe"]
    lines = explain_lines(explain_json(status(gates=[GATE], write_back=held)))
    assert lines == [
        "CANDIDATE: there is a calibration worth writing; some gates hold it back",
        "mode commit",
        "1 gate holds a write back:",
        "  heldout_heading.rms          2.71 deg (limit 1.5 deg), since 12 min: "
        "turn again elsewhere",
        "also:",
        "  the mode is observe",
        "next: turn again elsewhere",
    ]


def test_closed_gate_of_another_step_is_not_shown():
    waiting = {"state": "QUALIFIED", "holds": ["an operator must approve 12ab34cd"]}
    waiting["proposal"] = {"id": "12ab34cd"}
    explained = explain_json(status(gates=[GATE | {"gate": "step.auto"}], write_back=waiting))
    assert explained["gates"] == []
    assert explained["next"].endswith("ahrsd operator approve 12ab34cd")


def test_unmeasured_gates_with_one_reason_share_a_line():
    missing = [
        GATE | {"gate": name, "value": None, "for_s": None, "advice": advice}
        for name, advice in (("a.rms", "turn"), ("b.held", "tilt"), ("a.max", "turn"))
    ]
    holds = [f"gate {gate['gate']}: {gate['advice']}" for gate in missing]
    held = {"state": "CANDIDATE", "holds": holds, "proposal": None}
    lines = explain_lines(explain_json(status(gates=missing, write_back=held)))
    assert lines[2:5] == [
        "3 gates hold a write back:",
        "  not measured: a.rms, a.max: turn",
        "  not measured: b.held: tilt",
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"link": {"open": False, "port": "/dev/vn100"}}, "no device on /dev/vn100"),
        (
            {"stream": {"samples": 0, "refused": ["VNYPR has no field"], "waits_for": []}},
            "VNYPR has no field",
        ),
        ({"stream": {"samples": 0, "refused": [], "waits_for": []}}, "no samples yet"),
        (
            {"stream": {"samples": 9, "refused": [], "waits_for": ["motor_current_a"]}},
            "the vehicle does not tell motor_current_a: nothing is calibrated without it",
        ),
        (
            {"write_back": {"state": "LOCKED", "holds": ["locked"], "proposal": None}},
            "find out why (`ahrsd registers history`), then `ahrsd operator unlock REASON`",
        ),
        (
            {
                "gates": [GATE | {"ok": True}],
                "write_back": {
                    "state": "QUALIFIED",
                    "holds": ["an operator must approve 12ab34cd"],
                    "proposal": {"id": "12ab34cd"},
                },
            },
            "look at it (`ahrsd status`), then: ahrsd operator approve 12ab34cd",
        ),
        ({"gates": [GATE | {"ok": True}]}, "nothing: the next step is taken by itself"),
        (
            {
                "gates": [GATE | {"ok": True}],
                "write_back": {
                    "state": "TRIAL",
                    "holds": ["the last write was 3 s ago"],
                    "proposal": None,
                },
            },
            "drive as usual: two turns or ten minutes, then the new values are proven or undone",
        ),
    ],
)
def test_next_step_follows_from_the_status(changes, words):
    assert words in explain_json(status(**changes))["next"]


STUCK = "the magnetometer gives the same value on all axes"


def test_faults_of_sensor_estimator_and_file_are_reported():
    failed = {"state": "FAILED", "reason": "LinAlgError: Singular matrix", "failures": 2}
    changes = {
        "sensors": [STUCK],
        "estimator": failed | {"begins_anew_in_s": 8.2},
        "complaints": ["interlock.file = /run/safe: is a FIFO, not a regular file"],
    }
    explained = explain_json(status(**changes))
    assert explained["next"] == STUCK
    assert explain_lines(explained)[2:5] == [
        f"sensor: {STUCK}",
        "estimator: FAILED: LinAlgError: Singular matrix; nothing is written from it, and it "
        "begins anew in 8 s",
        "file: interlock.file = /run/safe: is a FIFO, not a regular file",
    ]
    assert explain_json(status(sensors=[STUCK], stream={"samples": 0, "refused": []}))["next"] == (
        STUCK
    )


def test_missing_interlock_is_reported_with_its_key():
    unheard = WriteBack(WriteBackPolicy()).obstacles()[-2]
    held = {"state": "CANDIDATE", "holds": [unheard], "proposal": None}
    (text,) = explain_json(status(interlock="none", write_back=held))["others"]
    assert text.startswith("no interlock is configured, so nothing is ever written: set interlock.")
    (text,) = explain_json(status(interlock="not safe", write_back=held))["others"]
    assert text == unheard


def test_next_step_without_an_interlock_is_to_configure_one():
    unheard = WriteBack(WriteBackPolicy()).obstacles()[-2]
    held = {
        "state": "QUALIFIED",
        "holds": [unheard, "an operator must approve 12ab34cd"],
        "proposal": {"id": "12ab34cd"},
    }
    passed = {"gates": [GATE | {"ok": True}], "write_back": held}
    assert explain_json(status(interlock="none", **passed))["next"] == NO_INTERLOCK
    assert explain_json(status(interlock="not safe", **passed))["next"] == unheard


def test_number_of_obstacles_to_a_write_is_reported():
    back = {"state": "QUALIFIED", "holds": ["a"]}
    assert "; 1 thing holds a write (" in write_back_line(status(write_back=back))
    back["holds"] = ["a", "b"]
    assert "; 2 things hold a write (" in write_back_line(status(write_back=back))


def test_status_shows_the_candidate_to_be_reviewed():
    proposal = {
        "id": "12ab34cd",
        "lines": ["$VNWRG,23,1.1*XX", "$VNWRG,84,1*XX"],
        "heading_change_deg": 12.34,
    }
    back = {"proposal": proposal, "transaction": None}
    assert candidate_lines(status(write_back=back)) == [
        "candidate: 12ab34cd, heading changes by up to 12.3 deg; it would be written as",
        "  $VNWRG,23,1.1*XX",
        "  $VNWRG,84,1*XX",
    ]
    on_trial = candidate_lines(status(write_back={**back, "transaction": "12ab34cd-1"}))
    assert on_trial[0].endswith("; its write is under way, as")
    assert candidate_lines(status()) == []


def test_status_reports_a_failure_of_the_estimator():
    found = {"state": "RUNNING", "reason": "", "failures": 0, "begins_anew_in_s": 0.0}
    assert estimator_line({"estimator": found}) == "estimator: "
    found |= {"failures": 1, "reason": "LinAlgError: Singular matrix"}
    assert estimator_line({"estimator": found}) == (
        "estimator: runs again; it broke off once, last: LinAlgError: Singular matrix"
    )
    found |= {"failures": 3, "state": "FAILED", "begins_anew_in_s": 20.0}
    assert estimator_line({"estimator": found}) == (
        "estimator: FAILED: LinAlgError: Singular matrix; begins anew in 20 s "
        "(it broke off 3 times)"
    )


def test_remaining_residual_is_shown_with_the_estimate():
    text = "the residual follows the attitude: 0.4 mG; run `ahrsd diagnose` on the recording"
    explained = explain_json(status(estimate={"warnings": [text]}))
    assert explained["warnings"] == [text]
    assert f"estimate: {text}" in explain_lines(explained)
    assert explain_json(status(estimate=None))["warnings"] == []
