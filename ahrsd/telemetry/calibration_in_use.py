"""By which calibration the corrected values of a share are made, and how well its heading is known.

What is in the device's registers, or, where a share allows it, a candidate of ahrsd's that passed
every gate for this very device with these very registers: it is applied here then, and stays so
until another one qualifies, it is written (then the registers have it), the registers or the device
are others, something is wrong with the estimate, or the newest estimate is nearer to the registers.
A gate that turns red again does not take it back: a heading that jumps to and fro helps nobody.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, field, replace

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.samples import Array, SampleBlock
from ahrsd.stream.decompensation import Compensation
from ahrsd.writeback.composition import GYRO, MAG, Proposal, correction, heading_change_deg
from ahrsd.writeback.states import State
from drivers.vn100.registers import Values

REGISTERS, QUALIFIED = "registers", "qualified"
_COMPENSATING = (23, 25, 26, 84)
_AGAINST = frozenset({State.ROLLED_BACK, State.LOCKED, State.FAULT, State.FLASH_TORN})


@dataclass(frozen=True, slots=True, eq=False)
class ChoiceFacts:
    """What the choice depends on.

    unit:    who the device is; None where nobody asked it
    trusted: nothing is known to be wrong with the estimate or with a sensor
    """

    unit: object
    registers: Mapping[int, Values]
    state: State
    proposal: Proposal | None
    estimate: Estimate | None
    trusted: bool


@dataclass(frozen=True, slots=True, eq=False)
class InUse:
    """A calibration: raw samples of the sensor into the frame of the device's outputs (body).

    by:                `REGISTERS` or `QUALIFIED`; candidate: its id
    heading_sigma_deg: 1 sigma of the worst heading by it; None: not known
    levelling:         the gyro's calibration with the bias that is known best, whatever is in the
                       register, for what integrates its rate
    """

    mag: Affine
    gyro: Affine
    accel: Affine
    rotation: Array
    by: str = REGISTERS
    candidate: str | None = None
    heading_sigma_deg: float | None = None
    levelling: Affine = field(init=False)
    gyro_bias_rad_s: InitVar[Array | None] = None

    def __post_init__(self, gyro_bias_rad_s: Array | None) -> None:
        bias = self.gyro.offset if gyro_bias_rad_s is None else gyro_bias_rad_s
        object.__setattr__(self, "levelling", Affine(self.gyro.matrix, bias))

    def vectors(self, block: SampleBlock) -> tuple[Array, Array, Array]:
        """Field in gauss, rate in rad/s and specific force in m/s^2 of the block, (N, 3) each."""
        pairs = (
            (self.mag, block.raw_b_gauss),
            (self.gyro, block.gyro_b_rad_s),
            (self.accel, block.accel_b_m_s2),
        )
        mag, gyro, accel = (stage.apply(raw) @ self.rotation.T for stage, raw in pairs)
        return mag, gyro, accel

    def levelling_rate(self, block: SampleBlock) -> Array:
        """(N, 3) rate in rad/s for what integrates it."""
        return np.asarray(self.levelling.apply(block.gyro_b_rad_s) @ self.rotation.T)


@dataclass(slots=True)
class Chooser:
    """Chooses for one share; `qualified`: whether a candidate may be applied here."""

    qualified: bool
    _basis: object = None
    _kept: Proposal | None = None
    _made_from: tuple[object, ...] = ()
    _made: InUse | None = field(default=None)

    def choose(self, known: ChoiceFacts) -> InUse:
        """The calibration of what comes now."""
        basis = known.unit, tuple(known.registers.get(number) for number in _COMPENSATING)
        if basis != self._basis:
            self._basis, self._kept = basis, None
        if known.state in _AGAINST or not known.trusted:
            self._kept = None
        elif self.qualified and known.state is State.QUALIFIED and known.proposal is not None:
            self._kept = known.proposal
        made_from = self._kept, self._basis, known.estimate, known.trusted
        if self._made is None or any(
            one is not other for one, other in zip(made_from, self._made_from, strict=True)
        ):
            self._made, self._made_from = self._make(known), made_from
        return self._made

    def _make(self, known: ChoiceFacts) -> InUse:
        device = Compensation.from_registers(known.registers)
        registers = InUse(device.mag, device.gyro, device.accel, device.rotation)
        estimate = known.estimate if known.trusted else None
        found = _with_sigma(registers, estimate)
        if self._kept is None:
            return found
        new = {number: _affine(values) for number, values in self._kept.new.items()}
        mag, gyro = new.get(MAG, device.mag), new.get(GYRO, device.gyro)
        ours = _with_sigma(
            InUse(mag, gyro, device.accel, device.rotation, QUALIFIED, self._kept.id), estimate
        )
        if _further(ours, found):
            self._kept = None
            return found
        return ours


def _further(one: InUse, other: InUse) -> bool:
    if one.heading_sigma_deg is None or other.heading_sigma_deg is None:
        return False
    return one.heading_sigma_deg > other.heading_sigma_deg


def _with_sigma(calibration: InUse, estimate: Estimate | None) -> InUse:
    """With how well the heading by it is known: how far it is from the estimate, and that one's."""
    if estimate is None or not estimate.converged or not math.isfinite(estimate.heading_sigma_deg):
        return calibration
    true = correction(estimate, calibration.mag)
    off_deg = heading_change_deg(calibration.mag, true, estimate)
    sigma_deg = math.hypot(off_deg, estimate.heading_sigma_deg)
    return replace(
        calibration,
        heading_sigma_deg=sigma_deg if math.isfinite(sigma_deg) else None,
        gyro_bias_rad_s=estimate.gyro_bias_rad_s,
    )


def _affine(values: Values) -> Affine:
    return Affine.from_register(tuple(float(value) for value in values))
