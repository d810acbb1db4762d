"""Samples are available before their block is full: each once, in order, as in the block."""

from __future__ import annotations

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.stream.assembler import Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs
from ahrsd.telemetry.protocol import Newest, samples_record
from drivers.vn100.decode import Measurement
from drivers.vn100.messages import MESSAGES, binary_layout

BINARY = binary_layout(0x06, (0x0001, 0x083F))  # with TimeStartup
PRESENT = Affine(np.diag([1.1, 0.9, 1.0]), np.array([0.01, 0.02, 0.03]))


def message(layout, at_s, draw):
    names = [column.name for column in layout.columns]
    values = {n: draw.normal() if n.startswith("uncomp") else 0.0 for n in names}
    values |= {"time_startup_s": at_s} if "time_startup_s" in names else {}
    return Measurement(layout, tuple(values.values()), 0)


def told(times, layout=BINARY):
    """Samples looked up after each message, and the blocks; device times in s."""
    epochs, newest, draw = RegisterEpochs(), Newest(), np.random.default_rng(1)
    epochs.begin(0.0, Compensation.unknown())
    stream, records, blocks = Stream(epochs, 40.0), [], []
    for k, at_s in enumerate(times):
        full = stream.take(message(layout, at_s, draw), 100.0 + k / 40.0)
        blocks += full
        records += [newest.full(block) for block in full]
        records += newest.waiting(stream.peek())
    parts = [part for part in records if part is not None]
    return [samples_record(part, PRESENT) for part in parts], blocks


def test_each_sample_is_returned_once_with_the_values_of_its_block():
    records, blocks = told(np.arange(81) / 40.0)
    assert len(records) > 60  # one by one, but for the first few, when the rate is not known
    for name in ("time_s", "raw_b_gauss", "gyro_b_rad_s"):
        said = np.concatenate([record[name] for record in records])
        true = np.concatenate([getattr(block, name) for block in blocks])
        assert np.array_equal(said[: len(true)], true)
    said = np.concatenate([record["time_s"] for record in records])
    assert said.tolist() == (np.arange(81) / 40.0).tolist()
    raw = np.concatenate([record["raw_b_gauss"] for record in records])
    corrected = np.concatenate([record["corrected_b_gauss"] for record in records])
    assert np.allclose(corrected, PRESENT.apply(raw), rtol=0, atol=0)


def test_gap_is_returned_before_the_first_sample_after_it():
    records, _ = told([*(np.arange(40) / 40.0), *(5.0 + np.arange(40) / 40.0)])
    behind = [record["time_s"][0] for record in records if record["gap_before"]]
    assert behind == [0.0, 5.0]


def test_samples_after_a_restart_begin_with_the_first():
    records, _ = told([*(50.0 + np.arange(40) / 40.0), *(np.arange(40) / 40.0)])
    said = np.concatenate([record["time_s"] for record in records])
    assert np.count_nonzero(said < 10.0) == 40
    assert np.count_nonzero(said > 10.0) == 40


def test_lookup_has_no_side_effects_and_is_empty_without_device_time():
    draw = np.random.default_rng(2)
    seen, unseen = Stream(RegisterEpochs()), Stream(RegisterEpochs())
    for k in range(100):
        one = message(BINARY, k / 40.0 + (k > 50), draw)
        for a, b in zip(seen.take(one, 0.0), unseen.take(one, 0.0), strict=True):
            assert np.array_equal(a.raw_b_gauss, b.raw_b_gauss)
            assert np.array_equal(a.dt_s, b.dt_s, equal_nan=True)
        seen.peek()
        seen.peek()
    assert seen.gaps == unseen.gaps
    ymr = MESSAGES["VNYMR"]
    blind = Stream(RegisterEpochs(), 40.0)
    for _ in range(3):
        blind.take(message(ymr, 0.0, draw), 0.0)
    assert blind.peek() == []
