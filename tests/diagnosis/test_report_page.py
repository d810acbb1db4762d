"""The report of a diagnosis in a real browser, and its text."""

import inspect
import re
from dataclasses import replace
from html import escape
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from browser import BROWSER, look_at
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ahrsd.diagnosis.answer import predictive_checks
from ahrsd.diagnosis.answer.diagnosis import (
    Baseline,
    Check,
    Contribution,
    Cost,
    Diagnosis,
    Drawn,
    Finding,
    Heldout,
    Limit,
    RegimeMap,
    Share,
    Suspect,
    Unexplained,
    Validation,
    Value,
    Where,
)
from ahrsd.diagnosis.answer.text import answer_lines
from ahrsd.diagnosis.columns.roles import LABEL_CHARACTERS, label
from ahrsd.diagnosis.model import NullModel
from ahrsd.report import diagnosis_page
from ahrsd.report.diagnosis_page import _STATISTICS, write_diagnosis_report
from ahrsd.viewer.diagnosis import write_rrd


def diagnosis(**changes):
    """A diagnosis with one of everything, and text that HTML must escape."""
    rng = np.random.default_rng(1)
    time_s = np.arange(4000) / 12.0
    finding = Finding(
        effect="motor_current_field",
        confidence=0.97,
        alternatives=(Share("vibration_rectification", 0.02),),
        where=Where(((120.0, 260.5),), ("y", "z"), "sensor", "motor_current_a > 6"),
        parameters=(Value("field_per_ampere_y", 1.3e-3, 4e-5, "gauss/A"),),
        heldout=Heldout(1.2e-3, 1.0e-3, 0.052, 0.0006),
        cost_if_left_out=Cost(1.4e-3, 0.35),
        separate_from="pulse the motor at rest on one heading",
        words="the field of a motor current",
        equation="m += k I(t)",
        setting={"covariate": "motor_<1>_a", "reference": 0.1, "late_s": 0.25, "mean_s": 0.4},
        term=0,
    )
    left = Unexplained(
        detected=True,
        where=Where(((300.0, 320.0),), ("x",), "world"),
        heldout=Heldout(1e-3, 9e-4, 0.01, 0.0),
        size=2.5,
        unit="mG",
        single_source_share=0.93,
        follows=(Suspect("<b>throttle</b>", 0.95, 1e-6),),
    )
    drawn = Drawn(
        time_s=time_s,
        before=rng.standard_normal((4000, 3)),
        after=rng.standard_normal((4000, 3)),
        before_gauss=rng.standard_normal((4000, 3)) * 2e-3,
        after_gauss=rng.standard_normal((4000, 3)) * 1e-3,
        contributions=(
            Contribution(
                "motor_current_field", time_s, rng.standard_normal((4000, 3)) * 1e-3, "gauss"
            ),
        ),
        courses=(),
        evidence={"motor_current_field": 2102.0, "hysteresis": 5.0, "mag_time_lag": -2.0},
    )
    fields = {
        "recording": "dive <7>.csv",
        "baseline": Baseline(1.2e-3, -9.0, 1.09),
        "mismatch": True,
        "p_value": 1e-9,
        "findings": (finding,),
        "unexplained": left,
        "posterior_predictive": {
            "normalised_innovation": Check(1.0934, (0.97123, 1.0311), False, True),
            "autocorrelation": Check(255.2, (106.44, 384.1), False, True),
        },
        "notes": ("column a & b was left out",),
        "model": NullModel(np.eye(3), np.array([0.1, 0.0, -0.2]), np.zeros(3), 1e-3, 5e-4),
        "drawn": drawn,
        "validation": Validation(0.052, 0.01, 0.0006),
        "regime_map": (
            RegimeMap(
                "heading_deg", (0.0, 120.0, 240.0, 360.0), (2.0, 900.0, 1.0), (1.0, 2.0, 1.5)
            ),
            RegimeMap("motor_current_a", (0.0, 6.0, 27.0), (0.5, 400.0), (1.0, 2.0)),
        ),
    }
    return Diagnosis(**(fields | changes))


def test_text_of_a_diagnosis():
    assert answer_lines(diagnosis())[:13] == [
        "dive <7>.csv: MISMATCH: 1 effect left out and an unknown cause (p = 1e-09)",
        "",
        "1. the field of a motor current (motor_current_field), 97.0% sure",
        "   where      120.0-260.5 s; axes y z; turns with the vehicle; motor_current_a > 6",
        "   size       field_per_ampere_y = 0.0013 +- 4e-05 gauss/A",
        "   setting    by the column motor_<1>_a; logged 0.25 s late; each value the mean of 0.4 s",
        "   equation   m += k I(t)",
        "   cost       hard iron off by 1.40 mG, heading by 0.35 deg if it is left out",
        "   held out   +0.0520 nats/sample on readings not fitted (time-shifted copies: at most "
        "+0.0006)",
        "   or else    vibration_rectification 2.0%",
        "   to be sure pulse the motor at rest on one heading",
        "",
        "unknown, here (no effect of the library explains it):",
    ]


