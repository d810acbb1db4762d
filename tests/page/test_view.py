"""Text of the page, value by value, from statuses of a daemon."""

import pytest
from shown_status import gate as view_gate

from ahrsd.page import view
from ahrsd.page.app import SECTIONS, Board, Heard
from ahrsd.telemetry.driving import Pace

EVIL = "<script>alert(1)</script>"


def figures(found):
    return {one.name: (one.value, one.unit, one.sigma) for one in found}


def test_present_and_predicted_heading_are_shown(qualified):
    qualified["readings"] |= {"heading_deg": 7.4, "heading_would_be_deg": 359.45, "age_s": 0.1}
    qualified["estimate"]["heading_sigma_deg"] = 0.052
    assert figures(view.heading_figures(qualified)) == {
        "Heading now": ("007", "°", ""),
        "As it would be": ("359.4", "°", "0.05°"),
        "Difference": ("-8.0", "°", ""),
    }


def test_outdated_figures_are_not_shown(qualified):
    qualified["readings"]["age_s"] = 12.0
    assert {value for value, _, _ in figures(view.heading_figures(qualified)).values()} == {"–"}
    assert list(figures(view.reading_figures(qualified))) == ["Samples"]
    assert view.alarms(qualified)[0] == view.Alarm(
        "alarm", "The sensor is silent", "the newest sample is 12 s old"
    )
    qualified["readings"]["age_s"] = 0.1
    qualified["link"]["open"] = False
    assert {value for value, _, _ in figures(view.heading_figures(qualified)).values()} == {"–"}
    assert view.alarms(qualified)[0].title == "The device is gone"


def test_predicted_heading_is_missing_before_convergence(gathering):
    gathering["readings"]["heading_would_be_deg"] = None
    _, would_be, change = view.heading_figures(gathering)
    assert (would_be.value, would_be.sigma, would_be.note) == (
        "–",
        "",
        "once the estimate has converged",
    )
    assert change.value == "–"


def test_estimate_is_shown_with_its_sigma(qualified):
    qualified["estimate"] |= {
        "hard_iron_gauss": [0.0742, -0.0153, 0.0861],
        "sigma_hard_iron_gauss": [0.0001, 0.0002, 0.0004],
        "gyro_bias_rad_s": [0.00085, 0.0032, -0.0042],
        "sigma_gyro_bias_rad_s": [2e-5, 2e-5, 3e-5],
    }
    assert figures(view.estimate_figures(qualified)) == {
        "Hard iron x": ("+74.2", "mG", "0.1"),
        "Hard iron y": ("-15.3", "mG", "0.2"),
        "Hard iron z": ("+86.1", "mG", "0.4"),
        "Gyro bias x": ("+0.049", "°/s", "0.001"),
        "Gyro bias y": ("+0.183", "°/s", "0.001"),
        "Gyro bias z": ("-0.241", "°/s", "0.002"),
    }
    assert view.estimate_figures(qualified | {"estimate": None}) == []


def test_readings_are_shown(qualified):
    qualified["readings"] |= {
        "age_s": 0.1, "roll_deg": -0.3, "pitch_deg": 12.4, "gyro_b_rad_s": [0.0, 0.0, 0.1],
        "corrected_b_gauss": [0.3, 0.0, 0.4], "would_be_b_gauss": [0.0, 0.0, 0.49],
    }  # fmt: skip
    qualified["stream"]["samples_per_s"] = 49.96
    assert figures(view.reading_figures(qualified)) == {
        "Roll": ("+0", "°", ""),
        "Pitch": ("+12", "°", ""),
        "Turning": ("5.7", "°/s", ""),
        "Field now": ("500", "mG", ""),
        "Field as it would be": ("490", "mG", ""),
        "Samples": ("50", "Hz", ""),
    }


def test_closed_gates_have_advice_and_unmeasured_ones_share_a_row(gathering):
    rows = view.gate_rows(gathering, Pace())
    assert rows[0].name == "heldout_heading.windows"
    assert rows[0].advice.startswith("0 of 2 held-out segments are usable: keep turning")
    assert (rows[0].value, rows[0].limit) == ("0", "2")
    assert rows[0].meaning == "held-out segments that turned by 60 deg and more"
    (together,) = [row for row in rows if row.name.startswith("heldout_heading.rms")]
    assert together.name == "heldout_heading.rms and 4 more gates"
    assert "better.certain" in together.meaning
    assert view.gates_counted(gathering) == (40, 49)


