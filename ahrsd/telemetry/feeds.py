"""What a share with send = "corrected" or "nmea" sends, as samples and statuses come; pure.

By which calibration its values are made (`Chooser`): what is in the device's registers, or, where a
share allows it, a candidate of ahrsd's that passed every gate for this very device with these very
registers: it is applied here then, and stays so until another one qualifies, it is written (then
the registers have it), the registers or the device are others, something is wrong with the
estimate, or the newest estimate is nearer to the registers. A gate that turns red again does not
take it back: a heading that jumps to and fro helps nobody.

The records of send = "corrected" have the schema `ahrsd.corrected/1`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import InitVar, dataclass, field, replace
from typing import Any, Final, Protocol

import numpy as np

import ahrsd
from ahrsd.calibration import Affine, Estimate
from ahrsd.core.core import Core
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array, SampleBlock
from ahrsd.sharing.nmea import (
    Tilt,
    attitude_transducers,
    has_heading,
    hdm,
    pitch_deg,
    roll_deg,
    xdr,
)
from ahrsd.stream.decompensation import Compensation
from ahrsd.telemetry.protocol import Record, line_of
from ahrsd.telemetry.words import STATES, estimator_trouble, stream_trouble
from ahrsd.writeback.composition import GYRO, MAG, Proposal, correction, heading_change_deg
from ahrsd.writeback.states import State
from drivers.vn100.registers import Values

# -- By which calibration --------------------------------------------------------------------------


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


# -- Records of send = "corrected" -----------------------------------------------------------------


SCHEMA: Final = "ahrsd.corrected/1"
ALARMS: Final = ("FAULT", "FLASH_TORN", "LOCKED")  # states of the write-back that need a person
_DIGITS = 7


def headings_deg(mag_body: Array, up_body: Array, in_use: InUse, limit_deg: float) -> Array:
    """(N,) magnetic heading in 0..360 deg; nan where it is not known to `limit_deg` (1 sigma)."""
    sigma_deg = in_use.heading_sigma_deg
    if sigma_deg is None or sigma_deg > limit_deg:
        return np.full(len(mag_body), np.nan)
    heading = np.degrees(tilt_compensated_heading(mag_body, up_body)) % 360.0
    return np.where(has_heading(up_body), heading, np.nan)


def sample_records(
    block: SampleBlock,
    mag_body: Array,
    gyro_body: Array,
    heading_deg: Array,
    in_use: InUse,
    wall_offset_s: float,
) -> list[Record]:
    """A record for each sample; `wall_offset_s` is the wall clock less the monotonic one."""
    host_s = block.host_s
    columns = zip(
        np.round(block.time_s, 6).tolist(),
        np.round(host_s, 6).tolist(),
        np.round(host_s + wall_offset_s, 6).tolist(),
        np.round(mag_body, _DIGITS).tolist(),
        np.round(gyro_body, _DIGITS).tolist(),
        np.round(heading_deg, 2).tolist(),
        strict=True,
    )
    sigma_deg = in_use.heading_sigma_deg
    return [
        {
            "record": "sample",
            "time_s": time_s,
            "host_s": host_s,
            "unix_s": unix_s,
            "mag_body_gauss": mag,
            "gyro_body_rad_s": gyro,
            "calibration": in_use.by,
            "magnetic_heading_deg": heading,
            "heading_sigma_deg": None if sigma_deg is None else round(sigma_deg, 2),
            "gap_before": block.gap_before and not number,
        }
        for number, (time_s, host_s, unix_s, mag, gyro, heading) in enumerate(columns)
    ]


def state_record(status: Mapping[str, Any], in_use: InUse, wall_offset_s: float) -> Record:
    """How the device, the calibration and its proof stand, out of a status."""
    estimate = status["estimate"] or {}
    sigma_deg = in_use.heading_sigma_deg
    return {
        "record": "state",
        "schema": SCHEMA,
        "version": ahrsd.__version__,
        "host_s": round(status["host_s"], 6),
        "unix_s": round(status["host_s"] + wall_offset_s, 6),
        "device": status["device"],
        "device_present": status["link"]["open"],
        "mode": status["mode"],
        "write_back": status["write_back"]["state"],
        "calibration": in_use.by,
        "candidate": in_use.candidate,
        "heading_sigma_deg": None if sigma_deg is None else round(sigma_deg, 2),
        "sigma_hard_iron_gauss": estimate.get("sigma_hard_iron_gauss"),
        "sigma_gyro_bias_rad_s": estimate.get("sigma_gyro_bias_rad_s"),
        "alarms": alarms(status),
    }


def alarms(status: Mapping[str, Any]) -> list[str]:
    """What makes the corrected values doubtful or missing, in sentences."""
    state = status["write_back"]["state"]
    found = [stream_trouble(status), *status["sensors"]]
    found += [STATES[state]] if state in ALARMS else []
    if status["mismatch"]["open"]:
        found.append(str(status["mismatch"]["step"]["text"]))
    if trouble := estimator_trouble(status):
        found.append(f"estimator {trouble}")
    return [text for text in found if text]


# -- The feed of a share ---------------------------------------------------------------------------


_NMEA_S = 0.1  # a heading so often
_PACE_S = {"corrected": 0.01, "nmea": 0.05}  # samples are looked for; faster costs more of a core
_OTHER_BIAS_RAD_S = 2e-3  # in 5 s half a degree of tilt


class Terms(Protocol):
    """What the configuration says of a share; see `ahrsd.config.sections.ShareSection`."""

    @property
    def send(self) -> str:
        """`corrected` or `nmea`."""

    @property
    def calibrated_by(self) -> str:
        """`qualified`, where a candidate may be applied before it is written, or `registers`."""

    @property
    def max_heading_sigma_deg(self) -> float:
        """A heading that is known less well is left out."""


class Outlet(Protocol):
    """Where the messages of a share go."""

    @property
    def share(self) -> Terms:
        """What it is for."""

    @property
    def wanted(self) -> bool:
        """Whether anybody reads, as far as that can be known."""

    def write(self, messages: Sequence[bytes], seq: int, newest: bytes) -> None:
        """Messages, the first of which has number `seq` (0: none has); `newest`: who comes later
        is told this first; empty: as before."""


class Feed:
    """Of one share."""

    def __init__(self, outlet: Outlet) -> None:
        self.outlet, terms = outlet, outlet.share
        self.pace_s = _PACE_S[terms.send]
        self._nmea = terms.send == "nmea"
        self._max_sigma_deg = terms.max_heading_sigma_deg
        self._chooser, self._tilt = Chooser(terms.calibrated_by == QUALIFIED), Tilt()
        self._bias: Array | None = None
        self._seq = 0
        self._wall_offset_s = 0.0
        self._next_s, self._heard = float("-inf"), False

    def samples(self, block: SampleBlock, core: Core) -> None:
        """New samples, each once."""
        in_use = self._chooser.choose(_known(core))
        mag, gyro, accel = in_use.vectors(block)
        up = self._levelled(block, in_use, accel)
        heading = headings_deg(mag, up, in_use, self._max_sigma_deg)
        self._heard = True
        if self._nmea:
            self._sentences(block, heading, up)
        else:
            offset_s = self._wall_offset_s
            self._records(sample_records(block, mag, gyro, heading, in_use, offset_s))

    def look(self, core: Core, status: Mapping[str, Any], wall_offset_s: float) -> None:
        """About once a second."""
        self._wall_offset_s = wall_offset_s
        if self._nmea:
            if not self._heard:  # nothing comes: a reader should not go on with an old heading
                self.outlet.write([hdm(None)], 0, b"")
            self._heard = False
            return
        in_use: InUse = self._chooser.choose(_known(core))
        self._records([state_record(status, in_use, wall_offset_s)], newest=True)

    def _levelled(self, block: SampleBlock, in_use: InUse, accel_body: Array) -> Array:
        """Up; another gyro bias makes the direction that was carried on with the old one void."""
        bias = in_use.levelling.offset
        if self._bias is None or np.linalg.norm(bias - self._bias) > _OTHER_BIAS_RAD_S:
            self._tilt, self._bias = Tilt(), bias
        rate = in_use.levelling_rate(block)
        return self._tilt.up(block.time_s, rate, accel_body, _pitch_roll(block))

    def _records(self, records: list[Record], *, newest: bool = False) -> None:
        first, self._seq = self._seq + 1, self._seq + len(records)
        lines = [line_of({**one, "seq": first + k}) for k, one in enumerate(records)]
        self.outlet.write(lines, first, lines[-1] if newest else b"")

    def _sentences(self, block: SampleBlock, heading_deg: Array, up: Array) -> None:
        temperature = block.covariates.get("temperature_c", np.full(len(block), np.nan))
        columns = [heading_deg, pitch_deg(up), roll_deg(up), temperature]
        for at_s, *row in np.column_stack([block.time_s, *columns]).tolist():
            if self._next_s - _NMEA_S <= at_s < self._next_s:  # else time ran back: a restart
                continue
            self._next_s = at_s + _NMEA_S
            heading, *rest = (value if np.isfinite(value) else None for value in row)
            self.outlet.write([hdm(heading), xdr(attitude_transducers(*rest))], 0, b"")


def _pitch_roll(block: SampleBlock) -> tuple[Array, Array] | None:
    """The device's own, where every sample has them."""
    found = [block.covariates.get(name) for name in ("pitch_rad", "roll_rad")]
    pitch, roll = found
    if pitch is None or roll is None or not np.isfinite([pitch, roll]).all():
        return None
    return pitch, roll


def _known(core: Core) -> ChoiceFacts:
    """What the choice of a calibration depends on, now."""
    session, calibrator = core.device_session, core.calibrator
    estimate = calibrator.estimate
    return ChoiceFacts(
        None if session.identity is None else session.identity.unit,
        core.registers,
        core.writeback.state,
        core.writeback.proposal,
        estimate,
        trusted=not (calibrator.step_open or core.estimation.state.failed)
        and not core.source.sensors.findings
        and (estimate is None or estimate.contradicted_s is None),
    )