def test_residual_figure_has_one_curve_when_nothing_changed():
    found = diagnosis()
    drawn = found.drawn
    assert drawn is not None

    def labels(drawn):
        axes = diagnosis_page.residual(found, drawn).axes[0]
        return [line.get_label() for line in axes.get_lines()]

    assert labels(drawn) == ["before", "after"]
    alike = replace(drawn, after_gauss=drawn.before_gauss)
    assert labels(alike) == ["no finding"]


def page_of(found, folder):
    write_diagnosis_report(folder / "report.html", found, "ahrsd diagnose x")
    return (folder / "report.html").read_text()


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """The page of `diagnosis()`, made once: its figures take seconds."""
    folder = tmp_path_factory.mktemp("usual")
    page_of(diagnosis(), folder)
    return folder / "report.html"


@pytest.fixture
def without_figures(monkeypatch):
    """Figures are drawn but not encoded, which takes seconds per page."""
    monkeypatch.setattr("ahrsd.report.figures.as_data_uri", lambda draw: draw() and "data:,")


def test_page_reports_the_setting_of_an_effect(usual):
    text = usual.read_text()
    assert "by the column motor_&lt;1&gt;_a; logged 0.25 s late; each value the mean of" in text


@pytest.mark.usefixtures("without_figures")
def test_page_reports_a_spectrum_that_is_worse_after(tmp_path):
    found = diagnosis()
    drawn = found.drawn
    worse = replace(drawn, after=10.0 * drawn.before)
    better = replace(drawn, before=10.0 * drawn.after)
    assert diagnosis_page.spectrum_is_worse(worse)
    assert not diagnosis_page.spectrum_is_worse(better)
    assert not diagnosis_page.spectrum_is_worse(replace(drawn, after=drawn.before))
    title = diagnosis_page.spectrum(worse).axes[0].get_title(loc="left")
    assert title == "" or "Farther" in title
    assert "Here it is farther from 1 after than before" in page_of(
        replace(found, drawn=worse), tmp_path
    )
    assert "farther from 1" not in page_of(replace(found, drawn=better), tmp_path)


@pytest.mark.usefixtures("without_figures")
def test_a_longer_grey_bar_is_explained(usual, tmp_path):
    found = diagnosis()
    assert "A longer grey bar" not in usual.read_text()
    longer = replace(found.drawn, evidence={"motor_current_field": 80.0, "hysteresis": 300.0})
    assert "A longer grey bar is no contradiction" in page_of(
        replace(found, drawn=longer), tmp_path
    )


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize(("size", "real"), [(0.5e-3, False), (5e-3, True)])
def test_time_course_within_its_own_band_is_not_called_real(tmp_path, size, real):
    edges = tuple(np.linspace(0.0, 333.0, 11))
    course = np.zeros((10, 3))
    course[4] = size
    drawn_course = SimpleNamespace(
        frame="world", course=course, deviation=np.full(10, 1e-3), evidence=20.0,
        cut=SimpleNamespace(edges_s=edges),
    )  # fmt: skip
    found = diagnosis()
    found = replace(found, drawn=replace(found.drawn, courses=(drawn_course,)))
    text = page_of(found, tmp_path)
    assert ("It is real" in text) is real
    assert ("at no moment does it exceed its own" in text) is not real


def test_statistics_are_described_in_words(usual):
    text = usual.read_text()
    assert "autocorrelation of the innovations" in text
    assert "mean square of the innovations (1: as the noise level predicts)" in text
    assert ">autocorrelation<" not in text


def test_every_compared_statistic_has_a_description():
    source = inspect.getsource(predictive_checks.residual_statistics)
    compared = set(re.findall(r'"([a-z_]+)"[:\]]', source))
    assert compared == set(_STATISTICS)


@pytest.mark.parametrize("draw", ["residual", "spectrum", "contribution"])
def test_legends_do_not_cover_the_curves(draw):
    found = diagnosis()
    drawn = found.drawn
    figure = {
        "residual": lambda: diagnosis_page.residual(found, drawn),
        "spectrum": lambda: diagnosis_page.spectrum(drawn),
        "contribution": lambda: diagnosis_page.contribution(drawn.contributions[0]),
    }[draw]()
    assert [axes.get_legend() for axes in figure.axes] == [None] * len(figure.axes)
    (legend,) = figure.legends
    FigureCanvasAgg(figure).draw()
    box = legend.get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)