def test_next_step_countdown_and_drive_are_shown(gathering, qualified):
    pace = Pace()
    assert view.next_step(gathering, may_approve=True).startswith("0 of 2 held-out segments")
    gathering["readings"]["gyro_b_rad_s"] = [0.0, 0.0, 0.01]
    pace.take(gathering)
    assert view.countdown(gathering, pace) == ""  # it looks for a moment only
    pace.take(gathering | {"at_s": gathering["at_s"] + 25.0})
    assert view.countdown(gathering, pace) == ("time not known: 2 gates made no progress lately")
    assert view.drive(gathering) == (
        "Keep turning: enough directions are covered; now the estimate is tested on new data."
    )
    for at_s in (200.0, 230.0):
        gathering["at_s"] = at_s
        gathering["readings"]["gyro_b_rad_s"] = [0.0, 0.0, 0.2]
        pace.take(gathering)
    assert view.countdown(gathering, pace) == "about 4 min at the present rate"
    assert view.next_step(qualified, may_approve=True) == (
        "Look at the candidate below, then approve it there."
    )
    assert "ahrsd operator approve 43278c0e" in view.next_step(qualified, may_approve=False)
    assert view.countdown(qualified, pace) == ""


def test_bars_have_percent_and_time(gathering):
    gathering["motion"]["next"] = "turn left about 120 deg more"
    circle, tilts = view.bars(gathering, Pace())
    assert (circle.name, circle.percent, circle.left) == (
        "level circle",
        75,
        "not at the present rate",
    )
    assert (tilts.name, tilts.percent, tilts.left, tilts.wanted) == ("tilts", 78, "", False)
    assert view.drive(gathering) == "Turn left about 120 deg more."
    assert view.bars(gathering | {"motion": None}, Pace()) == []


@pytest.mark.parametrize(
    ("changes", "kind", "title"),
    [
        ({"write_back": {"state": "FAULT"}}, "alarm", "FAULT"),
        ({"write_back": {"state": "LOCKED"}}, "alarm", "LOCKED"),
        ({"sensors": ["the gyro gives the same value on x"]}, "alarm", "Sensor"),
        ({"estimator": {"state": "FAILED", "reason": "singular"}}, "alarm", "Estimator"),
        ({"capture": {"error": "no space"}}, "warning", "Capture"),
        ({"complaints": ["write-safe: is a FIFO"]}, "warning", "File"),
        ({"mismatch": {"open": True, "step": {"text": "hard iron"}}}, "warning",
         "Something changed"),
    ],
)  # fmt: skip
def test_alarms_and_warnings_have_kind_and_title(qualified, changes, kind, title):
    assert view.alarms(qualified) == []
    for key, value in changes.items():
        qualified[key] = value if isinstance(value, list) else qualified[key] | value
    (found,) = view.alarms(qualified)
    assert (found.kind, found.title) == (kind, title)


def test_alarms_stand_above_warnings(qualified):
    qualified["warnings"] = ["register 44"]
    qualified["sensors"] = ["stuck"]
    assert [one.kind for one in view.alarms(qualified)] == ["alarm", "warning"]


def test_candidate_can_be_approved_only_while_qualified(qualified):
    found = view.candidate(qualified)
    assert (found.id, found.refusal) == ("43278c0e", "")
    assert found.change == "heading changes by up to 24.5°"
    assert found.lines[0].startswith("$VNWRG,23,")
    assert not found.written
    qualified["write_back"] |= {"state": "TRIAL", "transaction": "t1"}
    assert view.candidate(qualified).refusal.startswith("not to be approved now: the new values")
    assert view.candidate(qualified).written
    qualified["write_back"]["proposal"] = None
    assert view.candidate(qualified) is None


def test_sentences():
    assert view.sentence("turn left") == "Turn left."
    assert view.sentence("Done.") == "Done."
    assert view.sentence("then `ahrsd operator unlock`") == "Then `ahrsd operator unlock`"


