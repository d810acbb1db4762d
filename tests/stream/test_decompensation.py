"""Un-mapping compared with an independent forward model of the device's compensation chain."""

from dataclasses import dataclass

import numpy as np
import pytest

from ahrsd.calibration import Affine
from ahrsd.samples import Array
from ahrsd.stream.decompensation import (
    EPOCHS_KEPT,
    Compensation,
    Extracted,
    Extractor,
    MissingQuantityError,
    RegisterEpochs,
    sample_blocks,
)
from ahrsd.stream.device_clock import StreamTimeline

Values = dict[int, tuple[float | int | str, ...]]


@dataclass(frozen=True)
class Named:
    name: str


@dataclass(frozen=True)
class Message:
    name: str
    columns: tuple[Named, ...]


def message(name: str, *columns: str) -> Message:
    return Message(name, tuple(Named(column) for column in columns))


def xyz(quantity: str, unit: str) -> list[str]:
    return [f"{quantity}_{axis}_{unit}" for axis in "xyz"]


VNYMR = message(
    "VNYMR",
    *("yaw_rad", "pitch_rad", "roll_rad"),
    *xyz("mag", "gauss"),
    *xyz("accel", "m_s2"),
    *xyz("gyro", "rad_s"),
)
PACKET = message(
    "FA 06 0001 083F",
    "time_startup_s",
    *xyz("mag", "gauss"),
    *xyz("uncomp_mag", "gauss"),
    *xyz("uncomp_accel", "m_s2"),
    *xyz("uncomp_gyro", "rad_s"),
    *("temperature_c", "sens_sat"),
)


def extract(extractor: Extractor, messages: list[tuple[float, ...]]) -> Extracted:
    return extractor.extract_table(np.array(messages, dtype=np.float64))


def random_rotation(rng: np.random.Generator) -> Array:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q @ np.diag(np.sign(np.diag(r)))
    return np.asarray(q * np.linalg.det(q))


def random_affine(rng: np.random.Generator, offset: float) -> Affine:
    return Affine(np.eye(3) + 0.2 * rng.normal(size=(3, 3)), offset * rng.normal(size=3))


def chain(m: Array, affine: Affine, R: Array) -> Array:
    """The device, one vector at a time, straight from the manual: subtract, multiply, rotate."""
    return np.array([R @ (affine.matrix @ (v - affine.offset)) for v in m])


def register_set(rng: np.random.Generator, hsi: bool = False) -> tuple[Values, dict[int, Affine]]:
    affines = {n: random_affine(rng, s) for n, s in ((23, 0.2), (84, 0.02), (25, 0.3), (47, 0.1))}
    values: Values = {n: a.to_register() for n, a in affines.items()}
    values[26] = tuple(random_rotation(rng).ravel().tolist())
    values[44] = (1, 3, 5) if hsi else (0, 1, 5)
    return values, affines


