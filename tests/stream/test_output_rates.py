"""Rate of messages without a time: from the register of their output, then from arrivals."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.stream.assembler import Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs
from ahrsd.stream.streams_without_time import (
    RateWatch,
    offered_rate,
    rate_by_registers,
    rate_of_arrivals,
)
from drivers.vn100.decode import Measurement
from drivers.vn100.messages import binary_layout, sentence_layout

AUTOPILOT = binary_layout(0x14, (0x073E, 0x0004))
OTHER = binary_layout(0x01, (0x0538,))
VNYMR = sentence_layout("VNYMR")
HELD = {75: (3, 16, 0x14, 0x073E, 0x0004), 6: (0,), 7: (40,), 76: (0, 1, 0), 77: (0, 1, 0)}


@pytest.mark.parametrize(
    ("layout", "registers", "rate"),
    [
        (AUTOPILOT, HELD, (50.0, "register 75: 800 Hz / 16")),
        (OTHER, HELD, None),  # whose output is in no register: never register 7
        (OTHER, {7: (100,), 6: (14,)}, None),
        (OTHER, {**HELD, 77: (1, 40, 1, 0x0538), 7: (100,)}, (20.0, "register 77: 800 Hz / 40")),
        (AUTOPILOT, {**HELD, 76: (1, 40, 0x14, 0x073E, 0x0004)}, None),  # two rates of one layout
        (AUTOPILOT, {75: (0, 16, 0x14, 0x073E, 0x0004)}, None),  # polled only
        (AUTOPILOT, {75: (1, 0, 0x14, 0x073E, 0x0004)}, None),
        (AUTOPILOT, {75: (1, 16, 0x14, 0x073E)}, None),  # no layout at all
        (VNYMR, {6: (14,), 7: (40,)}, (40.0, "register 7")),
        (VNYMR, {7: (40,)}, (40.0, "register 7")),
        (VNYMR, {6: (19,), 7: (100,)}, None),  # of another message
        (VNYMR, {6: (14,), 7: (0,)}, None),
        (sentence_layout("VNYMR", count=True), {6: (14,), 7: (20,)}, (20.0, "register 7")),
    ],
)
def test_rate_is_taken_only_from_the_register_of_that_output(layout, registers, rate):
    assert rate_by_registers(layout, registers) == rate


@pytest.mark.parametrize("rate_hz", [5.0, 40.0, 50.0, 200.0])
def test_rate_of_bunched_arrivals_is_right(rate_hz):
    times = np.arange(round(12 * max(rate_hz, 10.0))) / rate_hz
    arrivals = (np.ceil(times / 0.016) * 0.016).tolist()  # as its latency timer lets them go
    assert rate_of_arrivals(AUTOPILOT, arrivals, [0] * len(arrivals)) == (rate_hz, "arrival times")


def test_rate_accounts_for_lost_messages_and_needs_enough_arrivals():
    times = np.arange(400) / 50.0
    kept = np.ones(400, bool)
    kept[10:400:7] = False
    lost = np.diff(np.flatnonzero(kept), prepend=-1) - 1
    assert rate_of_arrivals(AUTOPILOT, times[kept].tolist(), lost.tolist()) == (
        50.0,
        "arrival times",
    )
    assert rate_of_arrivals(AUTOPILOT, times[:90].tolist(), [0] * 90) is None
    assert rate_of_arrivals(AUTOPILOT, (times[:300] / 20).tolist(), [0] * 300) is None
    assert rate_of_arrivals(AUTOPILOT, [5.0] * 3000, [0] * 3000) is None


def test_rate_is_rounded_to_one_that_the_device_offers():
    assert offered_rate(AUTOPILOT, 53.1) == pytest.approx(800 / 15)
    assert offered_rate(VNYMR, 40.3) == 40.0
    assert offered_rate(VNYMR, 30.0) == 30.0


def watched(comes_hz: float, believed_hz: float, seconds: float = 30.0) -> float | None:
    watch = RateWatch()
    for k in range(round(seconds * comes_hz)):
        arrival = np.ceil(k / comes_hz / 0.016) * 0.016
        if (found := watch.look(arrival, 0, believed_hz)) is not None:
            return found
    return None


def test_rate_changes_after_repeated_contradiction_by_arrivals():
    assert watched(50.0, 50.0) is None
    assert watched(50.0, 53.3) is None
    assert watched(50.0, 40.0) == pytest.approx(50.0, rel=0.02)
    assert watched(20.0, 100.0, 60.0) == pytest.approx(20.0, rel=0.02)
    assert watched(50.0, 40.0, 5.0) is None


def test_constant_clock_gives_no_rate():
    watch = RateWatch()
    assert all(watch.look(100.0, 0, 50.0) is None for _ in range(5000))


# -- in a stream ----------------------------------------------------------------------------------


def known(registers: dict[int, tuple[float, ...]]) -> Stream:
    epochs = RegisterEpochs()
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    calibration = dict.fromkeys((23, 84), (*identity, 0.0, 0.0, 0.0))
    epochs.begin(0.0, Compensation.from_registers({**calibration, 26: identity}))
    stream = Stream(epochs)
    stream.registers = registers
    return stream


def fed(stream: Stream, layout, arrivals):
    blocks = []
    for host_s in arrivals:
        values = tuple(0.1 for _ in layout.columns)
        blocks += stream.take(Measurement(layout, values, 0), float(host_s))
    return blocks + stream.flush()


def test_a_binary_output_has_the_rate_of_its_own_register():
    stream = known({**HELD, 7: (100,)})
    blocks = fed(stream, AUTOPILOT, 100.0 + np.arange(500) / 50.0)
    dt_s = np.concatenate([block.dt_s for block in blocks])
    assert dt_s[1:] == pytest.approx(np.full(499, 0.02))
    assert stream.facts.rate_source == "register 75: 800 Hz / 16"


def test_a_binary_output_in_no_register_has_the_rate_of_its_arrivals():
    stream = known({6: (0,), 7: (100,)})
    blocks = fed(stream, OTHER, 100.0 + np.ceil(np.arange(500) / 20.0 / 0.016) * 0.016)
    assert sum(map(len, blocks)) == 500
    assert (stream.facts.rate_hz, stream.facts.rate_source) == (20.0, "arrival times")


def test_contradicted_rate_is_replaced_and_its_samples_are_dropped():
    stream = known({**HELD, 75: (1, 8, 0x14, 0x073E, 0x0004)})
    fed(stream, AUTOPILOT, 100.0 + np.arange(700) / 50.0)
    assert stream.facts.rate_hz == 50.0
    assert stream.facts.rate_source == "arrival times; register 75: 800 Hz / 8 said 100 Hz"
    assert stream.take_replaced()
    assert stream.restarts == 0
    blocks = fed(stream, AUTOPILOT, 114.0 + np.arange(100) / 50.0)
    dt_s = np.concatenate([block.dt_s for block in blocks])
    assert np.nanmax(dt_s) == pytest.approx(0.02)
    assert not stream.take_replaced()


@pytest.mark.parametrize(("pause_s", "gap_s"), [(3.0, 3.0), (3600.0, 0.04), (55 * 3.15e7, 0.04)])
def test_a_pause_in_the_arrivals_is_a_gap(pause_s, gap_s):
    """Of a device that fell silent, and of a host's clock that was set: nothing is bridged."""
    stream = known(HELD)
    arrivals = 100.0 + np.arange(400) / 50.0
    arrivals[200:] += pause_s - 0.02
    blocks = fed(stream, AUTOPILOT, arrivals)
    assert sum(map(len, blocks)) == 400
    (gap,) = stream.gaps
    assert gap.length_s == pytest.approx(gap_s, abs=0.03)
    assert [block.gap_before for block in blocks].count(True) == 2


def test_messages_of_other_models_are_counted_and_are_not_losses():
    stream = known({6: (14,), 7: (40,)})
    for k in range(100):
        host_s = 100.0 + k / 40.0
        stream.take(Measurement(VNYMR, tuple(0.1 for _ in VNYMR.columns), 0), host_s)
        stream.unused("VNINS")
        stream.unused("VNGPS")
    stream.flush()
    assert (stream.facts.samples, stream.facts.damaged, len(stream.gaps)) == (100, 0, 0)
    assert (stream.by_layout["VNINS"], stream.by_layout["VNGPS"]) == (100, 100)
    said = [text for text in stream.warnings if "not used" in text]
    assert said == ["in the stream, but no message of a VN-100 and not used: VNINS, VNGPS"]
