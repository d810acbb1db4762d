"""The registers to write, from an estimate of the raw sensor and the registers in force.

The estimate is of the *raw* sensor: every sample was decompensated with the registers in force when
it was taken (`stream.decompensation`). So only the scale remains to be determined::

    register 23:  C' = s A^-1,  B' = b          for any previous values of 23 and 26
    register 84:  C' = C84,     B' = w_b        the gyro's matrix is not estimated

The scale s.  Without a known field det A = 1 is a convention, not a measurement: the fit cannot
tell a strong field from a sensitive sensor. The device's present scale is kept, det C' = det C23:
unlike a ratio of mean field strengths it does not depend on the hard iron or on the data, so a
second run on the written device proposes the same. With a known field (world model), s = 1.

For an estimate of a stream that its registers compensate, C' = C2 C23 and B' = B23 + C23^-1 B2
(with register 26: C' = R^T C2 R C23, B' = B23 + C23^-1 R^T B2) is equivalent; `Affine.after`
and tests/core/test_fixed_point.py show it.

Numbers are rounded to the six digits that the device prints, so the stored values equal the printed
ones, and after a restart exactly the written values are read. Six digits are 3e-4 deg of heading.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.samples import Array
from drivers.vn100.registers import (
    RegisterValueError,
    Values,
    as_stored,
    format_command,
    register_lines,
)

MAG, ACCEL, GYRO = 23, 25, 84
MAX_CONDITION: Final = 8.0  # as gate G9 (docs/reference/gates.md), but not configurable
SCALES: Final = (0.2, 5.0)  # of a correction matrix, the cube root of its determinant; as gate G9
MAX_OFFSET_GAUSS: Final = 1.3
MAX_ACCEL_BIAS_M_S2: Final = 5.0  # half of gravity, a hundred times what the data sheet allows
MAX_GYRO_BIAS_RAD_S: Final = 0.175  # 10 deg/s, what the data sheet allows a cold sensor
HELD_WITHIN_SIGMA: Final = 0.5  # largest change along a direction that is undetermined, in sigmas
HELD_WITHIN: Final = 1e-5  # added to that, for rounding on the wire
DIGITS: Final = 6  # significant digits of a register's values

_OFFSETS: Final = {  # the offset of each register out = C (in - B): name, limit and unit
    MAG: ("hard iron", MAX_OFFSET_GAUSS, "gauss"),
    ACCEL: ("accelerometer bias", MAX_ACCEL_BIAS_M_S2, "m/s^2"),
    GYRO: ("gyro bias", MAX_GYRO_BIAS_RAD_S, "rad/s"),
}
_NAMES: Final = (
    *(f"soft iron {pair}" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")),
    *(f"hard iron {axis}" for axis in "xyz"),
    *(f"gyro bias {axis}" for axis in "xyz"),
)


class UnwritableError(ValueError):
    """The estimate must not be written to a device; the text says why, in one line."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A proposed write. `old` and `new` have the same registers: 23, 84, both or none.

    id:                  eight hex digits of a hash of the lines, typed to approve it
    lines:               the exact text that would be sent, checksum included
    heading_change_deg:  largest change of heading, level, over all headings
    gyro_change_rad_s:   length of the change of the gyro bias
    """

    id: str
    old: dict[int, Values]
    new: dict[int, Values]
    lines: tuple[str, ...]
    heading_change_deg: float
    gyro_change_rad_s: float


def compose(
    estimate: Estimate, registers: Mapping[int, Values], *, gyro_is_raw: bool = True
) -> Proposal:
    """The registers to write for `estimate`, given the ones in force.

    gyro_is_raw: False if the stream was AngularRate, from which the device's filter has subtracted
    its own, unknown bias: register 84 is not changed then. Raises UnwritableError.
    """
    present = _affine(registers, MAG)
    present_gyro = _affine(registers, GYRO)
    _refuse_unusable(estimate)
    _refuse_undetermined_changes(estimate, present, present_gyro)
    proposed = {MAG: _to_wire(MAG, correction(estimate, present))}
    if gyro_is_raw:
        proposed[GYRO] = _to_wire(GYRO, Affine(present_gyro.matrix, estimate.gyro_bias_rad_s))
    written = Affine.from_register(_floats(proposed[MAG]))
    _refuse_matrix(MAG, written.matrix)
    _refuse_offset(MAG, written.offset)
    _refuse_offset(GYRO, estimate.gyro_bias_rad_s)
    new = {n: v for n, v in proposed.items() if not _equals_present(registers[n], v)}
    lines = register_lines(new)
    _refuse_irreversible({number: registers[number] for number in new})
    return Proposal(
        id=hashlib.sha256("\n".join(lines).encode()).hexdigest()[:8],
        old={number: registers[number] for number in new},
        new=new,
        lines=lines,
        heading_change_deg=heading_change_deg(present, written, estimate) if MAG in new else 0.0,
        gyro_change_rad_s=_gyro_change(present_gyro, new),
    )


def heading_change_deg(present: Affine, proposed: Affine, estimate: Estimate) -> float:
    """Largest heading difference between two corrections over all headings, level, in degrees.

    Assumes a dip of 60 deg, as in middle latitudes, and that `proposed` is true.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    dip = np.radians(60.0)
    level = np.stack([np.cos(angle), -np.sin(angle), np.full_like(angle, np.tan(dip))], axis=1)
    strength = estimate.field_gauss * _scale(proposed, estimate) * np.cos(dip)
    seen = present.apply(proposed.undo(strength * level))
    difference = np.angle(
        np.exp(
            1j * (np.arctan2(-seen[:, 1], seen[:, 0]) - np.arctan2(np.sin(angle), np.cos(angle)))
        )
    )
    return float(np.degrees(np.max(np.abs(difference))))


