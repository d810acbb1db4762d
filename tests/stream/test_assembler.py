"""Messages to raw samples: clock, gaps, registers, damage, and which message is used."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.samples import SampleBlock
from ahrsd.stream.assembler import OTHERS, NoSamplesError, Stream
from ahrsd.stream.decompensation import Compensation, RegisterEpochs
from drivers.vn100.decode import Measurement
from drivers.vn100.deframer import Cause, Skipped
from drivers.vn100.messages import MESSAGES, binary_layout

VNYMR = MESSAGES["VNYMR"]
VNYPR = MESSAGES["VNYPR"]
BINARY = binary_layout(0x06, (0x0001, 0x083F))  # the calibration set, with TimeStartup
REGISTERS = {
    23: (1.1, 0.02, 0.0, 0.01, 0.95, 0.0, 0.0, 0.03, 1.0, 0.1, -0.05, 0.02),
    84: (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.01, 0.02, -0.03),
    26: (0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
}


def message(layout: object, k: int, **values: float) -> Measurement:
    """The k-th message of a stream: every value 0.1 unless it is given."""
    said = {"time_startup_s": k / 40.0, "saturation_flags": 0.0, **values}
    names = [column.name for column in layout.columns]
    unknown = set(values) - set(names)
    assert not unknown, (unknown, names)
    return Measurement(layout, tuple(said.get(n, 0.0 if "flag" in n else 0.1) for n in names), 0)


def feed(stream: Stream, layout: object, ticks: range, host: bool = False, **values: float):
    blocks: list[SampleBlock] = []
    for k in ticks:
        host_s = 100.0 + k / 40.0 if host else 0.0
        blocks += stream.take(message(layout, k, **values), host_s)
    return blocks


def joined(blocks: list[SampleBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(block, name) for block in blocks])


def known() -> RegisterEpochs:
    epochs = RegisterEpochs()
    epochs.begin(0.0, Compensation.from_registers(REGISTERS))
    return epochs


class TestTime:
    def test_samples_have_the_device_time(self):
        stream = Stream(RegisterEpochs())
        blocks = feed(stream, BINARY, range(40)) + stream.flush()
        assert joined(blocks, "time_s") == pytest.approx(np.arange(40) / 40.0)
        assert np.isnan(blocks[0].dt_s[0])
        assert joined(blocks, "dt_s")[1:] == pytest.approx(np.full(39, 0.025))
        assert stream.facts.rate_hz == pytest.approx(40.0)
        assert (stream.facts.rate_source, stream.facts.samples) == ("device time", 40)
        assert stream.facts.duration_s == pytest.approx(39 / 40)
        assert stream.gaps == []

    def test_a_gap_is_recorded_and_not_bridged(self):
        stream = Stream(RegisterEpochs())
        blocks = feed(stream, BINARY, range(20)) + feed(stream, BINARY, range(60, 80))
        blocks += stream.flush()
        (gap,) = stream.gaps
        assert (gap.at_s, gap.length_s) == pytest.approx((19 / 40, 41 / 40))
        assert [block.gap_before for block in blocks].count(True) == 2
        after = next(block for block in blocks[1:] if block.gap_before)
        assert np.isnan(after.dt_s[0])
        assert after.time_s[0] == 1.5
        assert stream.health().drop_rate == pytest.approx(40 / 80)
        assert stream.facts.duration_s == pytest.approx(79 / 40)

    def test_loss_caused_by_the_program_is_excused_once(self):
        stream = Stream(RegisterEpochs())
        feed(stream, BINARY, range(20))
        stream.forgive()
        feed(stream, BINARY, range(60, 80))
        assert stream.health().drop_rate == 0.0
        assert len(stream.gaps) == 1
        feed(stream, BINARY, range(120, 140))
        stream.flush()
        assert stream.health().drop_rate == pytest.approx(40 / 100)

    def test_restart_starts_a_new_run_and_time_never_decreases(self):
        stream = Stream(RegisterEpochs())
        blocks = feed(stream, BINARY, range(400, 420)) + feed(stream, BINARY, range(20))
        blocks += stream.flush()
        assert stream.restarts == 1
        assert np.nanmin(joined(blocks, "dt_s")) > 0.0
        assert stream.facts.duration_s == pytest.approx(38 / 40)
        assert stream.health().negative_dt == 1

    def test_forget_cuts(self):
        stream = Stream(RegisterEpochs())
        blocks = feed(stream, BINARY, range(20)) + stream.flush()
        stream.forget()
        blocks += feed(stream, BINARY, range(20, 40)) + stream.flush()
        assert np.count_nonzero(np.isnan(joined(blocks, "dt_s"))) == 2
        assert stream.gaps == []  # how long nobody can say


class TestWithoutTime:
    def test_given_rate_is_used(self):
        stream = Stream(RegisterEpochs(), 50.0)
        blocks = feed(stream, VNYMR, range(100)) + stream.flush()
        assert joined(blocks, "time_s") == pytest.approx(np.arange(100) / 50.0)
        assert stream.facts.rate_source == "as given"
        assert "50 Hz (as given)" in next(w for w in stream.warnings if "no time" in w)

    def test_factory_rate_is_assumed_with_a_warning(self):
        stream = Stream(RegisterEpochs())
        feed(stream, VNYMR, range(20))
        assert stream.facts.rate_hz == 40.0
        assert any("assumed: the factory's rate" in text for text in stream.warnings)

    def test_register_7_comes_before_arrival_times(self):
        stream = Stream(known())
        stream.registers = {7: (20,)}
        feed(stream, VNYMR, range(20), host=True)
        assert (stream.facts.rate_hz, stream.facts.rate_source) == (20.0, "register 7")

    def test_rate_is_found_from_arrival_times_live(self):
        stream = Stream(known())
        blocks = feed(stream, VNYMR, range(99), host=True)
        assert blocks == []
        blocks = feed(stream, VNYMR, range(99, 120), host=True)
        assert stream.facts.rate_hz == pytest.approx(40.0)
        assert stream.facts.rate_source == "arrival times"
        assert len(joined(blocks, "time_s")) >= 110

    def test_damaged_message_is_a_gap_of_one_step(self):
        stream = Stream(RegisterEpochs(), 40.0)
        blocks = feed(stream, VNYMR, range(20))
        stream.damaged(Skipped(0, bytes(100), Cause.CHECKSUM))
        blocks += feed(stream, VNYMR, range(20)) + stream.flush()
        (gap,) = stream.gaps
        assert (gap.at_s, gap.length_s) == pytest.approx((19 / 40, 2 / 40))
        assert stream.health().crc_error_rate == pytest.approx(1 / 41)
        assert stream.health().drop_rate == pytest.approx(1 / 41)

    def test_longer_damage_counts_as_several_messages(self):
        stream = Stream(RegisterEpochs(), 40.0)
        feed(stream, VNYMR, range(20))
        stream.damaged(Skipped(0, bytes(610), Cause.BROKEN))
        feed(stream, VNYMR, range(20))
        stream.flush()
        assert stream.gaps[0].length_s == pytest.approx(6 / 40)

    def test_lines_of_other_devices_are_not_losses(self):
        stream = Stream(RegisterEpochs(), 40.0)
        feed(stream, VNYMR, range(20))
        stream.damaged(Skipped(0, b"$GPGGA,1,2,3*00\r\n" * 100, Cause.NOISE))
        stream.damaged(Skipped(0, b"\xb5\x62" * 20, Cause.NOISE))
        feed(stream, VNYMR, range(20))
        stream.flush()
        assert stream.gaps == []
        assert stream.health().crc_error_rate == 0.0

    @pytest.mark.parametrize(
        ("pieces", "lost"),
        [
            ([(120, Cause.NOISE)], 1),
            ([(370, Cause.NOISE)], 3),
            ([(15, Cause.CHECKSUM), (95, Cause.NOISE)], 1),
            ([(15, Cause.CHECKSUM), (300, Cause.NOISE)], 3),
        ],
    )
    def test_garbage_in_place_of_messages_is_not_bridged(self, pieces, lost):
        stream = Stream(RegisterEpochs(), 40.0)
        feed(stream, VNYMR, range(20))
        for size, cause in pieces:
            stream.damaged(Skipped(0, b"\x93\x07\xff" * (size // 3) + bytes(size % 3), cause))
        feed(stream, VNYMR, range(20))
        stream.flush()
        assert [gap.length_s for gap in stream.gaps] == [pytest.approx((lost + 1) / 40)]

    def test_damage_before_the_first_message_shifts_no_time(self):
        stream = Stream(RegisterEpochs(), 40.0)
        stream.damaged(Skipped(0, bytes(3000), Cause.CRC))
        blocks = feed(stream, VNYMR, range(20)) + stream.flush()
        assert blocks[0].time_s[0] == 0.0
        assert stream.gaps == []

    def test_message_with_invalid_content_counts_as_lost(self):
        stream = Stream(RegisterEpochs(), 40.0)
        feed(stream, VNYMR, range(20))
        stream.undecodable()
        feed(stream, VNYMR, range(20))
        stream.flush()
        assert len(stream.gaps) == 1
        assert stream.facts.damaged == 1

    def test_messages_missing_without_a_trace_are_gaps_with_a_warning(self):
        stream = Stream(RegisterEpochs(), 40.0)
        still = {f"gyro_{a}_rad_s": 0.0 for a in "xyz"} | {"pitch_rad": 0.0, "roll_rad": 0.0}
        for yaw in (0.0, 0.5, 1.0, 1.5):
            feed(stream, VNYMR, range(20), yaw_rad=yaw, **still)
        stream.flush()
        assert len(stream.gaps) == 3
        (said,) = [
            text for text in stream.warnings if "missing although the bytes show no gap" in text
        ]
        assert "at 3 places" in said
        assert stream.health().drop_rate > 0.0


class TestRegisters:
    def test_samples_are_the_raw_readings_of_the_sensor(self):
        """Independent of `decompensation`: out = R C (m - B) for 23 and 84, put in, m comes out."""
        C, B = np.reshape(REGISTERS[23][:9], (3, 3)), np.array(REGISTERS[23][9:])
        R, B84 = np.reshape(REGISTERS[26], (3, 3)), np.array(REGISTERS[84][9:])
        m, w = np.array([0.21, -0.12, 0.4]), np.array([0.3, -0.2, 0.1])
        out, rate = R @ C @ (m - B), R @ (w - B84)
        values = {f"uncomp_mag_{a}_gauss": v for a, v in zip("xyz", out, strict=True)}
        values |= {f"uncomp_gyro_{a}_rad_s": v for a, v in zip("xyz", rate, strict=True)}
        stream = Stream(known())
        blocks = feed(stream, BINARY, range(20), host=True, **values) + stream.flush()
        assert joined(blocks, "raw_b_gauss") == pytest.approx(np.tile(m, (20, 1)))
        assert joined(blocks, "gyro_b_rad_s") == pytest.approx(np.tile(w, (20, 1)))

    def test_register_change_changes_the_un_mapping_from_there_on(self):
        epochs = RegisterEpochs()
        stream = Stream(epochs)
        blocks = feed(stream, BINARY, range(40), host=True) + stream.flush()
        epochs.begin(101.0, Compensation.from_registers(REGISTERS))
        blocks += feed(stream, BINARY, range(40, 80), host=True) + stream.flush()
        raw, epoch = joined(blocks, "raw_b_gauss"), [b.epoch for b in blocks]
        assert epoch == sorted(epoch)
        assert raw[39] == pytest.approx([0.1, 0.1, 0.1])
        unrotated = np.linalg.inv(np.reshape(REGISTERS[26], (3, 3))) @ [0.1, 0.1, 0.1]
        assert raw[40] == pytest.approx(Affine.from_register(REGISTERS[23]).undo(unrotated))
        assert np.isfinite(joined(blocks, "dt_s")[1:]).all()  # the stream itself goes on

    def test_samples_are_omitted_while_the_registers_are_unknown(self):
        epochs = RegisterEpochs()
        stream = Stream(epochs)
        blocks = feed(stream, BINARY, range(40), host=True) + stream.flush()
        epochs.begin(101.0, None)
        assert feed(stream, BINARY, range(40, 60), host=True) + stream.flush() == []
        epochs.begin(101.5, Compensation.from_registers(REGISTERS))
        blocks = feed(stream, BINARY, range(60, 80), host=True) + stream.flush()
        assert blocks[0].gap_before
        assert np.isnan(blocks[0].dt_s[0])


class TestWhichMessage:
    def test_better_message_replaces_the_used_one_without_mixing(self):
        stream = Stream(RegisterEpochs())
        feed(stream, VNYMR, range(40))
        assert stream.compensated_mag
        assert stream.compensated_gyro
        assert not stream.take_replaced()
        blocks = feed(stream, BINARY, range(100, 140)) + stream.flush()
        assert stream.take_replaced()
        assert not stream.take_replaced()
        assert not stream.compensated_mag
        assert blocks[0].gap_before
        assert list(stream.warnings) == [f"VNYMR was left out when {BINARY.name} began"]

    def test_worse_message_does_not_replace_the_used_one(self):
        stream = Stream(RegisterEpochs())
        feed(stream, BINARY, range(40))
        assert feed(stream, VNYMR, range(40)) == []
        assert stream.by_layout == {BINARY.name: 40, "VNYMR": 40}
        assert stream.facts.layout == BINARY.name

    def test_worse_message_is_used_after_the_better_one_stopped(self):
        stream = Stream(RegisterEpochs())
        feed(stream, BINARY, range(40))
        for k in range(0, 1000, 200):  # both in turn: the better one stays
            assert feed(stream, VNYMR, range(200)) == []
            feed(stream, BINARY, range(40 + k, 41 + k))
        assert feed(stream, VNYMR, range(399)) == []
        assert feed(stream, VNYMR, range(399, 440)) != []
        assert stream.facts.layout == "VNYMR"
        assert stream.take_replaced()
        assert f"{BINARY.name} was left out when VNYMR began" in stream.warnings

    def test_stream_without_a_magnetometer_is_refused_with_advice(self):
        stream = Stream(RegisterEpochs())
        assert feed(stream, MESSAGES["VNYPR"], range(5)) == []
        with pytest.raises(NoSamplesError, match=r"VNYPR carries no magnetometer.*configure VNYMR"):
            stream.check()

    def test_empty_stream_is_not_an_error_of_the_assembler(self):
        Stream(RegisterEpochs()).check()


class TestUnusable:
    def test_a_saturated_sample_is_a_gap(self):
        stream = Stream(RegisterEpochs())
        name = next(c.name for c in BINARY.columns if "sat" in c.name)
        feed(stream, BINARY, range(20))
        feed(stream, BINARY, range(20, 24), **{name: 1.0})
        feed(stream, BINARY, range(24, 44))
        stream.flush()
        assert stream.facts.unusable == stream.health().saturated == 4
        assert stream.facts.samples == 40
        (gap,) = stream.gaps
        assert gap.length_s == pytest.approx(5 / 40)

    def test_non_finite_values_are_dropped(self):
        stream = Stream(RegisterEpochs())
        feed(stream, BINARY, range(20))
        feed(stream, BINARY, range(20, 21), uncomp_mag_y_gauss=float("nan"))
        blocks = feed(stream, BINARY, range(21, 60)) + stream.flush()
        assert stream.facts.unusable == 1
        assert np.isfinite(joined(blocks, "raw_b_gauss")).all()


def test_block_size_follows_from_the_number_of_messages():
    one, other = Stream(RegisterEpochs(), 40.0), Stream(RegisterEpochs(), 40.0)
    sizes = [len(block) for block in feed(one, VNYMR, range(100))]
    assert set(sizes[1:]) == {10}
    assert [len(b) for b in feed(other, VNYMR, range(100))] == sizes
    slow = Stream(RegisterEpochs(), 5.0)
    assert {len(block) for block in feed(slow, VNYMR, range(100))} == {4}


def test_a_table_is_counted_with_its_gaps():
    def rows(start: int, stop: int, gap: bool) -> SampleBlock:
        time_s = np.arange(start, stop) / 20.0
        dt_s = np.full(len(time_s), 0.05)
        dt_s[0] = np.nan if gap else 0.05
        three = np.full((len(time_s), 3), 0.1)
        return SampleBlock(time_s, dt_s, time_s, three, three, three, gap_before=gap)

    stream = Stream(RegisterEpochs())
    for block in (rows(0, 50, True), rows(50, 100, False), rows(140, 200, True)):
        stream.given(block)
    assert stream.facts.samples == 160
    assert stream.facts.rate_hz == pytest.approx(20.0)
    assert stream.facts.duration_s == pytest.approx(199 / 20)
    (gap,) = stream.gaps
    assert (gap.at_s, gap.length_s) == pytest.approx((99 / 20, 41 / 20))
    assert stream.health().drop_rate == pytest.approx(40 / 200)


def test_gap_list_is_bounded_and_all_gaps_are_counted():
    bounded, whole = Stream(RegisterEpochs(), keep_gaps=3), Stream(RegisterEpochs())
    ticks = [k for k in range(2000) if k % 100 >= 10]  # ten messages are missing, twenty times
    for stream in (bounded, whole):
        for k in ticks:
            stream.take(message(BINARY, k), 0.0)
        stream.flush()
    assert [len(whole.gaps), len(bounded.gaps)] == [19, 6]
    assert bounded.gaps == [*whole.gaps[:3], *whole.gaps[-3:]]
    for stream in (bounded, whole):
        assert stream.all_gaps.count == 19
        assert stream.all_gaps.length_s == pytest.approx(19 * 11 / 40)
    assert bounded.facts == whole.facts


def test_list_of_message_names_is_bounded_and_every_message_is_counted():
    stream = Stream(RegisterEpochs())
    feed(stream, BINARY, range(10))
    for field in range(100):  # other layouts, none of any use
        name = f"FA {field}"
        stream.take(Measurement(dataclasses.replace(VNYPR, name=name), (0.0, 0.0, 0.0), 0), 0.0)
    assert len(stream.by_layout) == 65
    assert stream.by_layout[OTHERS] == 100 - 63
    assert stream.by_layout.total() == 110
    assert len(stream.refused) == 64
    feed(stream, BINARY, range(10, 20))
    assert stream.by_layout[BINARY.name] == 20


def test_repeated_rate_gives_one_warning():
    stream = Stream(RegisterEpochs())
    for begin, rate in ((0, 40.0), (5000, 50.0), (10000, 20.0)):
        stream.registers = {7: (rate,)}
        feed(stream, VNYMR, range(begin, begin + 50))
        assert stream.facts.rate_hz == rate
        stream.forget()
        feed(stream, BINARY, range(begin + 100, begin + 150))
        stream.forget()
    assert [text for text in stream.warnings if "carries no time" in text] == [
        "VNYMR carries no time: 20 Hz (register 7); a wrong rate makes the gyro bias and the "
        "weights wrong; --rate sets that of a recording, device.configure_stream asks a device "
        "for packets with their time"
    ]


@pytest.mark.parametrize(("apart_gauss", "told"), [(0.1, 1), (0.0, 0)])
def test_messages_of_two_devices_in_turn_are_told(apart_gauss, told):
    stream = Stream(RegisterEpochs(), 80.0)
    for k in range(400):
        field = 0.1 + 1e-4 * k + apart_gauss * (k % 2)
        stream.take(message(VNYMR, k, mag_x_gauss=field), 0.0)
    stream.flush()
    said = [text for text in stream.warnings if "2 sensors in turn" in text]
    assert len(said) == told
