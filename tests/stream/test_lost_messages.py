"""Messages that are missing without a trace in the bytes, by the arrivals of the others."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.stream.assembler import Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs
from ahrsd.stream.lost_messages import LostMessages
from ahrsd.stream.streams_without_time import UNSURE, RateWatch, rate_of_arrivals
from drivers.vn100.decode import Measurement
from drivers.vn100.messages import MESSAGES, binary_layout

VNIMU = MESSAGES["VNIMU"]
BINARY = binary_layout(0x01, (0x0538,))
LATE = {
    "exact": lambda t, step, rng: t,
    "a fifth of a step": lambda t, step, rng: t + rng.uniform(0.0, 0.2 * step, len(t)),
    "a step": lambda t, step, rng: np.maximum.accumulate(t + rng.uniform(0.0, step, len(t))),
    "bunches of 16 ms": lambda t, step, rng: np.ceil(t / 0.016) * 0.016,
}


def arrivals(rate_hz: float, share: float, late: str, sent: int = 1500, seed: int = 1):
    """Arrivals (N,) of those of `sent` messages that were not lost, and their numbers."""
    rng = np.random.default_rng(seed)
    step = 1.0 / rate_hz
    arrived = 1.7e9 + LATE[late](np.arange(sent) * step + 0.003, step, rng)
    kept = rng.random(sent) >= share
    kept[0] = True
    return arrived[kept], np.flatnonzero(kept)


@pytest.mark.parametrize("rate_hz", [10.0, 40.0, 100.0, 200.0, 400.0])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.1, 0.2])
@pytest.mark.parametrize("late", ["exact", "a fifth of a step"])
def test_each_missing_message_is_found_where_it_is_missing(rate_hz, share, late):
    at, numbers = arrivals(rate_hz, share, late)
    seen = LostMessages().look(at, [0] * len(at), 1.0 / rate_hz, ends=True)
    found = seen.lost[1:][seen.used[1:]]
    missing = np.diff(numbers[seen.used]) - 1 - np.diff(np.flatnonzero(seen.used)) + 1
    assert np.mean(seen.used) > 0.999
    assert found.tolist() == missing.tolist()


@pytest.mark.parametrize("rate_hz", [10.0, 40.0, 100.0, 200.0, 400.0])
@pytest.mark.parametrize("late", ["a step", "bunches of 16 ms"])
def test_few_lost_messages_are_bridged_where_arrivals_are_irregular(rate_hz, late):
    at, numbers = arrivals(rate_hz, 0.03, late)
    seen = LostMessages().look(at, [0] * len(at), 1.0 / rate_hz, ends=True)
    step = (seen.lost[1:] == 0) & seen.used[1:] & seen.used[:-1]
    lost = np.diff(numbers) > 1
    assert np.mean(step[lost]) < 0.16  # inside bunches some cannot be told
    assert seen.lost.sum() == pytest.approx(numbers[-1] + 1 - len(numbers), abs=0.005 * 1500)


@pytest.mark.parametrize("rate_hz", [10.0, 40.0, 100.0, 200.0, 400.0])
@pytest.mark.parametrize("late", LATE)
def test_nothing_is_missing_where_nothing_was_lost(rate_hz, late):
    at, _ = arrivals(rate_hz, 0.0, late)
    lines = LostMessages()
    seen = lines.look(at, [0] * len(at), 1.0 / rate_hz, ends=True)
    assert np.mean(seen.lost) < 0.003
    assert np.mean(seen.used) > 0.99


def test_a_host_that_stood_and_delivered_all_later_lost_nothing():
    at = 100.0 + np.arange(800) / 40.0
    at[400:440] = at[440]
    assert not LostMessages().look(at, [0] * 800, 0.025, ends=True).lost.any()


@pytest.mark.parametrize("late", LATE)
def test_the_same_is_found_however_the_messages_are_cut(late):
    at, _ = arrivals(100.0, 0.05, late, 600)
    whole = LostMessages().look(at, [0] * len(at), 0.01, ends=True)
    lines, waiting, lost = LostMessages(), [], []
    for k, one in enumerate(at.tolist()):
        waiting.append(one)
        if len(waiting) > 20 or k == len(at) - 1:
            seen = lines.look(waiting, [0] * len(waiting), 0.01, ends=k == len(at) - 1)
            lost += seen.lost.tolist()
            waiting = waiting[seen.settled :]
    assert sum(lost) == pytest.approx(whole.lost.sum(), abs=2)
    assert lines.missing == sum(lost)


@pytest.mark.parametrize("rate_hz", [10.0, 40.0, 100.0, 200.0])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.2])
@pytest.mark.parametrize("late", ["exact", "a fifth of a step"])
def test_rate_is_that_of_the_device_although_messages_are_lost(rate_hz, share, late):
    at, _ = arrivals(rate_hz, share, late, max(round(3 * rate_hz), 140))
    assert rate_of_arrivals(VNIMU, at, [0] * len(at)) == (rate_hz, "arrival times")


@pytest.mark.parametrize(("rate_hz", "layout"), [(100 / 3, BINARY), (50.0, BINARY), (33.0, VNIMU)])
def test_rates_that_a_sentence_has_not_are_found_as_well(rate_hz, layout):
    at, _ = arrivals(rate_hz, 0.03, "exact", 160)
    found = rate_of_arrivals(layout, at, [0] * len(at))
    assert found == (pytest.approx(rate_hz), "arrival times")


def test_a_rate_that_no_regular_step_explains_is_told_as_such():
    rng = np.random.default_rng(3)
    at = (100.0 + np.cumsum(rng.exponential(0.025, 2000))).tolist()
    assert rate_of_arrivals(VNIMU, at[:200], [0] * 200) is None  # more may tell
    rate_hz, said = rate_of_arrivals(VNIMU, at[:200], [0] * 200, ends=True)
    assert rate_hz == pytest.approx(40.0, rel=0.2)
    assert said == UNSURE
    assert rate_of_arrivals(VNIMU, at, [0] * 2000)[1] == UNSURE


def test_lost_messages_are_no_other_rate():
    at, _ = arrivals(40.0, 0.2, "exact", 1200)
    watch = RateWatch()
    assert [found for one in at if (found := watch.look(one, 0, 40.0)) is not None] == []


def test_samples_of_a_stream_with_lost_messages_have_the_right_times():
    epochs = RegisterEpochs()
    identity = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    calibration = dict.fromkeys((23, 84), (*identity, 0.0, 0.0, 0.0))
    epochs.begin(0.0, Compensation.from_registers({**calibration, 26: identity}))
    stream = Stream(epochs)
    at, numbers = arrivals(40.0, 0.03, "exact")
    blocks = []
    for one in at.tolist():
        values = tuple(0.1 for _ in VNIMU.columns)
        blocks += stream.take(Measurement(VNIMU, values, 0), one)
    blocks += stream.flush()
    time_s = np.concatenate([block.time_s for block in blocks])
    dt_s = np.concatenate([block.dt_s for block in blocks])
    assert time_s == pytest.approx(numbers / 40.0)
    assert np.isnan(dt_s[1:]).tolist() == (np.diff(numbers) > 1).tolist()
    missing = numbers[-1] + 1 - len(numbers)
    assert stream.health().drop_rate == pytest.approx(missing / (numbers[-1] + 1))
    assert any("by the times at which the others arrived" in text for text in stream.warnings)


def test_a_loss_that_the_arrivals_tell_is_not_counted_again_by_the_attitude():
    stream = Stream(RegisterEpochs(), 40.0)
    layout = MESSAGES["VNYMR"]
    at, numbers = arrivals(40.0, 0.1, "exact", 800)
    for one, number in zip(at.tolist(), numbers.tolist(), strict=True):
        yaw = (number * 0.025 * 1.5 + np.pi) % (2.0 * np.pi) - np.pi  # 1.5 rad/s
        said = {"yaw_rad": yaw, "pitch_rad": 0.0, "roll_rad": 0.0}
        said |= {"gyro_x_rad_s": 0.0, "gyro_y_rad_s": 0.0, "gyro_z_rad_s": 0.9}
        values = tuple(said.get(column.name, 0.1) for column in layout.columns)
        stream.take(Measurement(layout, values, 0), one)
    stream.flush()
    missing = numbers[-1] + 1 - len(numbers)
    assert stream.health().drop_rate == pytest.approx(missing / (numbers[-1] + 1))
    assert [text for text in stream.warnings if "turned further" in text] == []