def proposal_distance_deg(one: Proposal, other: Proposal, estimate: Estimate) -> float:
    """Difference of two proposals, as a change of heading."""
    if MAG not in one.new or MAG not in other.new:
        return 0.0 if MAG not in one.new and MAG not in other.new else 180.0
    first, second = (Affine.from_register(_floats(p.new[MAG])) for p in (one, other))
    return heading_change_deg(first, second, estimate)


def _scale(written: Affine, estimate: Estimate) -> float:
    """Factor of the written correction's field over that of A^-1."""
    return float(np.cbrt(np.linalg.det(written.matrix) * np.linalg.det(estimate.soft_iron)))


def correction(estimate: Estimate, present: Affine) -> Affine:
    """Register 23 for this estimate, with the scale s by the rule above, not rounded."""
    return Affine(_scaled_inverse(estimate, present), estimate.hard_iron_gauss)


def _scaled_inverse(estimate: Estimate, present: Affine) -> Array:
    inverse = np.linalg.inv(estimate.soft_iron)
    if estimate.field_known:
        return np.asarray(inverse)
    return np.asarray(inverse * np.cbrt(np.linalg.det(present.matrix) / np.linalg.det(inverse)))


def _to_wire(number: int, affine: Affine) -> Values:
    """The values as the device stores and prints them."""
    rounded = tuple(float(f"{value:.{DIGITS}g}") for value in affine.to_register())
    return as_stored(number, rounded)


def _equals_present(present: Values, proposed: Values) -> bool:
    """Whether they differ by no more than the rounding of one of them (of C: six digits near 1)."""
    difference = np.abs(np.array(_floats(present)) - np.array(_floats(proposed)))
    return bool(difference[:9].max() < 1.2e-5 and difference[9:].max() < 1e-6)


def _floats(values: Values) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _affine(registers: Mapping[int, Values], number: int) -> Affine:
    if number not in registers:
        raise UnwritableError(f"register {number} was not read: nothing can be written")
    affine = Affine.from_register(_floats(registers[number]))
    if not np.isfinite(affine.to_register()).all() or not np.linalg.det(affine.matrix) > 0.0:
        raise UnwritableError(f"register {number} holds no usable calibration: {registers[number]}")
    return affine


def _gyro_change(present: Affine, new: Mapping[int, Values]) -> float:
    if GYRO not in new:
        return 0.0
    return float(np.linalg.norm(np.array(_floats(new[GYRO])[9:]) - present.offset))