# -- The sections ----------------------------------------------------------------------------------


def sections(status, at_s=0.0, now_s=0.5, **options):
    board = Board(may_approve=options.get("may_approve", False))
    heard = Heard(status, at_s, options.get("fault", ""))
    board.take(heard)
    return board.sections(heard, now_s)


def test_every_section_is_present(gathering):
    found = sections(gathering)
    assert set(found) == set(SECTIONS)
    assert "CANDIDATE" in found["head"]
    assert "40 of 49 open" in found["gates"]
    assert '<path class="dot shown" d="M' in found["sphere"]
    assert 'class="now"' in found["marker"]


def test_long_list_of_gates_is_folded(gathering):
    shut = [view_gate(f"observability.gate{k}") for k in range(9)]
    gathering["gates"] = shut
    holds = [f"gate {one['gate']}: {one['advice']}" for one in shut]
    gathering["write_back"]["holds"] = holds
    text = sections(gathering)["gates"]
    first, _, folded = text.partition("<details>")
    assert first.count('class="gate"') == 4
    assert "<summary>and 5 more</summary>" in folded
    assert folded.count('class="gate"') == 5
    gathering["write_back"]["holds"] = holds[:4]
    assert "<details>" not in sections(gathering)["gates"]


def test_form_names_the_candidate_only_if_approval_is_possible(qualified):
    field = '<input type="hidden" name="candidate" value="43278c0e" form="approve">'
    assert field in sections(qualified, may_approve=True)["candidate"]
    assert "<input" not in sections(qualified)["candidate"]
    assert "ahrsd operator approve 43278c0e" in sections(qualified)["candidate"]
    qualified["write_back"]["state"] = "TRIAL"
    assert "<input" not in sections(qualified, may_approve=True)["candidate"]


@pytest.mark.parametrize(
    ("now_s", "fault", "words"),
    [
        (4.0, "", "the daemon is silent"),
        (0.5, "/run/ahrsd/socket: no daemon answers", "no daemon answers"),
    ],
)
def test_no_old_values_remain_when_the_daemon_is_away(qualified, now_s, fault, words):
    found = sections(qualified, now_s=now_s, fault=fault)
    assert {name for name, text in found.items() if text} == {"alarms"}
    assert "The daemon is away" in found["alarms"]
    assert words in found["alarms"]


def test_duration_of_the_absence_is_shown(qualified):
    assert ", for 2 min." in sections(qualified, now_s=130.0)["alarms"]
    assert "nothing was received before" in sections(None, now_s=3.0)["alarms"]


def test_status_of_another_version_is_reported_and_not_interpreted(qualified):
    del qualified["gates"]
    found = sections(qualified)
    assert "it may be another version" in found["alarms"]
    assert found["heading"] == ""


def broken(status):
    """The status with one entry missing or of another type, for each entry in its first levels."""
    for key, value in status.items():
        yield key, {name: one for name, one in status.items() if name != key}
        for odd in (None, "odd", [], {}, [None], -1e308):
            yield key, status | {key: odd}
        for inner in value if isinstance(value, dict) else ():
            for odd in (None, "odd", [], {}, float("inf")):
                yield f"{key}.{inner}", status | {key: value | {inner: odd}}


@pytest.mark.parametrize("name", [pytest.param("gathering", marks=pytest.mark.slow), "qualified"])
def test_page_survives_any_status(name, request):
    whole = request.getfixturevalue(name)
    told = 0
    for where, status in broken(whole):
        found = sections(status, may_approve=True)
        assert set(found) == set(SECTIONS), where
        told += "it may be another version" in found["alarms"]
    assert told > 100


def test_foreign_text_is_not_interpreted(qualified):
    qualified["write_back"]["holds"] = [EVIL]
    qualified["write_back"]["proposal"]["lines"] = [EVIL]
    qualified["link"]["port"] = EVIL
    qualified["sensors"] = [EVIL]
    qualified["complaints"] = [EVIL]
    qualified["gates"][0] |= {"gate": EVIL, "advice": EVIL, "ok": False}
    for name, text in sections(qualified, may_approve=True).items():
        assert "<script" not in text, name
    assert "&lt;script&gt;" in sections(qualified)["alarms"]
