"""The report: what is on the page, that nothing is loaded from elsewhere, that texts are texts."""

from __future__ import annotations

import base64
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.events import (
    Estimated,
    GateResult,
    Judged,
    Noted,
    RegisterWritten,
    SamplesSeen,
    StateChanged,
)
from ahrsd.report import (
    EstimateHistory,
    EventCollector,
    FieldClouds,
    FieldNorm,
    HeadingError,
    KeyFigure,
    RegisterChange,
    ReportData,
    before_after_figure,
    figures,
    write_report,
)
from ahrsd.report.contents import KEPT
from ahrsd.report.figures import binned, clouds, settled_range
from ahrsd.report.template import number
from ahrsd.samples import SampleBlock

SOFT = np.array([[1.1, 0.05, 0.0], [0.05, 0.95, -0.02], [0.0, -0.02, 0.97]])
HARD = np.array([0.2, -0.1, 0.05])
BIAS = np.array([0.004, -0.006, 0.003])
FIELD = 0.5


class Page(HTMLParser):
    """Tags, attributes and text of a page; fails on a tag that is not closed where it should."""

    VOID = frozenset({"meta", "img"})

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data + "\n"

    def pictures(self) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == "img"]

    def headings(self) -> list[str]:
        return re.findall(r"<h2>(.*?)</h2>", self.source)


def page(data: ReportData, folder: Path) -> Page:
    write_report(folder / "report.html", data)
    return Page(folder / "report.html")


def heading_error(count: int = 720) -> HeadingError:
    turn = np.linspace(0.0, 720.0, count)
    return HeadingError(
        turn, 20.0 * np.sin(np.radians(turn)), np.full(count, -0.25), "two turns after it", 0.5
    )


def estimate(sigma: float, warnings: tuple[str, ...] = ()) -> Estimate:
    return Estimate(
        SOFT,
        HARD,
        BIAS,
        FIELD,
        False,
        np.eye(12) * sigma**2,
        0.001,
        0.002,
        1.0,
        0.4,
        Observability(np.ones(12), (), 2.0),
        100,
        10.0,
        True,
        warnings,
    )


def directions(count: int) -> np.ndarray:
    vectors = np.random.default_rng(3).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def seen(count: int, proposed: Affine | None) -> SamplesSeen:
    time_s = 10.0 + np.arange(count) / 100.0
    raw = FIELD * directions(count) @ SOFT.T + HARD
    zeros = np.zeros((count, 3))
    dt_s = np.full(count, 0.01)
    block = SampleBlock(time_s, dt_s, time_s + 100.0, raw, zeros, zeros)
    return SamplesSeen(block, Affine.identity(), proposed)


def collected() -> EventCollector:
    collector = EventCollector()
    identity = Affine.identity().to_register()
    correction = estimate(0.01).correction
    for event in (
        seen(200, None),
        Estimated(12.0, 112.0, estimate(0.1, ("first warning",))),
        Judged(12.0, 112.0, (GateResult("motion", 120.0, 280.0, False, 0.0, "deg", "turn on"),)),
        StateChanged(12.5, 112.5, "OBSERVING", "CANDIDATE", "an <estimate>"),
        Estimated(13.0, 113.0, estimate(0.01, ("scale is a gauge",))),
        seen(200, correction),
        Noted(13.5, 113.5, "warning", "gap of 0.3 s"),
        Noted(13.6, 113.6, "warning", "gap of 0.3 s"),
        Noted(13.7, 113.7, "info", "not a warning"),
        Judged(14.0, 114.0, (GateResult("motion", 300.0, 280.0, True, 0.0, "deg", "turn on"),)),
        RegisterWritten(14.5, 114.5, 23, identity, correction.to_register(), "verified"),
        RegisterWritten(15.0, 115.0, 23, correction.to_register(), identity, "undone"),
    ):
        collector.add(event)
    return collector