def _refuse_unusable(estimate: Estimate) -> None:
    numbers = [estimate.soft_iron, estimate.hard_iron_gauss, estimate.gyro_bias_rad_s]
    if not all(np.isfinite(part).all() for part in numbers):
        raise UnwritableError("the estimate is not finite")
    if not np.isfinite(estimate.field_gauss) or estimate.field_gauss <= 0.0:
        raise UnwritableError(f"the estimated field is {estimate.field_gauss} gauss")
    A = estimate.soft_iron
    if not np.allclose(A, A.T, rtol=0.0, atol=1e-9) or np.linalg.eigvalsh(A)[0] <= 0.0:
        raise UnwritableError("the estimated soft iron is not symmetric and positive definite")


def _refuse_undetermined_changes(estimate: Estimate, present: Affine, present_gyro: Affine) -> None:
    """Refuse changes in directions that the motion did not determine."""
    inverse = np.linalg.inv(present.matrix)
    soft_iron = 0.5 * (inverse + inverse.T) / np.cbrt(np.linalg.det(inverse))
    current = _numbers_by_name(soft_iron, present.offset, present_gyro.offset)
    estimated = _numbers_by_name(
        estimate.soft_iron, estimate.hard_iron_gauss, estimate.gyro_bias_rad_s
    )
    sigma = dict(zip(current, estimate.sigma.tolist(), strict=True))
    undetermined = {
        name for text in estimate.observability.unobservable for name in text.split(" + ")
    }
    for name in sorted(undetermined & current.keys()):
        if abs(estimated[name] - current[name]) > HELD_WITHIN_SIGMA * sigma[name] + HELD_WITHIN:
            raise UnwritableError(
                f"{name} is not determined by the motion and yet moved from {current[name]:.4f} to "
                f"{estimated[name]:.4f}"
            )


def _numbers_by_name(
    soft_iron: Array, hard_iron_gauss: Array, gyro_bias_rad_s: Array
) -> dict[str, float]:
    """The twelve parameters of an estimate by name, in the order of its covariance."""
    upper = soft_iron[np.triu_indices(3)]
    numbers = np.concatenate([upper, hard_iron_gauss, gyro_bias_rad_s])
    return dict(zip(_NAMES, numbers.tolist(), strict=True))


def _refuse_irreversible(old: Mapping[int, Values]) -> None:
    """Refuse to replace values that could not be written back: their line would be too long."""
    for number, values in old.items():
        try:
            format_command(number, values, held=True)
        except RegisterValueError as error:
            raise UnwritableError(f"the present values could not be put back: {error}") from error


def refuse_unsafe(values: Mapping[int, Values]) -> None:
    """Raise UnwritableError where a register 23, 25 or 84 exceeds the hard limits."""
    for number in values.keys() & _OFFSETS.keys():
        affine = Affine.from_register(_floats(values[number]))
        _refuse_matrix(number, affine.matrix)
        _refuse_offset(number, affine.offset)


def _refuse_matrix(number: int, matrix: Array) -> None:
    """Refuse a matrix that no sensor can need: it mirrors, flattens, or is in another unit."""
    which = f"the correction matrix of register {number}"
    if not np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0] > 0.0:  # nor where it is nan
        raise UnwritableError(
            f"{which} is not positive definite; a rotation of the axes belongs in register 26"
        )
    condition = float(np.linalg.cond(matrix))
    if condition > MAX_CONDITION:
        raise UnwritableError(f"{which} has the condition {condition:.1f}, limit {MAX_CONDITION}")
    scale = float(np.cbrt(np.linalg.det(matrix)))
    if not SCALES[0] <= scale <= SCALES[1]:
        raise UnwritableError(
            f"{which} multiplies by {scale:.3g}, limits {SCALES[0]} and {SCALES[1]}"
        )


def _refuse_offset(number: int, offset: Array) -> None:
    name, limit, unit = _OFFSETS[number]
    size = float(np.linalg.norm(offset))
    if not size <= limit:
        raise UnwritableError(f"{name} {size:.3g} {unit}, limit {limit} {unit}")
