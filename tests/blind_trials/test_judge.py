"""The scorer on answers whose scores are known beforehand."""

import math

import pytest
from blind_trials import judge as j
from blind_trials.answers import ClaimedEffect, ClaimedParameter, ToolAnswer, read_answer
from blind_trials.judge import compare, judge, overlap
from blind_trials.scores import calibration_error, error_rate, scores, wilson
from blind_trials.units import normal


def effect(name="hard_iron_step", **changes):
    return {
        "effect": name,
        "source": name,
        "frame": "sensor",
        "frames": ["sensor"],
        "either_half": False,
        "strength": 1e-3,
        "unit": "gauss",
        "limit": 5e-4,
        "multiple": 2.0,
        "snr": 14.0,
        "right": [name],
        "parents": [],
        "parameters": [],
        "onset_s": None,
        "intervals_s": [],
    } | changes


def truth(kind, *effects, **changes):
    return {
        "id": "00000001",
        "kind": kind,
        "noise_law": "white",
        "noise": {},
        "allowed": [],
        "motion": "wam",
        "rate_hz": 40.0,
        "duration_s": 400.0,
        "withheld": None,
        "effects": list(effects),
        "oracle_gain_nats_per_sample": 0.01,
    } | changes


def finding(
    name, *alternatives, confidence=0.9, frame="sensor", spans=(), parameters=(), gain=None
):
    return ClaimedEffect(name, confidence, alternatives, frame, spans, parameters, gain, None)


def said(*findings, unexplained=False, frame=None, spans=(), failure=None, closed=None):
    return ToolAnswer(
        failure, "", 1.0, bool(findings) or unexplained, findings, unexplained, frame, spans, closed
    )


STEP = truth("single", effect())


@pytest.mark.parametrize(
    ("case", "answer", "word", "error"),
    [
        (truth("null"), said(), j.QUIET, False),
        (truth("null"), said(finding("gyro_scale")), j.FALSE, True),
        (truth("null"), said(unexplained=True), j.UNKNOWN, False),
        (truth("null", allowed=["noise_burst"]), said(finding("noise_burst")), j.QUIET, False),
        (truth("null"), said(failure="crashed"), j.NONE, True),
        (STEP, said(finding("hard_iron_step")), j.RIGHT, False),
        (STEP, said(finding("gyro_scale", "hard_iron_step")), j.IN_SET, True),
        (STEP, said(finding("hard_iron_step"), finding("gyro_scale")), j.ADDED, True),
        (STEP, said(finding("gyro_scale")), j.WRONG, True),
        (STEP, said(), j.MISSED, True),
        (STEP, said(unexplained=True), j.UNKNOWN, True),
        (truth("withheld", effect()), said(unexplained=True, frame="sensor"), j.RIGHT, False),
        (truth("withheld", effect()), said(finding("gyro_scale")), j.FALSE, True),
        (truth("outside", effect(None, right=[], parents=["switched_device"])),
         said(finding("switched_device")), j.RIGHT, False),
        (truth("outside", effect(None, right=[])), said(), j.MISSED, True),
        (truth("unidentifiable", effect()), said(), j.QUIET, False),
        (truth("unidentifiable", effect()), said(finding("gyro_scale")), j.FALSE, True),
    ],
)  # fmt: skip
def test_every_verdict_is_reached(case, answer, word, error):
    verdict = judge(case, answer)
    assert (verdict.word, verdict.error) == (word, error)


@pytest.mark.parametrize(
    ("names", "word"),
    [
        (["a", "b"], j.RIGHT),
        (["b", "a"], j.RIGHT),
        (["a"], j.PARTLY),
        (["a", "b", "c"], j.ADDED),
        (["a", "c"], j.WRONG),
        (["a", "c|b"], j.IN_SET),
        ([], j.MISSED),
    ],
)
def test_pairs(names, word):
    pair = truth("pair", effect("a", multiple=3.0), effect("b", multiple=2.5))
    verdict = judge(pair, said(*(finding(*name.split("|")) for name in names)))
    assert (verdict.word, verdict.multiple) == (word, 2.5)