def test_a_full_report_has_every_section_in_reading_order(tmp_path):
    data = collected().report(
        "demo",
        truth={"hard_iron_gauss": HARD, "soft_iron": SOFT, "gyro_bias_rad_s": BIAS},
        verdict="It worked.",
        good=True,
        heading=heading_error(),
        seed=7,
        command="ahrsd demo --seed 7",
    )
    shown = page(data, tmp_path)
    assert shown.headings() == [
        "Heading error before and after, on data that the estimate has not seen",
        "Warnings",
        "Field strength",
        "Raw and corrected field",
        "How the estimate settled",
        "Gates: may it be written?",
        "What happened",
        "Registers",
        "How this report was made",
    ]
    assert "It worked." in shown.text
    assert "ahrsd demo --seed 7" in shown.text
    assert "Seed 7" in shown.text


def test_a_report_of_nothing_is_a_title(tmp_path):
    shown = page(ReportData("only a title"), tmp_path)
    assert shown.headings() == []
    assert shown.pictures() == []
    assert shown.text.split() == ["only", "a", "title"] * 2


def test_the_worst_error_before_and_after_is_in_words(tmp_path):
    shown = page(ReportData("x", heading=heading_error(721)), tmp_path)
    (picture,) = shown.pictures()
    assert picture["alt"] == (
        "Heading error over all headings: worst 20 deg before and 0.25 deg after, "
        "rms 14.1 and 0.25 deg"
    )
    assert re.search(r'Worst heading error</td><td class="n">20 deg</td>', shown.source)
    assert '<span class="good">0.25 deg</span>' in shown.source
    assert "two turns after it" in shown.text


def test_a_missed_limit_is_marked(tmp_path):
    summary = (KeyFigure("Gyro bias", "mrad/s", 7.8, 0.4, 0.3), KeyFigure("Rate", "Hz", None, 40.0))
    shown = page(ReportData("x", verdict="No.", good=False, summary=summary), tmp_path)
    assert '<span class="bad">0.4 mrad/s</span>' in shown.source
    assert '<td class="n">–</td><td class="n">40 Hz</td><td class="n">–</td>' in shown.source
    assert '<p class="verdict no">No.</p>' in shown.source


def test_pictures_say_their_numbers(tmp_path):
    truth = {"gyro_bias_rad_s": BIAS}
    shown = page(collected().report("x", truth=truth), tmp_path)
    norm, cloud, hard, soft, bias = (picture["alt"] for picture in shown.pictures())
    assert re.fullmatch(
        r"Field strength over time: it varies by \d+(\.\d+)? % before and by "
        r"(0|\d\.\d+e-\d+) % with the estimate",
        norm,
    )
    assert "around (0.2, -0.1, 0.05) gauss, corrected points on a sphere of 0.5 gauss" in cloud
    assert hard == "Hard iron: x 0.2 ± 0.01, y -0.1 ± 0.01, z 0.05 ± 0.01 gauss"
    assert soft.startswith("Soft iron minus identity: xx 0.1 ± 0.01, xy 0.05 ± 0.01,")
    assert bias == "Gyro bias: x 4 ± 10, y -6 ± 10, z 3 ± 10 mrad/s; truth 4, -6, 3"


def test_pictures_are_inside_and_the_page_loads_nothing(tmp_path):
    data = collected().report("x", heading=heading_error())
    shown = page(data, tmp_path)
    assert len(shown.pictures()) == 6
    for picture in shown.pictures():
        kind, _, body = (picture["src"] or "").partition(",")
        assert kind == "data:image/svg+xml;base64"
        svg = ElementTree.fromstring(base64.b64decode(body))
        assert svg.tag == "{http://www.w3.org/2000/svg}svg"
        for element in svg.iter():
            link = element.get("{http://www.w3.org/1999/xlink}href", "#")
            assert link.startswith(("#", "data:image/png;base64,"))
    rest = re.sub(r'src="data:[^"]*"', "", shown.source)
    assert "//" not in rest
    assert "url(" not in rest
    assert {tag for tag, _ in shown.tags}.isdisjoint({"script", "link", "iframe", "object"})