def test_labels_of_the_regime_map_do_not_overlap():
    row = diagnosis().regime_map[0]
    figure = diagnosis_page.regime_map((row,) * 10)
    FigureCanvasAgg(figure).draw()
    for axes in figure.axes[:2]:
        boxes = [label.get_window_extent() for label in axes.get_yticklabels()]
        assert len(boxes) == 10
        assert not any(one.overlaps(other) for one, other in pairwise(boxes))


def test_verdict_is_not_agreement_when_nothing_is_found_and_checks_fail():
    checks = {
        "line": Check(9.0, (1.0, 3.0), False, False),
        "tail": Check(1.0, (0.0, 3.0), True, True),
    }
    none = Unexplained(False)
    silent = diagnosis(mismatch=False, findings=(), unexplained=none, posterior_predictive=checks)
    assert answer_lines(silent)[0] == (
        "dive <7>.csv: no cause found, but recording and model differ in: line (see the checks)"
    )


def test_sensitivity_is_reported_when_nothing_is_found():
    limits = (
        Limit("mag_time_lag", "lag", 1.5e-3, "s"),
        Limit("gyro_scale", "scale_x", None, "1"),
        Limit("clock_rate", "rate_error", 0.0069, "1"),
        Limit("motor_current_field", "field_per_ampere_x", 3e-4, "gauss/A"),
        Limit("gyro_g_sensitivity", "g_xx", 1.7453e-3, "rad/s/g"),
    )
    none = Unexplained(False)
    said = answer_lines(
        diagnosis(mismatch=False, findings=(), unexplained=none, sensitivity=limits)
    )
    assert said[0] == "dive <7>.csv: recording and model agree"
    assert said[2] == (
        "this recording would have shown: mag_time_lag above 1.5 ms, clock_rate above 0.69 %, "
        "motor_current_field above 0.3 mG/A, gyro_g_sensitivity above 0.1 deg/s/g"
    )


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width_px", [360, 1000])
def test_page_is_complete_in_a_browser(tmp_path, usual, width_px):
    seen = look_at(usual, width_px, tmp_path)
    assert seen["errors"] == []
    assert len(seen["pictures"]) == 6
    assert all(complete and width > 0 for _, width, complete in seen["pictures"])
    assert seen["window"] == width_px
    assert seen["width"] <= width_px
    assert seen["cut"] == []  # no table that has to be scrolled sideways
    assert "Unknown, here" in seen["headings"]
    assert "<b>throttle" not in usual.read_text()


def test_rerun_recording_is_written(tmp_path):
    write_rrd(tmp_path / "d.rrd", diagnosis())
    assert (tmp_path / "d.rrd").stat().st_size > 10_000


NAMES = ("$x_{", "a$b$c", "two\nlines\x1b[31m", "\\frac{$", "n" * 1_000_000)


@pytest.mark.parametrize("name", NAMES, ids=lambda name: name[:6].encode().hex())
def test_any_column_name_is_shown_in_one_short_line(name):
    """No matplotlib formula, and no control character."""
    maps = (RegimeMap(name, (0.0, 6.0, 27.0), (0.5, 400.0), (1.0, 2.0)),)
    figure = diagnosis_page.regime_map(maps)
    figure.draw_without_rendering()
    tick = figure.axes[0].get_yticklabels()[0].get_text()
    assert tick.replace(r"\$", "$") == f"{label(name)}\n0 to 27"
    left = replace(diagnosis().unexplained, follows=(Suspect(name, 0.9, 0.01),))
    told = answer_lines(diagnosis(unexplained=left))
    assert "\x1b" not in "\n".join(told)
    assert max(map(len, told)) < 300


def test_long_column_name_does_not_enlarge_the_page(tmp_path):
    left = replace(diagnosis().unexplained, follows=(Suspect(NAMES[-1], 0.9, 0.01),))
    page = tmp_path / "report.html"
    write_diagnosis_report(page, diagnosis(unexplained=left, drawn=None), "ahrsd diagnose x")
    text = page.read_text(encoding="utf-8")
    assert len(text) < 20_000
    assert escape(label(NAMES[-1])) in text


def test_long_column_name_keeps_its_beginning_and_end():
    assert label("motor_current_a") == "motor_current_a"
    assert label("a\tb") == "a\\tb"
    long = label("begin" + "x" * 100 + "_a")
    assert len(long) == LABEL_CHARACTERS
    assert long.startswith("begin")
    assert long.endswith("..." + "x" * 8 + "_a")
