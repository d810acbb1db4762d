"""Corrected and NMEA shares of a core on a simulated cable, compared with the true attitude."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from cabled_run import CabledRun, two_units
from cabled_units import FIELD_N

from ahrsd import inputs
from ahrsd.config.sections import ShareSection
from ahrsd.telemetry.public import Public
from ahrsd.telemetry.status import LinkFacts
from ahrsd.writeback.states import Mode

LINK = LinkFacts("cable", 115200, is_open=True)


@dataclass
class Outlet:
    """Written data, and whether there is a reader."""

    share: ShareSection
    wanted: bool = True
    lines: list[bytes] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    newest: bytes = b""
    now_s: Callable[[], float] = lambda: 0.0
    at_s: list[float] = field(default_factory=list)

    def write(self, messages, seq, newest):
        self.lines += messages
        self.at_s += [self.now_s()] * len(messages)
        self.numbers += [seq + k if seq else 0 for k in range(len(messages))]
        self.newest = newest or self.newest

    def records(self, kind="sample"):
        return [r for r in map(json.loads, self.lines) if r["record"] == kind]


class Told:
    """A run with one share, and the truth by device time."""

    def __init__(self, send, binary=True, mode=Mode.OBSERVE, **terms):
        cable = two_units(binary=binary)
        self.true = {}
        unit = cable.units[cable.unit.serial]
        measure = unit.measure

        def measured(R_nb, rate, iron, noise):
            self.true[round(unit.uptime_s, 6)] = R_nb, rate
            return measure(R_nb, rate, iron, noise)

        unit.measure = measured
        self.run = CabledRun(cable, mode=mode)
        self.outlet = Outlet(ShareSection(tcp="127.0.0.1:1", send=send, **terms))
        self.outlet.now_s = lambda: max(self.true)
        self.public = Public(self.run.now_s)
        self.public.feed([self.outlet])
        self.run.listeners.append(self.public.event)

    def until(self, state, longest_s=60.0):
        end_s = self.run.now_s + longest_s
        while self.run.state != state:
            assert self.run.now_s < end_s
            self.go(0.05)

    def go(self, seconds, link=LINK):
        run = self.run
        end_s = run.now_s + seconds
        while run.now_s < end_s:
            before_s = int(run.now_s)
            if link.is_open:
                run.step()
            else:
                run.now_s += run.cable.step_s
            self.public.turn(run.core, run.now_s)
            if int(run.now_s) != before_s:
                self.public.look(run.core, link, run.now_s)


def true_heading_deg(R_nb):
    """Heading of the x axis from north to east, by the level part of the axis."""
    return math.degrees(math.atan2(R_nb[1, 0], R_nb[0, 0])) % 360.0


def proposal_distance_deg(one, other):
    return abs((one - other + 180.0) % 360.0 - 180.0)


def test_corrected_share_has_true_values_after_a_candidate_qualified():
    told = Told("corrected", calibrated_by="qualified")
    told.until("QUALIFIED")
    told.outlet.lines.clear()
    told.go(20.0)
    samples = told.outlet.records()
    assert len(samples) >= 300
    for sample in samples[-200:]:
        R_nb, rate = told.true[round(sample["time_s"], 6)]
        assert sample["calibration"] == "qualified"
        assert np.allclose(sample["mag_body_gauss"], R_nb.T @ FIELD_N, atol=6e-3)  # 6 sigma
        assert np.allclose(sample["gyro_body_rad_s"], rate, atol=6e-3)
        if sample["magnetic_heading_deg"] is not None:
            assert (
                proposal_distance_deg(sample["magnetic_heading_deg"], true_heading_deg(R_nb)) < 2.0
            )
        assert sample["heading_sigma_deg"] == pytest.approx(0.05, abs=0.01)
    assert sum(s["magnetic_heading_deg"] is not None for s in samples[-200:]) > 150
    (state,) = told.outlet.records("state")[-1:]
    proposal = told.run.core.writeback.proposal
    assert (state["schema"], state["calibration"]) == ("ahrsd.corrected/1", "qualified")
    assert (state["candidate"], state["write_back"]) == (proposal.id, "QUALIFIED")
    assert (state["device"]["serial"], state["alarms"]) == (100130608, [])
    assert state["sigma_hard_iron_gauss"] == pytest.approx([1e-4] * 3)


def test_share_uses_the_registers_until_an_approval_by_default():
    told = Told("corrected")
    told.until("QUALIFIED")
    told.go(5.0)
    assert {sample["calibration"] for sample in told.outlet.records()} == {"registers"}
    assert told.outlet.records()[-1]["magnetic_heading_deg"] is None  # it is wrong by degrees


def test_values_are_continuous_when_the_candidate_is_written():
    told = Told("corrected", mode=Mode.COMMIT, calibrated_by="qualified")
    told.until("QUALIFIED")
    told.go(1.0)
    told.outlet.lines.clear()
    told.run.approve()
    told.until("TRIAL")
    told.go(10.0)
    samples = told.outlet.records()
    by = [sample["calibration"] for sample in samples]
    assert by == sorted(by)  # first qualified, then registers, once
    assert set(by) == {"qualified", "registers"}
    for sample in samples:
        R_nb, rate = told.true[round(sample["time_s"], 6)]
        assert np.allclose(sample["mag_body_gauss"], R_nb.T @ FIELD_N, atol=6e-3)
        assert np.allclose(sample["gyro_body_rad_s"], rate, atol=6e-3)
    assert told.outlet.records("state")[-1]["candidate"] is None


def test_share_has_device_values_and_no_heading_before_an_estimate():
    told = Told("corrected", calibrated_by="registers", max_heading_sigma_deg=1.0)
    told.until("QUALIFIED")
    told.go(10.0)
    for sample in told.outlet.records():
        R_nb, _ = told.true[round(sample["time_s"], 6)]
        assert (sample["calibration"], sample["magnetic_heading_deg"]) == ("registers", None)
        iron = np.array([0.05, -0.03, 0.04])
        assert np.allclose(sample["mag_body_gauss"], R_nb.T @ FIELD_N + iron, atol=6e-3)
    assert told.outlet.records()[-1]["heading_sigma_deg"] > 10.0  # with a reason


def test_records_are_numbered_without_gaps_and_each_sample_comes_once():
    told = Told("corrected", calibrated_by="qualified")
    told.go(20.0)
    assert [json.loads(line)["seq"] for line in told.outlet.lines] == told.outlet.numbers
    assert told.outlet.numbers == list(range(1, len(told.outlet.numbers) + 1))
    times = [sample["time_s"] for sample in told.outlet.records()]
    assert times == sorted(set(times))
    assert len(times) >= 19 * 20  # no sample waits until its block is full
    assert json.loads(told.outlet.newest)["record"] == "state"


def test_fields_are_those_of_the_documentation():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "socket.md").read_text()
    part = page[page.index("## Corrected samples") : page.index("## Prometheus")]
    told = Told("corrected", calibrated_by="qualified")
    told.go(3.0)
    for kind in ("sample", "state"):
        fields = set(told.outlet.records(kind)[-1]) - {"record", "seq"}
        table = part[part.index(f"| `{kind}`") :].split("\n\n")[0].splitlines()[2:]
        named = [name for row in table for name in re.findall(r"`(\w+)`", row.split(" | ")[0])]
        assert sorted(fields) == sorted(named)


def test_missing_device_is_reported_within_two_seconds():
    told = Told("corrected", calibrated_by="qualified")
    told.until("QUALIFIED")
    told.run.feed(inputs.LinkLost(told.run.now_ns, "unplugged"))
    told.outlet.lines.clear()
    told.go(2.0, replace(LINK, is_open=False))
    state = told.outlet.records("state")[0]
    assert state["device_present"] is False
    assert state["alarms"] == ["no device on cable: waiting for it"]
    assert told.outlet.records() == []


def test_share_without_readers_computes_nothing():
    told = Told("corrected", calibrated_by="qualified")
    told.outlet.wanted = False
    told.go(5.0)
    assert told.outlet.records() == []


def test_nmea_share_sends_heading_at_ten_hertz_and_empty_fields_without_a_device():
    told = Told("nmea", calibrated_by="qualified")
    told.go(3.0)
    assert set(told.outlet.lines[::2]) == {b"$HCHDM,,M*07\r\n"}
    told.until("QUALIFIED")
    told.go(10.0)
    told.outlet.lines.clear()
    told.outlet.at_s.clear()
    told.go(10.0)
    assert 190 <= len(told.outlet.lines) <= 210
    known = 0
    pairs = zip(told.outlet.lines[::2], told.outlet.lines[1::2], told.outlet.at_s[::2], strict=True)
    for head, transducers, at_s in pairs:
        R, _ = told.true[at_s]  # told as it comes
        value = head.decode().split(",")[1]
        if value:
            known += 1
            assert proposal_distance_deg(float(value), true_heading_deg(R)) < 2.0
        pitch, roll = (float(transducers.decode().split(",")[k]) for k in (2, 6))
        assert abs(pitch - math.degrees(math.asin(-R[2, 0]))) < 1.0
        level = math.cos(math.radians(pitch))
        assert proposal_distance_deg(roll, math.degrees(math.atan2(R[2, 1], R[2, 2]))) * level < 1.0
    assert known > 70
    told.run.feed(inputs.LinkLost(told.run.now_ns, "unplugged"))
    told.go(1.5, replace(LINK, is_open=False))
    told.outlet.lines.clear()
    told.go(3.0, replace(LINK, is_open=False))
    assert set(told.outlet.lines) == {b"$HCHDM,,M*07\r\n"}
    assert len(told.outlet.lines) == 3


def test_candidate_is_applied_in_passive_mode():
    told = Told("corrected", binary=False, mode=Mode.PASSIVE, calibrated_by="qualified")
    told.until("QUALIFIED")
    told.outlet.lines.clear()
    told.go(10.0)
    samples = told.outlet.records()
    assert len(samples) > 150
    assert {sample["calibration"] for sample in samples} == {"qualified"}
    strength = [math.hypot(*sample["mag_body_gauss"]) for sample in samples]
    assert np.allclose(strength, math.hypot(*FIELD_N), atol=6e-3)
    assert told.outlet.records("state")[-1]["device"] is None