def test_the_same_data_give_the_same_page(tmp_path):
    first = page(collected().report("x", heading=heading_error()), tmp_path).source
    again = page(collected().report("x", heading=heading_error()), tmp_path).source
    assert first == again


def test_texts_are_escaped(tmp_path):
    evil = '<script>alert("1")</script>'
    gates = (GateResult(evil, 1.0, 2.0, False, 0.0, evil, evil),)
    change = RegisterChange(23, Affine.identity().to_register(), (0.5,) * 12, evil)
    data = ReportData(
        evil,
        verdict=evil,
        summary=(KeyFigure(evil, evil, 1.0, 1.0),),
        heading=HeadingError(np.zeros(1), np.ones(1), np.ones(1), evil),
        gates=gates,
        states=(StateChanged(0.0, 0.0, evil, evil, evil),),
        registers=(change,),
        warnings=(evil,),
        command=evil,
    )
    shown = page(data, tmp_path)
    assert "script" not in {tag for tag, _ in shown.tags}
    assert shown.text.count(evil) == 17


def test_closed_gates_come_first_with_their_advice(tmp_path):
    gates = (
        GateResult("bounds", 1.2, 2.0, True, 0.0, "", "never shown"),
        GateResult("motion", 120.0, 280.0, False, 0.0, "deg", "drive a full turn"),
    )
    shown = page(ReportData("x", gates=gates), tmp_path)
    assert shown.text.index("motion") < shown.text.index("bounds")
    assert "1 of 2 gates are ok" in shown.text
    assert "drive a full turn" in shown.text
    assert "never shown" not in shown.text
    assert "280 deg" in shown.text


def test_registers_are_shown_with_the_lines_that_write_them(tmp_path):
    after = Affine(np.diag([0.9, 1.1, 1.0]), np.array([0.21, -0.13, 0.05]))
    change = RegisterChange(23, Affine.identity().to_register(), after.to_register(), "verified")
    shown = page(ReportData("x", registers=(change,)), tmp_path)
    assert "Register 23" in shown.text
    assert "1.100000" in shown.text
    lines = re.findall(r"\$VNWRG,23,[-0-9.,]+\*[0-9A-F]{2}", shown.text)
    assert len(lines) == 2
    assert lines[1].startswith("$VNWRG,23,1,0,0,0,1,0,0,0,1,0,0,0*")
    numbers = [float(token) for token in lines[0].split("*")[0].split(",")[2:]]
    assert np.allclose(numbers, after.to_register(), atol=1e-7)


def test_figure_has_the_requested_size_and_both_colours(tmp_path):
    before_after_figure(tmp_path / "picture.png", heading_error(), 900, 600)
    with Image.open(tmp_path / "picture.png") as image:
        assert image.size == (900, 600)
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    for colour in ((0xE6, 0x7D, 0x28), (0x2F, 0x86, 0xE8)):
        near = np.abs(pixels - colour).sum(axis=1) < 10
        assert 500 < near.sum() < 50_000


def test_an_unwritable_folder_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_report(tmp_path / "absent" / "report.html", ReportData("x"))
    with pytest.raises(FileNotFoundError):
        before_after_figure(tmp_path / "absent" / "picture.png", heading_error())


def test_matplotlib_is_loaded_only_to_draw():
    code = "import sys, ahrsd.report; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "False\n"


def test_collector_keeps_the_events():
    data = collected().report("x")
    assert [state.new for state in data.states] == ["CANDIDATE"]
    assert data.gates[0].ok
    assert data.warnings == ("gap of 0.3 s", "scale is a gauge")
    assert [change.outcome for change in data.registers] == ["verified", "undone"]
    assert data.norm is not None
    assert np.isnan(data.norm.after_gauss[:200]).all()
    assert np.allclose(data.norm.after_gauss[200:], FIELD)
    hard = data.history[0]
    assert hard.time_s.tolist() == [12.0, 13.0]
    assert np.allclose(hard.value, HARD)
    assert np.allclose(hard.sigma, [[0.1] * 3, [0.01] * 3])


