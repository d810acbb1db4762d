"""The fixed point: a device that was written proposes no further change, whatever it held before.

The device is modelled straight from the manual (vn100-protocol.md 5.1): factory-calibrated sensor,
register 23 or 84, register 26. The estimator is replaced by the truth about the raw sensor.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ahrsd.calibration import Affine, Estimate, Observability
from ahrsd.samples import Array
from ahrsd.stream.decompensation import Compensation
from ahrsd.writeback.composition import (
    UnwritableError,
    compose,
    heading_change_deg,
    proposal_distance_deg,
)
from drivers.vn100.registers import (
    Values,
    format_command,
    format_reply,
    parse,
    register_lines,
    same,
)

DETERMINED = Observability(np.full(12, 0.01), (), 10.0)
SEEDS = range(100)


def rotation(rng: np.random.Generator) -> Array:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q @ np.diag(np.sign(np.diag(r)))
    return np.asarray(q * np.linalg.det(q))


def soft_iron(rng: np.random.Generator) -> Array:
    R = rotation(rng)
    A = R @ np.diag(rng.uniform(0.75, 1.3, 3)) @ R.T
    A = 0.5 * (A + A.T)
    return np.asarray(A / np.cbrt(np.linalg.det(A)))


def registers(rng: np.random.Generator) -> dict[int, Values]:
    """Any calibration that somebody may have left in a device, as the device prints it."""
    mag = Affine(
        (np.eye(3) + 0.15 * rng.normal(size=(3, 3))) * rng.uniform(0.8, 1.2),
        0.2 * rng.normal(size=3),
    )
    gyro = Affine(np.eye(3) + 0.01 * rng.normal(size=(3, 3)), 0.01 * rng.normal(size=3))
    values = {
        23: mag.to_register(),
        84: gyro.to_register(),
        26: tuple(rotation(rng).ravel().tolist()),
    }
    return {n: parse(n, format_reply(n, v).split(",")[1:]) for n, v in values.items()}


def truth(rng: np.random.Generator) -> Estimate:
    return Estimate(
        soft_iron=soft_iron(rng),
        hard_iron_gauss=0.25 * rng.normal(size=3),
        gyro_bias_rad_s=0.02 * rng.normal(size=3),
        field_gauss=0.48,
        field_known=False,
        covariance=np.eye(12) * 1e-6,
        noise_mag_gauss=1e-3,
        noise_gyro_rad_s=1e-3,
        misfit=1.0,
        heading_sigma_deg=0.1,
        observability=DETERMINED,
        samples=10_000,
        duration_s=300.0,
        converged=True,
    )


def field(rng: np.random.Generator, count: int = 50) -> Array:
    v = rng.normal(size=(count, 3))
    return np.asarray(0.48 * v / np.linalg.norm(v, axis=1, keepdims=True))


def device(raw: Array, held: dict[int, Values], number: int) -> Array:
    """What the device sends of the raw (N, 3) reading, vector by vector."""
    C, B = np.array(held[number][:9], float).reshape(3, 3), np.array(held[number][9:], float)
    R = np.array(held[26], float).reshape(3, 3)
    return np.array([R @ (C @ (m - B)) for m in raw])


def written(held: dict[int, Values], new: dict[int, Values]) -> dict[int, Values]:
    """The device after the write, read back: it stores f32 and prints six digits."""
    lines = {n: format_command(n, v).split(",")[1:] for n, v in new.items()}
    stored = {n: parse(n, tokens) for n, tokens in lines.items()}
    printed = {n: parse(n, format_reply(n, v).split(",")[1:]) for n, v in stored.items()}
    assert all(same(n, new[n], printed[n]) for n in new)
    return {**held, **printed}


@pytest.mark.parametrize("seed", SEEDS)
def test_no_change_is_proposed_after_a_write(seed: int) -> None:
    rng = np.random.default_rng(seed)
    held, estimate = registers(rng), truth(rng)
    raw = field(rng) @ estimate.soft_iron + estimate.hard_iron_gauss
    rates = rng.normal(size=(50, 3)) + estimate.gyro_bias_rad_s
    for turn in range(3):
        compensation = Compensation.from_registers(held)
        assert compensation.raw_mag(device(raw, held, 23), False) == pytest.approx(raw, abs=1e-12)
        assert compensation.raw_gyro(device(rates, held, 84)) == pytest.approx(rates, abs=1e-12)
        proposal = compose(estimate, held)
        if turn:
            assert proposal.new == {}
            assert (proposal.heading_change_deg, proposal.gyro_change_rad_s) == (0.0, 0.0)
        held = written(held, proposal.new)


@pytest.mark.parametrize("seed", SEEDS)
def test_output_after_a_write_is_the_true_field(seed: int) -> None:
    """Spherical, centred, rotated by register 26 only, and with the scale that the device had."""
    rng = np.random.default_rng(seed)
    held, estimate = registers(rng), truth(rng)
    h = field(rng)
    raw = h @ estimate.soft_iron + estimate.hard_iron_gauss
    after = written(held, compose(estimate, held).new)
    scale = np.cbrt(np.linalg.det(np.array(held[23][:9], float).reshape(3, 3)))
    R = np.array(held[26], float).reshape(3, 3)
    assert device(raw, after, 23) == pytest.approx(scale * h @ R.T, abs=5e-6)
    rate = rng.normal(size=(5, 3))
    C84 = np.array(held[84][:9], float).reshape(3, 3)
    out = device(rate + estimate.gyro_bias_rad_s, after, 84)
    assert out == pytest.approx(rate @ C84.T @ R.T, abs=5e-6)


@pytest.mark.parametrize("seed", range(20))
def test_composition_equals_that_of_a_fit_of_the_output(seed: int) -> None:
    """vn100-protocol.md 5.4.3: C' = R^T C2 R C1, B' = B1 + C1^-1 R^T B2."""
    rng = np.random.default_rng(seed)
    held, estimate = registers(rng), truth(rng)
    first = Affine.from_register(tuple(float(v) for v in held[23]))
    R = np.array(held[26], float).reshape(3, 3)
    new = Affine.from_register(tuple(float(v) for v in compose(estimate, held).new[23]))
    # the fit on the output that leads to the same corrected field, in the output's frame
    R_back = np.linalg.inv(R)
    C2 = R @ new.matrix @ np.linalg.inv(first.matrix) @ R_back
    B2 = R @ first.matrix @ (new.offset - first.offset)
    rotated = Affine(R_back @ C2 @ R, R_back @ B2)
    assert rotated.after(first).to_register() == pytest.approx(new.to_register(), abs=1e-12)


def test_repeated_write_changes_nothing() -> None:
    """C is set and never multiplied, so that the same estimate written again changes nothing."""
    rng = np.random.default_rng(5)
    held, estimate = registers(rng), truth(rng)
    new = compose(estimate, held).new
    assert set(new) == {23, 84}
    again = written(written(held, new), new)
    moved = replace(estimate, hard_iron_gauss=estimate.hard_iron_gauss + 0.01)
    for number, values in compose(moved, again).new.items():
        assert number == 23
        B = np.array(values[9:], float)
        assert pytest.approx(moved.hard_iron_gauss, abs=1e-6) == B
        assert np.array(values[:9]) == pytest.approx(np.array(new[23][:9], float), abs=2e-5)


def test_proposal_is_deterministic_and_its_id_is_derived_from_its_text() -> None:
    rng = np.random.default_rng(6)
    held, estimate = registers(rng), truth(rng)
    one, two = compose(estimate, held), compose(estimate, held)
    assert one == two
    assert one.lines == register_lines(one.new)
    assert [line[:9] for line in one.lines] == ["$VNWRG,23", "$VNWRG,84"]
    moved = replace(estimate, hard_iron_gauss=estimate.hard_iron_gauss + 1e-3)
    assert compose(moved, held).id != one.id
    assert len(one.id) == 8


def test_checksum_of_the_protocol_example() -> None:
    """vn100-protocol.md 5.2."""
    values = (1.02, 0.01, 0.0, 0.01, 0.98, 0.0, 0.0, 0.0, 1.01, 0.05, -0.03, 0.1)
    assert register_lines({23: values}) == (
        "$VNWRG,23,1.02,0.01,0,0.01,0.98,0,0,0,1.01,0.05,-0.03,0.1*6F",
    )


def test_register_84_is_unchanged_when_the_rate_is_compensated() -> None:
    rng = np.random.default_rng(7)
    held, estimate = registers(rng), truth(rng)
    proposal = compose(estimate, held, gyro_is_raw=False)
    assert set(proposal.new) == set(proposal.old) == {23}
    assert proposal.gyro_change_rad_s == 0.0


def test_known_field_sets_the_scale() -> None:
    rng = np.random.default_rng(8)
    held = registers(rng)
    estimate = replace(truth(rng), soft_iron=1.1 * soft_iron(rng), field_known=True)
    C = np.array(compose(estimate, held).new[23][:9], float).reshape(3, 3)
    assert np.linalg.det(C) == pytest.approx(1.1**-3, rel=1e-5)
    assert pytest.approx(np.eye(3), abs=1e-5) == C @ estimate.soft_iron


def test_heading_change_of_a_known_hard_iron() -> None:
    """0.024 G across a horizontal 0.24 G turns the heading by up to asin(0.1)."""
    rng = np.random.default_rng(9)
    estimate = replace(truth(rng), soft_iron=np.eye(3))
    shifted = Affine(np.eye(3), np.array([0.024, 0.0, 0.0]))
    change = heading_change_deg(Affine.identity(), shifted, estimate)
    assert change == pytest.approx(np.degrees(np.arcsin(0.1)), abs=0.05)
    assert heading_change_deg(shifted, shifted, estimate) == pytest.approx(0.0, abs=1e-9)


def test_distance_of_proposals_is_in_degrees_of_heading() -> None:
    rng = np.random.default_rng(10)
    held, estimate = registers(rng), truth(rng)
    one = compose(estimate, held)
    east = np.array([0.0, 0.01, 0.0])
    other = compose(replace(estimate, hard_iron_gauss=estimate.hard_iron_gauss + east), held)
    assert proposal_distance_deg(one, one, estimate) == pytest.approx(0.0, abs=1e-6)
    assert 1.0 < proposal_distance_deg(one, other, estimate) < 6.0


BAD: dict[str, dict[str, Any]] = {
    "not finite": {"hard_iron_gauss": np.array([0.0, np.nan, 0.0])},
    "field is": {"field_gauss": 0.0},
    "not symmetric": {"soft_iron": np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])},
    "positive definite": {"soft_iron": np.diag([1.0, -1.0, -1.0])},
    "condition": {"soft_iron": np.diag([3.0, 1.0, 1.0 / 3.0])},
    "hard iron 1.5": {"hard_iron_gauss": np.array([1.5, 0.0, 0.0])},
    "gyro bias": {"gyro_bias_rad_s": np.array([0.3, 0.0, 0.0])},
}


@pytest.mark.parametrize("text", BAD)
def test_unwritable_estimate_is_refused(text: str) -> None:
    rng = np.random.default_rng(11)
    held = registers(rng)
    with pytest.raises(UnwritableError, match=text):
        compose(replace(truth(rng), **BAD[text]), held)


@pytest.mark.parametrize(
    "held",
    [
        {},
        {23: Affine.identity().to_register()},
        {23: (0.0,) * 12, 84: Affine.identity().to_register()},
        {23: (float("nan"),) * 12, 84: Affine.identity().to_register()},
    ],
)
def test_unusable_registers_are_refused(held: dict[int, Values]) -> None:
    with pytest.raises(UnwritableError, match=r"register (23|84)"):
        compose(truth(np.random.default_rng(12)), held)


def test_values_that_could_not_be_written_back_are_not_replaced() -> None:
    dust = (1.0, *(-3.02119e-30,) * 3, 1.0, *(-3.02119e-30,) * 3, 1.0, 0.1, 0.2, 0.3)
    held: dict[int, Values] = {23: dust, 84: Affine.identity().to_register()}
    with pytest.raises(UnwritableError, match="the present values could not be put back"):
        compose(truth(np.random.default_rng(12)), held)


def test_undetermined_direction_must_keep_the_value_of_the_device() -> None:
    rng = np.random.default_rng(13)
    identity = Affine.identity().to_register()
    held: dict[int, Values] = {23: identity, 84: identity}
    blind = Observability(np.linspace(0.1, 1.0, 12), ("hard iron z + soft iron zz",), 0.1)
    covariance = np.diag([0.3**2] * 6 + [0.1**2] * 3 + [1e-6] * 3)
    sure = replace(
        truth(rng),
        soft_iron=np.eye(3),
        hard_iron_gauss=np.array([0.3, 0.3, 0.0]),
        observability=blind,
        covariance=covariance,
    )
    assert compose(sure, held).new[23][11] == 0.0
    moved = replace(sure, hard_iron_gauss=np.array([0.3, 0.3, 0.06]))
    with pytest.raises(UnwritableError, match="hard iron z is not determined"):
        compose(moved, held)