def test_effect_of_the_same_signal_is_right_but_not_strictly():
    lag = truth("single", effect("mag_low_pass", right=["mag_low_pass", "mag_time_lag"]))
    verdict = judge(lag, said(finding("mag_time_lag")))
    assert (verdict.word, verdict.first_right, verdict.strict) == (j.RIGHT, True, False)


def test_table_in_degrees_may_be_refused_with_that_reason():
    case = truth("single", effect("unit_error"))
    refused = ToolAnswer("exit 2", "gyro: median 30, looks like deg/s", 0.3)
    assert judge(case, refused).word == j.RIGHT
    assert judge(case, ToolAnswer("exit 2", "no such file", 0.3)).word == j.NONE


def test_intervals_onset_gain_and_coefficients_of_a_right_finding_are_scored():
    case = truth(
        "single",
        effect(
            onset_s=120.0,
            intervals_s=[[120.0, 400.0]],
            parameters=[
                {"name": "step_x", "value": 1e-3, "unit": "gauss"},
                {"name": "step_y", "value": 0.0, "unit": "gauss"},
                {"name": "step_z", "value": -1e-3, "unit": "gauss"},
            ],
        ),
    )
    parameters = (
        ClaimedParameter("onset", 121.0, 0.5, "s"),
        ClaimedParameter("field_z", -1.2, 0.1, "mG"),
        ClaimedParameter("field_x", 1.1, 0.1, "mG"),
        ClaimedParameter("field_y", 0.1, 0.1, "mG"),
    )
    answer = said(
        finding("hard_iron_step", spans=((123.0, 400.0),), parameters=parameters, gain=0.0099)
    )
    verdict = judge(case, answer)
    assert verdict.onset_error_s == pytest.approx(1.0)
    assert verdict.overlap == pytest.approx(277 / 280)
    assert verdict.gain == pytest.approx(0.99)
    assert verdict.pulls == pytest.approx((1.0, 1.0, -2.0))
    assert verdict.relative == pytest.approx(math.sqrt(0.01 + 0.01 + 0.04) / math.sqrt(2))
    assert verdict.frame_right is True
    assert judge(case, said(finding("hard_iron_step", frame="world"))).frame_right is False


def test_semireal_is_judged_beyond_the_control():
    lag = effect("mag_time_lag", parameters=[{"name": "lag", "value": 0.02, "unit": "s"}])
    case = truth("semireal", lag)

    def of(value, *more):
        return said(
            finding("mag_time_lag", parameters=(ClaimedParameter("tau", value, 1.0, "ms"),)),
            *map(finding, more),
        )

    right = judge(case, of(31.5, "eddy_current"), of(11.5, "eddy_current"))
    assert (right.word, right.relative) == (j.RIGHT, pytest.approx(0.0, abs=1e-12))
    assert judge(case, of(31.5, "gyro_scale"), of(11.5)).word == j.ADDED
    unmoved = judge(case, of(11.5), of(11.5))
    assert (unmoved.word, unmoved.error) == (j.MISSED, True)


def test_finding_in_the_control_is_not_a_false_finding():
    case = truth("semireal", effect("gyro_scale"))
    control = said(finding("mag_time_lag", "mag_low_pass"))
    both = said(finding("gyro_scale"), finding("mag_low_pass"))
    assert judge(case, both, control).word == j.RIGHT
    assert judge(case, both, said()).word == j.ADDED
    again = judge(case, said(finding("mag_low_pass"), unexplained=True, frame="gyro"), control)
    assert (again.word, again.detected, again.first_right) == (j.UNKNOWN, True, False)
    as_before = judge(case, said(finding("mag_low_pass")), control)
    assert (as_before.word, as_before.detected, as_before.first_right) == (j.MISSED, False, None)
    wrong = judge(case, said(finding("eddy_current")), control)
    assert (wrong.word, wrong.detected, wrong.in_set) == (j.WRONG, True, False)


def test_an_unknown_of_the_control_is_no_detection():
    case, room = truth("semireal", effect("gyro_scale")), said(unexplained=True, frame="world")
    assert judge(case, room, room).detected is False
    assert judge(case, said(unexplained=True, frame="gyro"), room).detected is True
    assert judge(case, room, said()).detected is True


