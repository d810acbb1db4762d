"""Summary for a person at the end: numbers with units, reasons, and no meaningless figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from streams import emitted, inputs

from ahrsd.cli.running.watch import gates_table
from ahrsd.config.config import Config, core_settings
from ahrsd.core.core import Core
from ahrsd.events import GateResult
from ahrsd.gates import GATES, Level, guards_a_write
from ahrsd.report.contents import ReportData
from ahrsd.report.page import write_report
from ahrsd.report.summary import (
    BatchResult,
    estimate_lines,
    gate_lines,
    summary_json,
    summary_lines,
    warnings_of,
)
from ahrsd.telemetry.driving import Pace
from ahrsd.viewer.process import gate_table
from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from drivers.vn100.emulator.scenarios import Setup, build


@pytest.fixture(scope="module")
def core() -> Core:
    """After 20 s of a tumbling sensor."""
    core = Core(core_settings(Config(), policy=WriteBackPolicy(mode=Mode.PASSIVE)))
    for item in inputs([emitted(build(Setup("tumble", seed=4, output="binary")), 20.0)]):
        core.handle(item)
    return core


@pytest.mark.parametrize(
    ("scale", "known", "words"),
    [
        (0.1, False, "the field has 0.049 gauss, and on Earth it has 0.22 to 0.67: the "
                     "magnetometer's unit is not gauss (0.49 if it is in mT: --columns"),
        (0.1, True, "the field has 0.049 gauss"),
        (2.04, False, "the field has 1 gauss"),
        (1.0, False, None),
        (1.3, True, None),
    ],
)  # fmt: skip
def test_a_field_that_is_not_of_the_earth_is_told(core, scale, known, words):
    """As the sensor measures it, also where the world model has scaled the soft iron."""
    found = core.calibrator.estimate
    size = 0.49 * scale
    soft_iron = np.eye(3) * (scale if known else 1.0)
    found = replace(
        found, converged=True, soft_iron=soft_iron, field_gauss=0.49 if known else size,
        field_known=known,
    )  # fmt: skip
    result = BatchResult("a.csv", core, found, (), ())
    told = [text for text in result.all_warnings() if text.startswith("the field has")]
    assert len(told) == (words is not None)
    assert all(text.startswith(words) for text in told)
    assert [text for text in result.json("magyc")["warnings"] if text in told] == told


def test_a_warning_is_said_once(core):
    twice = "the residual follows the attitude: 11 mG"
    found = replace(core.calibrator.estimate, warnings=(twice,))
    result = BatchResult("a.csv", core, found, (), (twice,))
    assert result.all_warnings().count(twice) == 1
    assert result.json("magyc")["warnings"].count(twice) == 1


def test_a_summary_of_a_stream(core):
    lines = summary_lines(core, "a.vnbin", ["something of the recording"])
    assert lines[0] == "a.vnbin: 800 samples in 20.0 s (40 Hz, device time)"
    assert lines[1] == "  messages: 800 valid, 0 rejected, 0 bytes skipped"
    assert lines[2].startswith("  hard iron  ")
    assert lines[2].endswith(" mG")
    assert lines[3].endswith(" mrad/s")
    assert "deg (1 sigma, worst direction)" in lines[4]
    assert "  warning: something of the recording" in lines
    assert (
        lines[-1] == f"  state {core.writeback.state.value}; decisions {core.decisions.sha256[:16]}"
    )
    own = [line for line in lines if not line.startswith("    ")]  # the gates' advice is theirs
    assert not [line for line in own if "nan" in line]


def test_summary_of_an_empty_stream():
    core = Core(core_settings(Config()))
    assert summary_lines(core, "port")[0] == "port: 0 samples in 0.0 s (unknown rate)"
    summary = summary_json(core, "port")
    assert (summary["samples"], summary["duration_s"], summary["rate_hz"]) == (0, 0.0, None)
    assert "  no estimate: too few samples" in summary_lines(core, "port")


def test_only_unknown_registers_are_reported(core):
    assert any("registers are not known" in text for text in warnings_of(core))
    assert warnings_of(core, ["a", "a"]).count("a") == 1


def test_zero_has_no_minus_sign(core):
    estimate = core.calibrator.estimate
    assert estimate is not None
    tiny = replace(
        estimate,
        hard_iron_gauss=np.array([-1e-9, 0.00123, -0.4]),
        gyro_bias_rad_s=np.array([-1e-9, 0.002, -0.003]),
    )
    first, second, *_ = estimate_lines(tiny)
    assert [part.split(" +- ")[0] for part in first.split("iron")[1].split(",")] == [
        "  +0.00", " +1.23", " -400.00",
    ]  # fmt: skip
    assert [part.split(" +- ")[0] for part in second.split("bias")[1].split(",")] == [
        "  +0.000", " +2.000", " -3.000",
    ]  # fmt: skip


def test_undetermined_parameters_have_no_number(core):
    estimate = core.calibrator.estimate
    assert estimate is not None
    observed = replace(estimate.observability, unobservable=("hard iron z", "soft iron zz"))
    lines = estimate_lines(replace(estimate, observability=observed, converged=False))
    assert lines[0].endswith(", not determined mG")
    assert "not determined" not in lines[1]
    assert lines[-1] == "  this motion does not determine: hard iron z; soft iron zz"


def test_gates_with_one_advice_are_one_line():
    gates = [
        GateResult("a.rms", float("nan"), 1.0, False, 0.0, "deg", "keep turning"),
        GateResult("a.max", float("nan"), 3.0, False, 0.0, "deg", "keep turning"),
        GateResult("b.size", 0.1, 1.0, True, 0.0, "", "not said"),
        GateResult("c.rate", 5.0, 1.0, False, 0.0, "Hz", "slow down"),
    ]
    assert gate_lines(gates, Level.RAM) == [
        "  3 of 4 gates hold a write back:",
        "    a.rms, a.max: keep turning",
        "    c.rate: slow down",
    ]
    assert gate_lines([gates[2]], Level.RAM) == []
    assert gate_lines(gates[2:], Level.RAM)[0] == "  1 of 2 gates holds a write back:"


def test_gates_of_a_write_without_a_person_are_counted_apart_and_only_where_that_is_allowed():
    gates = [
        GateResult("field.weakest", 0.5, 1.0, False, 0.0, "", "go outside"),
        GateResult("step.auto", 5.0, 1.0, False, 0.0, "deg", "let a person approve it"),
    ]
    alone = gate_lines(gates, Level.RAM)
    assert alone == ["  1 of 1 gates holds a write back:", "    field.weakest: go outside"]
    assert gate_lines(gates, Level.UNATTENDED) == [
        *alone,
        "  1 of 1 gates holds a write without approval back:",
        "    step.auto: let a person approve it",
    ]


def test_the_number_of_gates_is_one_number_everywhere(tmp_path):
    """Summary, page, live view of the terminal and the viewer's table count the same gates."""
    results = [
        GateResult(gate.gate, 2.0, 1.0, k % 3 > 0, 0.0, "", "do something")
        for k, gate in enumerate(GATES)
    ]
    counted = [r for r in results if guards_a_write(r.gate)]
    shut = sum(not r.ok for r in counted)
    assert 40 < len(counted) < len(GATES)
    assert (
        gate_lines(results, Level.RAM)[0] == f"  {shut} of {len(counted)} gates hold a write back:"
    )
    assert gate_table(results).startswith(f"**Held back by {shut} of {len(counted)} gates**")
    write_report(tmp_path / "report.html", ReportData(title="t", gates=tuple(results)))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"{len(counted) - shut} of {len(counted)} gates are ok" in page
    console = Console(width=200, record=True)
    rows = [{"gate": r.gate, "ok": r.ok, "value": 2.0, "unit": "", "limit": 1.0} for r in results]
    with console.capture() as captured:
        console.print(gates_table({"gates": rows, "write_back": {"holds": []}}, Pace()))
    assert f"{len(counted) - shut} of {len(counted)} gates are green" in captured.get()