@pytest.mark.parametrize("seed", range(5))
def test_every_quantity_comes_back_raw(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, affines = register_set(rng)
    R = np.array(values[26], float).reshape(3, 3)
    compensation = Compensation.from_registers(values)
    mag, gyro, accel = rng.normal(size=(3, 20, 3))
    assert compensation.raw_mag(chain(mag, affines[23], R), False) == pytest.approx(mag)
    assert compensation.raw_mag(chain(mag, affines[23], R), True) == pytest.approx(mag)
    assert compensation.raw_gyro(chain(gyro, affines[84], R)) == pytest.approx(gyro)
    assert compensation.raw_accel(chain(accel, affines[25], R)) == pytest.approx(accel)
    assert compensation.warnings == ()


def test_hsi_is_undone_for_compensated_fields_only() -> None:
    rng = np.random.default_rng(9)
    values, affines = register_set(rng, hsi=True)
    R = np.array(values[26], float).reshape(3, 3)
    compensation = Compensation.from_registers(values)
    mag = rng.normal(size=(20, 3))
    user = chain(mag, affines[23], R)
    assert compensation.raw_mag(user, compensated=False) == pytest.approx(mag)
    onboard = chain(user, affines[47], np.eye(3))
    assert compensation.raw_mag(onboard, compensated=True) == pytest.approx(mag)
    assert "moving target" in compensation.warnings[0]


def test_example_of_the_manual() -> None:
    """vn100-protocol.md 5.2: the worked example, both ways."""
    values = (1.02, 0.01, 0.0, 0.01, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 0.10)
    compensation = Compensation.from_registers({23: values})
    raw = compensation.raw_mag(np.array([[0.2053, 0.1294, 0.4040]]), False)
    assert raw == pytest.approx(np.array([[0.25, 0.10, 0.50]]))


def test_missing_registers_are_named() -> None:
    warnings = Compensation.from_registers({23: Affine.identity().to_register()}).warnings
    assert [w.split(" was")[0] for w in warnings] == ["register 84", "register 26"]
    assert "registers are not known" in Compensation.unknown().warnings[0]
    applied = Compensation.from_registers({44: (1, 3, 5)}).warnings
    assert any("47 was not read" in text for text in applied)


def test_uncompensated_columns_are_preferred() -> None:
    extractor = Extractor(PACKET)
    row = (7.0, *[1.0] * 3, 2.0, 3.0, 4.0, *[9.8] * 3, 0.1, 0.2, 0.3, 25.0, 0.0)
    extracted = extract(extractor, [row, row])
    assert extracted.mag_gauss.tolist() == [[2.0, 3.0, 4.0]] * 2
    assert extracted.gyro_rad_s.tolist() == [[0.1, 0.2, 0.3]] * 2
    assert extracted.time_s is not None
    assert extracted.time_s.tolist() == [7.0, 7.0]
    assert extracted.covariates["temperature_c"].tolist() == [25.0, 25.0]
    assert "mag_x_gauss" in extracted.covariates
    assert "sens_sat" not in extracted.covariates
    assert extractor.warnings == ()


def test_compensated_stream_is_used_with_a_warning() -> None:
    extractor = Extractor(VNYMR)
    assert not extractor.has_time
    assert extractor.gyro_compensated
    extracted = extract(extractor, [tuple(float(k) for k in range(12))])
    assert extracted.time_s is None
    assert extracted.mag_gauss.tolist() == [[3.0, 4.0, 5.0]]
    assert extracted.accel_m_s2.tolist() == [[6.0, 7.0, 8.0]]
    assert extracted.gyro_rad_s.tolist() == [[9.0, 10.0, 11.0]]
    about_mag, about_gyro = extractor.warnings
    assert "compensated field" in about_mag
    assert "only what remains of it" in about_gyro


def test_no_messages_make_empty_arrays() -> None:
    extracted = Extractor(PACKET).extract_table(np.empty((0, len(PACKET.columns))))
    assert extracted.mag_gauss.shape == (0, 3)
    assert extracted.usable.shape == (0,)


@pytest.mark.parametrize(
    ("layout", "quantity"),
    [
        (message("VNYIA", *xyz("linear_accel", "m_s2"), *xyz("gyro", "rad_s")), "magnetometer"),
        (message("VNMAG", *xyz("mag", "gauss")), "gyroscope"),
        (message("VNERR"), "magnetometer"),
    ],
)
def test_insufficient_stream_is_refused_with_a_suitable_message(
    layout: Message, quantity: str
) -> None:
    with pytest.raises(MissingQuantityError, match=rf"{layout.name} carries no {quantity}.*VNIMU"):
        Extractor(layout)


@pytest.mark.parametrize(
    ("flags", "usable"),
    [
        (0, True),
        (1, False),
        (4, False),
        (8, True),
        (32, True),
        (64, False),
        (256, False),
        (512, True),
    ],
)
def test_saturated_samples_are_not_usable(flags: int, usable: bool) -> None:
    row = (0.0, *[0.1] * 12, 25.0, float(flags))
    assert extract(Extractor(PACKET), [row]).usable.tolist() == [usable]


def test_non_finite_samples_are_not_usable() -> None:
    good = (0.0, *[0.1] * 12, 25.0, 0.0)
    bad = (0.0, *[0.1] * 3, float("nan"), *[0.1] * 8, 25.0, 0.0)
    assert extract(Extractor(PACKET), [good, bad]).usable.tolist() == [True, False]


def test_epochs_split_a_block_where_registers_changed() -> None:
    epochs = RegisterEpochs()
    one = epochs.begin(10.0, Compensation.unknown())
    two = epochs.begin(12.0, None)
    three = epochs.begin(13.0, Compensation.unknown())
    runs = epochs.split(np.array([9.0, 10.0, 11.9, 12.0, 12.5, 13.0, 14.0]))
    assert [(r.start, r.stop, e.number) for r, e in runs] == [
        (0, 1, 0),
        (1, 3, one.number),
        (3, 5, two.number),
        (5, 7, three.number),
    ]
    assert epochs.begin(5.0, None).since_s == 13.0
    for k in range(3 * EPOCHS_KEPT):
        epochs.begin(20.0 + k, None)
    ((_, oldest),) = epochs.split(np.array([-1.0]))
    assert oldest.number == epochs.now.number - EPOCHS_KEPT + 1


def rows(time_s: Array, mag: Array) -> list[tuple[float, ...]]:
    return [(t, *[0.0] * 3, *m, *[9.8] * 3, *[0.1] * 3, 20.0, 0.0) for t, m in zip(time_s, mag)]


def test_blocks_are_raw_through_a_register_change_and_cut_at_gaps() -> None:
    rng = np.random.default_rng(3)
    (old, old_affines), (new, new_affines) = register_set(rng), register_set(rng)
    time_s = np.concatenate([np.arange(0, 10) * 0.1, 3.0 + np.arange(0, 10) * 0.1])
    raw = rng.normal(size=(20, 3))
    sent = np.concatenate(
        [
            chain(raw[:15], old_affines[23], np.array(old[26], float).reshape(3, 3)),
            chain(raw[15:], new_affines[23], np.array(new[26], float).reshape(3, 3)),
        ]
    )
    epochs = RegisterEpochs()
    epochs.begin(0.0, Compensation.from_registers(old))
    epochs.begin(103.45, Compensation.from_registers(new))
    extractor = Extractor(PACKET)
    extracted = extract(extractor, rows(time_s, sent))
    steps = StreamTimeline().extend(time_s, extracted.usable)
    blocks = sample_blocks(extractor, extracted, steps, 100.0 + time_s, epochs)
    assert [(len(b), b.epoch, b.gap_before) for b in blocks] == [
        (10, 1, True),
        (5, 1, True),
        (5, 2, False),
    ]
    assert np.concatenate([b.raw_b_gauss for b in blocks]) == pytest.approx(raw)
    dt_s = np.concatenate([b.dt_s for b in blocks])
    assert np.flatnonzero(np.isnan(dt_s)).tolist() == [0, 10]
    assert dt_s[[1, 11, 15]] == pytest.approx(0.1)
    assert blocks[2].host_s[0] == pytest.approx(103.5)


def test_samples_under_unknown_registers_are_dropped_and_leave_a_gap() -> None:
    time_s = np.asarray(np.arange(9) * 0.1, float)
    epochs = RegisterEpochs()
    epochs.begin(0.25, None)
    epochs.begin(0.55, Compensation.unknown())
    extractor = Extractor(PACKET)
    extracted = extract(extractor, rows(time_s, np.ones((9, 3))))
    steps = StreamTimeline().extend(time_s, extracted.usable)
    blocks = sample_blocks(extractor, extracted, steps, time_s, epochs)
    assert [(b.time_s[0], len(b), b.gap_before) for b in blocks] == [
        (0.0, 3, True),
        (pytest.approx(0.6), 3, True),
    ]
    assert np.isnan(blocks[1].dt_s[0])
    assert blocks[1].dt_s[1:] == pytest.approx(0.1)


def test_sample_is_omitted_when_registers_change_before_its_arrival() -> None:
    """The instant is estimated by the clock; a delayed host receives the sample after the
    change.
    """
    time_s = np.asarray(np.arange(9) * 0.1, float)
    arrived_s = np.maximum(time_s, [0.0, 0.1, 0.4, 0.4, 0.4, 0.5, 0.6, 0.7, 0.8])
    epochs = RegisterEpochs()
    epochs.begin(0.0, Compensation.unknown())
    epochs.begin(0.35, Compensation.unknown())
    extractor = Extractor(PACKET)
    extracted = extract(extractor, rows(time_s, np.ones((9, 3))))
    steps = StreamTimeline().extend(time_s, extracted.usable)
    blocks = sample_blocks(extractor, extracted, steps, time_s, epochs, arrived_s)
    assert [(b.time_s.round(1).tolist(), b.epoch, b.gap_before) for b in blocks] == [
        ([0.0, 0.1], 1, True),
        ([0.4, 0.5, 0.6, 0.7, 0.8], 2, True),
    ]
    assert np.isnan(blocks[1].dt_s[0])


def test_samples_of_a_new_link_are_not_un_mapped_by_earlier_registers() -> None:
    """A sample may be dated before the link, because its bytes waited in the port."""
    time_s = np.asarray(np.arange(9) * 0.1, float)
    epochs = RegisterEpochs()
    epochs.begin(0.15, Compensation.unknown())
    before = epochs.now.number
    epochs.begin_anew()
    epochs.begin(0.55, Compensation.unknown())
    assert epochs.now.number == before + 2
    extractor = Extractor(PACKET)
    extracted = extract(extractor, rows(time_s, np.ones((9, 3))))
    steps = StreamTimeline().extend(time_s, extracted.usable)
    blocks = sample_blocks(extractor, extracted, steps, time_s, epochs)
    assert [(b.time_s[0], len(b), b.gap_before) for b in blocks] == [(pytest.approx(0.6), 3, True)]