def test_a_delay_of_the_other_sensor_counts_against_the_controls():
    lag = effect("gyro_time_lag", right=["gyro_time_lag", "mag_time_lag"])
    case = truth("semireal", lag | {"parameters": [{"name": "lag", "value": 0.03, "unit": "s"}]})

    def of(name, value):
        return said(finding(name, parameters=(ClaimedParameter("lag", value, 1e-3, "s"),)))

    own = of("mag_time_lag", 0.012)
    turned = judge(case, of("gyro_time_lag", 0.018), own)
    assert (turned.word, turned.relative) == (j.RIGHT, pytest.approx(0.0, abs=1e-12))
    assert judge(case, of("mag_time_lag", 0.018), own).word == j.MISSED
    silent = case | {"noise": {"own_delay_s": 0.012}}
    alone = judge(silent, of("gyro_time_lag", 0.018), said())
    assert (alone.word, alone.relative) == (j.RIGHT, pytest.approx(0.0, abs=1e-12))
    assert judge(silent, of("mag_time_lag", 0.010), said()).error


def test_half_a_step_is_scored_as_a_delay():
    lag = effect("mag_time_lag", right=["mag_time_lag", "gyro_integration"])
    case = truth("semireal", lag | {"parameters": [{"name": "lag", "value": 0.01, "unit": "s"}]})
    half = said(
        finding("gyro_integration", parameters=(ClaimedParameter("half_steps", 1.0, 0.1, "1"),))
    )
    late = said(finding("mag_time_lag", parameters=(ClaimedParameter("lag", 0.0225, 1e-3, "s"),)))
    verdict = judge(case, late, half)
    assert (verdict.word, verdict.relative) == (j.RIGHT, pytest.approx(0.0, abs=1e-12))


def test_true_cause_of_the_recording_is_not_a_false_finding():
    case = truth("semireal", effect("gyro_scale"), allowed=["mag_time_lag"])
    both = said(finding("gyro_scale"), finding("mag_time_lag"))
    assert judge(case, both, said()).word == j.RIGHT
    assert judge(case, said(finding("mag_time_lag")), said()).word == j.MISSED


def test_overlap_of_unions():
    assert overlap([(0, 10)], [(5, 15)]) == pytest.approx(5 / 15)
    assert overlap([(0, 2), (4, 6)], [(0, 6)]) == pytest.approx(4 / 6)
    assert overlap([(0, 2)], []) == 0.0
    assert overlap([], [(0, 1)]) is None


def test_on_and_off_are_the_same_to_the_hard_iron():
    lamp = effect(None, right=[], intervals_s=[[50.0, 150.0], [300.0, 400.0]], either_half=True)
    off = said(unexplained=True, frame="sensor", spans=((0.0, 50.0), (150.0, 300.0)))
    assert judge(truth("outside", lamp), off).overlap == pytest.approx(1.0)
    assert judge(truth("outside", lamp | {"either_half": False}), off).overlap == 0.0


def test_a_coefficient_of_another_unit_is_not_compared():
    one = finding("a", parameters=(ClaimedParameter("k", 1.0, 0.1, "rad"),))
    assert compare([{"name": "k", "value": 1.0, "unit": "gauss"}], one) == ((), None)


@pytest.mark.parametrize(
    ("unit", "same", "factor"),
    [
        ("mG/A", "gauss/A", 1e-3),
        ("deg/s/C", "rad/s/degC", math.pi / 180),
        ("rad/s/(m/s^2)", "rad s/m", 1.0),
        ("gauss/(m/s)", "gauss s/m", 1.0),
        ("gauss*s/A", "gauss s/A", 1.0),
        ("%", "1", 1e-2),
        ("ms", "s", 1e-3),
        ("", "1", 1.0),
        ("nT/m", "gauss/m", 1e-5),
    ],
)
def test_units(unit, same, factor):
    names, number = normal(unit)
    assert names == normal(same)[0]
    assert number / normal(same)[1] == pytest.approx(factor)


def test_units_that_differ():
    assert normal("gauss")[0] != normal("gauss/A")[0]
    assert normal("rad/s")[0] != normal("rad")[0]


