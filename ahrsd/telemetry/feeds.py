"""What a share with send = "corrected" or "nmea" sends, as samples and statuses come; pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ahrsd.core.core import Core
from ahrsd.samples import Array, SampleBlock
from ahrsd.sharing.nmea import attitude, hdm, xdr
from ahrsd.sharing.tilt import Tilt, pitch_deg, roll_deg
from ahrsd.telemetry.calibration_in_use import QUALIFIED, ChoiceFacts, Chooser, InUse
from ahrsd.telemetry.corrected import headings_deg, sample_records, state_record
from ahrsd.telemetry.protocol import line_of
from ahrsd.telemetry.records import Record

_NMEA_S = 0.1  # a heading so often
_PACE_S = {"corrected": 0.01, "nmea": 0.05}  # samples are looked for; faster costs more of a core
_OTHER_BIAS_RAD_S = 2e-3  # in 5 s half a degree of tilt


class Terms(Protocol):
    """What the configuration says of a share; see `ahrsd.config.sections.ShareSection`."""

    @property
    def send(self) -> str:
        """`corrected` or `nmea`."""

    @property
    def calibration(self) -> str:
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
        self._chooser, self._tilt = Chooser(terms.calibration == QUALIFIED), Tilt()
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
            self.outlet.write([hdm(heading), xdr(attitude(*rest))], 0, b"")


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
        trusted=not (calibrator.step_open or core.estimator.failed or core.sensors.findings)
        and (estimate is None or estimate.contradicted_s is None),
    )