def test_collector_stays_bounded_over_a_long_run():
    collector = EventCollector()
    for _ in range(3):
        collector.add(seen(2 * KEPT, None))
    for k in range(300):
        collector.add(Noted(0.0, 0.0, "warning", f"warning {k}"))
    data = collector.report("x")
    assert data.norm is not None
    assert KEPT / 2 <= len(data.norm.time_s) < KEPT
    assert np.allclose(np.diff(data.norm.time_s[:100]), data.norm.time_s[1] - data.norm.time_s[0])
    assert len(data.warnings) == 200


def test_medians_by_heading_have_gaps_at_unvisited_headings():
    middle, error = binned(np.array([1.0, 2.0, 3.0, 359.0]), np.array([1.0, 9.0, 2.0, 4.0]))
    assert middle[[0, -1]].tolist() == [5.0, 355.0]
    assert error[[0, -1]].tolist() == [2.0, 4.0]
    assert np.isnan(error[1:-1]).all()


def test_the_outline_touches_the_cloud_from_outside():
    raw = FIELD * directions(20_000) @ SOFT.T + HARD
    figure = clouds(FieldClouds(raw, SOFT, HARD, FIELD))
    for axes, (i, j) in zip(figure.axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        outline = np.array(axes.lines[1].get_data())
        assert outline.max(axis=1) == pytest.approx(raw[:, [i, j]].max(axis=0), abs=2e-3)
        assert outline.min(axis=1) == pytest.approx(raw[:, [i, j]].min(axis=0), abs=2e-3)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (0.0, "0 deg"),
        (0.12345, "0.123 deg"),
        (123456.0, "1.23e+05 deg"),
        (-23.44, "-23.4 deg"),
        (1e-5, "1.00e-05 deg"),
        (40.0, "40 deg"),
    ],
)
def test_numbers_as_people_write_them(value, text):
    assert number(value, "deg") == text


def test_time_continues_after_a_device_restart():
    """Nothing jumps back at a power cut: samples, estimates and states go on behind it."""
    collector = EventCollector()
    collector.add(seen(200, None))
    collector.add(Estimated(11.9, 0.0, estimate(0.01)))
    collector.add(StateChanged(11.95, 0.0, "SAVING", "COMMITTED", "saved"))
    first = seen(200, None)
    again = replace(first, block=replace(first.block, time_s=0.5 + np.arange(200) / 100.0))
    collector.add(again)
    collector.add(Estimated(2.4, 0.0, estimate(0.01)))
    collector.add(StateChanged(2.45, 0.0, "COMMITTED", "CONFIRMED", "read"))
    data = collector.report("t")
    assert np.all(np.diff(data.norm.time_s) > 0.0)
    assert data.history[0].time_s.tolist() == pytest.approx([11.9, 14.89])
    assert [state.at_s for state in data.states] == pytest.approx([11.95, 14.94])


def test_settling_is_scaled_by_the_end_not_by_the_first_guess():
    count = 40
    value = np.full((count, 3), 0.1)
    value[:8] += 3.0
    sigma = np.full((count, 3), 1e-3)
    sigma[:15] = 2.0
    low, high = settled_range(
        EstimateHistory("Hard iron", "gauss", ("x", "y", "z"), np.arange(40.0), value, sigma)
    )
    assert 0.1 - 5e-3 < low < 0.1 - 3e-3
    assert 0.1 + 3e-3 < high < 0.1 + 5e-3


@pytest.mark.parametrize("draw", [
    lambda: figures.norm(FieldNorm(np.arange(9.0), np.full(9, 0.1), np.full(9, 0.5))),
    lambda: figures.heading(heading_error(), "title"),
])  # fmt: skip
def test_no_legend_lies_on_a_curve(draw):
    figure = draw()
    assert [axes.get_legend() for axes in figure.axes] == [None] * len(figure.axes)
    (legend,) = figure.legends
    FigureCanvasAgg(figure).draw()
    box = legend.get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