def test_scores_of_a_round_made_by_hand():
    cases = [
        judge(truth("null", id="n1"), said()),
        judge(truth("null", id="n2"), said(finding("gyro_scale", confidence=0.3))),
        judge(STEP, said(finding("hard_iron_step", confidence=1.0), closed=True)),
        judge(STEP, said(finding("gyro_scale", "hard_iron_step", confidence=0.7))),
        judge(STEP, said()),
        judge(truth("single", effect(multiple=0.6)), said()),
    ]
    rows = {row.name: row for row in scores(cases)}
    assert rows["false names on nulls, white"].value == 0.5
    assert rows["false names on nulls, white"].met is False
    assert rows["detected, 2 x limit and more"].value == pytest.approx(2 / 3)
    assert rows["detected, all strengths"].value == pytest.approx(2 / 4)
    assert rows["first name right, all detected"].value == 0.5
    assert rows["truth in the set"].value == 1.0
    assert rows["truth in the set"].met is True
    assert rows["repaired simulation passes all checks"].value == 1.0
    # stated 0.3, 1.0, 0.7; right: no, yes, no
    assert rows["calibration error of the confidence"].value == pytest.approx((0.3 + 0.7) / 3)
    assert "pairs: both named, none added" not in rows
    mistakes = error_rate(cases)  # two nulls and three singles from twice the limit
    assert (mistakes.value, mistakes.cases) == (pytest.approx(3 / 5), 5)


def test_wilson_interval_is_the_textbooks():
    assert wilson(0, 30) == (0.0, pytest.approx(0.1135, abs=1e-4))
    low, high = wilson(97, 100)
    assert (low, high) == (pytest.approx(0.9155, abs=1e-4), pytest.approx(0.9897, abs=1e-4))


def test_alternatives_for_the_very_same_signal_share_the_confidence():
    names = ("mag_time_lag", "mag_low_pass")
    either = [truth("single", effect(name, right=list(names))) for name in names]
    found = ClaimedEffect(
        names[0], 0.7, (names[1], "eddy_current"), "sensor", (), (), None, None, (0.2, 0.1)
    )
    rows = {row.name: row for row in scores([judge(case, said(found)) for case in either])}
    assert rows["calibration error of the confidence"].value == pytest.approx(0.1)


def test_calibration_error_of_calibrated_and_overconfident_tools():
    honest = [(0.8, n % 5 != 0) for n in range(50)]
    boasting = [(1.0, n % 2 == 0) for n in range(50)]
    assert calibration_error(honest) == pytest.approx(0.0, abs=1e-12)
    assert calibration_error(boasting) == pytest.approx(0.5)


def test_documented_answer_format_is_read():
    answer = read_answer(
        {
            "cpu_seconds": 2.5,
            "said": "",
            "answer": {
                "schema": "ahrsd.diagnosis/1",
                "mismatch": True,
                "findings": [
                    {
                        "effect": "motor_current_field",
                        "confidence": 0.97,
                        "alternatives": [{"effect": "vibration_rectification", "confidence": 0.02}],
                        "where": {"intervals_s": [[120.0, 260.5]], "frame": "sensor"},
                        "parameters": [
                            {"name": "k_y", "value": 1.3e-3, "std": 4e-5, "unit": "gauss/A"},
                            {"name": "k_z", "value": None, "std": 4e-5, "unit": "gauss/A"},
                        ],
                        "heldout": {"nll_gain_per_sample": 0.05},
                        "separate_from": "pulse the motor",
                    }
                ],
                "unexplained": {"detected": False, "where": None},
                "posterior_predictive": {
                    "a": {"inside_after": True},
                    "b": {"inside_after": False},
                },
            },
        }
    )
    assert answer.names == ("motor_current_field",)
    assert answer.everything == {"motor_current_field", "vibration_rectification"}
    assert answer.findings[0].spans_s == ((120.0, 260.5),)
    assert [p.name for p in answer.findings[0].parameters] == ["k_y"]
    assert (answer.closed, answer.seconds, answer.unexplained) == (False, 2.5, False)


@pytest.mark.parametrize(
    "value", [None, [], {}, {"findings": 3, "unexplained": []}, {"findings": [{"where": 1}, "x"]}]
)
def test_malformed_answer_is_handled(value):
    answer = read_answer({"answer": value, "failure": "odd"})
    assert judge(STEP, answer).error is True
