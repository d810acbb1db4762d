"""From what a message says to what the sensor read: the user's own calibration taken back out.

Every output of a VN-100, the "uncompensated" ones too, has passed the user calibration and the
reference frame rotation (vn100-protocol.md 5.1, 5.3)::

    u = R C (m - B)       m: sensor frame; C, B: register 23, 84 or 25; R: register 26
    m = C^-1 R^-1 u + B   which is what this module computes (R as printed has six digits: not R^T)

A compensated field has also passed the on-board estimator where register 44 applies it (Output 3):
u' = C47 (u - B47). A compensated rate has lost the filter's own bias estimate, which no register
shows; it is used, and flagged, and its bias must not be written anywhere.

`RegisterEpochs` remembers which registers were in force when, `Extractor` finds the columns of one
message layout, `sample_blocks` joins both into what the estimator takes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ahrsd.calibration import Affine
from ahrsd.samples import Array, SampleBlock, known_force
from ahrsd.stream.device_clock import Mask, TimelineSteps
from drivers.vn100.messages import Layout

MAG, ACCEL, GYRO, ROTATION, HSI_CONTROL, HSI_RESULT = 23, 25, 84, 26, 44, 47
HSI_APPLIED: Final = 3  # register 44, field Output
EPOCHS_KEPT: Final = 64
SATURATED_MAG_OR_GYRO: Final = 0b1_1100_0111  # SensSat bits 0-2 and 6-8
IMPOSSIBLE_GAUSS: Final = (
    50.0  # the sensor ends at 2.5, corrections are at most some times as large
)
IMPOSSIBLE_RAD_S: Final = 5000.0  # it ends at 35; degrees per second are another matter
AXES: Final = ("x", "y", "z")

RegisterValues = Mapping[int, tuple[float | int | str, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Compensation:
    """What the device applies between its sensors and the wire.

    rotation: (3, 3) register 26, sensor frame to the user's frame
    hsi:      register 47 where register 44 applies it to compensated fields, else None
    warnings: what had to be assumed, one sentence each
    """

    mag: Affine
    gyro: Affine
    accel: Affine
    rotation: Array
    hsi: Affine | None = None
    warnings: tuple[str, ...] = ()

    @staticmethod
    def unknown() -> Compensation:
        """Nobody read the registers: identity, with the warning that says what that means."""
        return Compensation(
            Affine.identity(),
            Affine.identity(),
            Affine.identity(),
            np.eye(3),
            warnings=(
                "the device's registers are not known: the stream was taken as it is, so the "
                "result is a correction on top of whatever registers 23, 26 and 84 held then",
            ),
        )

    @staticmethod
    def from_registers(values: RegisterValues) -> Compensation:
        """From register values by number; what is missing counts as identity and is named."""
        warnings: list[str] = []
        mag, gyro, accel = (_affine(values, number, warnings) for number in (MAG, GYRO, ACCEL))
        rotation = np.eye(3)
        if ROTATION in values:
            rotation = np.array(values[ROTATION], dtype=np.float64).reshape(3, 3)
        else:
            warnings.append("register 26 was not read: no reference frame rotation was assumed")
        return Compensation(mag, gyro, accel, rotation, _hsi(values, warnings), tuple(warnings))

    def raw_mag(self, output_gauss: Array, compensated: bool) -> Array:
        """(N, 3) field as the sensor read it; `compensated` where the HSI acted on it."""
        if compensated and self.hsi is not None:
            output_gauss = self.hsi.undo(output_gauss)
        return self.mag.undo(self._unrotated(output_gauss))

    def raw_gyro(self, output_rad_s: Array) -> Array:
        """(N, 3) rate as the sensor read it (plus the filter's bias where compensated)."""
        return self.gyro.undo(self._unrotated(output_rad_s))

    def raw_accel(self, output_m_s2: Array) -> Array:
        """(N, 3) specific force as the sensor read it."""
        return self.accel.undo(self._unrotated(output_m_s2))

    def _unrotated(self, vectors: Array) -> Array:
        return Affine(self.rotation, np.zeros(3)).undo(vectors) if self._rotated else vectors

    @property
    def _rotated(self) -> bool:
        return not np.array_equal(self.rotation, np.eye(3))


def _affine(values: RegisterValues, number: int, warnings: list[str]) -> Affine:
    if number in values:
        return Affine.from_register(tuple(float(value) for value in values[number]))
    if number != ACCEL:  # the specific force only helps to see tilt and stillness
        warnings.append(f"register {number} was not read: it was taken as identity")
    return Affine.identity()


def _hsi(values: RegisterValues, warnings: list[str]) -> Affine | None:
    control = values.get(HSI_CONTROL)
    if control is None or control[1] != HSI_APPLIED:
        return None
    if HSI_RESULT not in values:
        warnings.append("the on-board estimator is applied (register 44) and 47 was not read")
        return None
    warnings.append(
        "the on-board estimator is applied (register 44 Output 3): compensated fields are a moving "
        "target; use UncompMag or VNIMU, or set register 44 to 0,1,5"
    )
    return _affine(values, HSI_RESULT, warnings)


@dataclass(frozen=True, slots=True, eq=False)
class RegisterEpoch:
    """A stretch of time with the same registers; compensation None: nobody knows which."""

    number: int
    since_s: float
    compensation: Compensation | None


def user_compensation(registers: RegisterValues) -> tuple[Affine, Array]:
    """What register 23 does to the field, and the gyro bias (3,) that register 84 takes off."""
    return _affine(registers, MAG, []), _affine(registers, GYRO, []).offset


class RegisterEpochs:
    """Which registers were in force when, on the host's time line; the newest 64 are kept."""

    def __init__(self) -> None:
        self._epochs = [RegisterEpoch(0, -np.inf, Compensation.unknown())]

    @property
    def now(self) -> RegisterEpoch:
        """The newest epoch."""
        return self._epochs[-1]

    def begin(self, since_s: float, compensation: Compensation | None) -> RegisterEpoch:
        """From `since_s` on these registers act; None: they are being changed.

        A time before the newest epoch's is moved up to it: time does not run back.
        """
        since_s = max(since_s, self.now.since_s)
        epoch = RegisterEpoch(self.now.number + 1, since_s, compensation)
        self._epochs = [*self._epochs, epoch][-EPOCHS_KEPT:]
        return epoch

    def begin_anew(self) -> None:
        """Nobody knows the registers, at whatever instant: the device may be another one."""
        self._epochs = [RegisterEpoch(self.now.number + 1, -np.inf, None)]

    def split(
        self, host_s: Array, arrived_s: Array | None = None
    ) -> list[tuple[slice, RegisterEpoch]]:
        """Runs of (N,) ascending instants with one epoch each.

        arrived_s: (N,) when they were heard. Where the registers changed between an instant and its
        arrival, nobody knows on which side of the change it was (the instant is an estimate), so
        its epoch is one whose registers are unknown.
        """
        starts = np.array([epoch.since_s for epoch in self._epochs[1:]], dtype=np.float64)
        index = np.searchsorted(starts, host_s, side="right")
        if arrived_s is not None:
            index[np.searchsorted(starts, arrived_s, side="right") != index] = -1
        edges = [0, *(np.flatnonzero(np.diff(index)) + 1).tolist(), len(host_s)]
        return [
            (slice(a, b), self._epochs[k] if (k := int(index[a])) >= 0 else self._unsure)
            for a, b in pairwise(edges)
            if b > a
        ]

    @property
    def _unsure(self) -> RegisterEpoch:
        return RegisterEpoch(self.now.number, self.now.since_s, None)


class MissingQuantityError(ValueError):
    """A message without a field or without a rate: nothing can be calibrated from it."""

    def __init__(self, layout: Layout, quantity: str) -> None:
        held = ", ".join(column.name for column in layout.columns) or "no values"
        super().__init__(
            f"{layout.name} carries no {quantity} (it has {held}); configure VNYMR or VNIMU "
            "(register 6: 14 or 19), or a binary output with UncompMag and UncompGyro "
            "(register 75, IMU group)"
        )
        self.layout = layout.name
        self.quantity = quantity


@dataclass(frozen=True, slots=True, eq=False)
class Extracted:
    """N messages of one layout as arrays, still as the device sent them.

    time_s is None where the layout has no TimeStartup; usable (N,) is false for samples that are
    saturated, not finite, or beyond anything that the sensors can read.
    """

    time_s: Array | None
    mag_gauss: Array
    gyro_rad_s: Array
    accel_m_s2: Array
    usable: Mask
    covariates: dict[str, Array] = field(default_factory=dict)


class Extractor:
    """Finds the columns of one layout once, then turns lists of value tuples into arrays.

    Raises MissingQuantityError where the layout has no magnetometer or no gyroscope.
    mag_compensated, gyro_compensated: whether only the compensated quantity is in the layout.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        names = [column.name for column in layout.columns]
        self.mag_compensated, mag = self._vector(names, "mag", "gauss", "magnetometer")
        self.gyro_compensated, gyro = self._vector(names, "gyro", "rad_s", "gyroscope")
        self._mag, self._gyro = mag, gyro
        self._accel = _find(names, "uncomp_accel", "m_s2") or _find(names, "accel", "m_s2")
        self._time = names.index("time_startup_s") if "time_startup_s" in names else None
        self._saturation = names.index("sens_sat") if "sens_sat" in names else None
        used = {*mag, *gyro, *(self._accel or ()), self._time, self._saturation}
        self._rest = [(name, k) for k, name in enumerate(names) if k not in used]

    def _vector(
        self, names: list[str], quantity: str, unit: str, sensor: str
    ) -> tuple[bool, list[int]]:
        raw = _find(names, f"uncomp_{quantity}", unit)
        columns = raw or _find(names, quantity, unit)
        if columns is None:
            raise MissingQuantityError(self.layout, sensor)
        return raw is None, columns

    @property
    def has_time(self) -> bool:
        """Whether the device's own time is in the layout."""
        return self._time is not None

    @property
    def quantities(self) -> tuple[bool, bool]:
        """Samples of two layouts that differ in this must not be mixed."""
        return self.mag_compensated, self.gyro_compensated

    def better_than(self, other: Extractor) -> bool:
        """Uncompensated before compensated, with device time before without."""
        own, others = ((not e.mag_compensated, e.has_time) for e in (self, other))
        return own > others

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader of results from this layout must know."""
        name, texts = self.layout.name, []
        if self.mag_compensated:
            texts.append(
                f"{name} carries the compensated field: what the on-board estimator does is in it"
            )
        if self.gyro_compensated:
            texts.append(
                f"{name} carries the compensated rate: the device's filter has already removed its "
                "own bias estimate, so the gyro bias found here is only what remains of it"
            )
        return tuple(texts)

    def extract_table(self, table: Array) -> Extracted:
        """Quantities of N messages of this layout, a row (columns,) each."""
        mag, gyro = table[:, self._mag], table[:, self._gyro]
        with np.errstate(invalid="ignore"):  # nan is not possible either
            possible = (np.abs(mag) < IMPOSSIBLE_GAUSS) & (np.abs(gyro) < IMPOSSIBLE_RAD_S)
        usable = np.asarray(possible.all(axis=1), dtype=np.bool_)
        if self._saturation is not None:
            flags = np.nan_to_num(table[:, self._saturation]).astype(np.int64)
            usable = np.logical_and(usable, (flags & SATURATED_MAG_OR_GYRO) == 0)
        nothing = np.full((len(table), 3), np.nan)
        return Extracted(
            time_s=None if self._time is None else table[:, self._time],
            mag_gauss=mag,
            gyro_rad_s=gyro,
            accel_m_s2=nothing if self._accel is None else known_force(table[:, self._accel]),
            usable=usable,
            covariates={name: table[:, k] for name, k in self._rest},
        )


def _find(names: list[str], quantity: str, unit: str) -> list[int] | None:
    wanted = [f"{quantity}_{axis}_{unit}" for axis in AXES]
    return [names.index(name) for name in wanted] if all(w in names for w in wanted) else None


def sample_blocks(
    extractor: Extractor,
    extracted: Extracted,
    steps: TimelineSteps,
    host_s: Array,
    epochs: RegisterEpochs,
    arrived_s: Array | None = None,
) -> list[SampleBlock]:
    """Raw samples, cut at gaps and where the registers changed; unusable ones are left out.

    steps: what `StreamTimeline.extend(time_s, extracted.usable)` said; host_s: (N,) the same
    instants on the host's clock; arrived_s: see `RegisterEpochs.split`. Samples of an epoch whose
    registers nobody knows are dropped, and what follows them begins anew.
    """
    blocks: list[SampleBlock] = []
    kept = np.flatnonzero(steps.keep)
    after_unknown = False
    arrived_s = None if arrived_s is None else arrived_s[kept]
    for run, epoch in epochs.split(host_s[kept], arrived_s):
        if epoch.compensation is None:
            after_unknown = True
            continue
        rows = kept[run]
        starts = np.flatnonzero(steps.first[rows])
        edges = sorted({0, *starts.tolist(), len(rows)})
        for a, b in pairwise(edges):
            part, gap = rows[a:b], bool(steps.first[rows[a]]) or after_unknown
            after_unknown = False
            raw = _raw(extractor, extracted, part, epoch.compensation)
            dt_s = steps.dt_s[part]
            if gap:
                dt_s[0] = np.nan
            blocks.append(
                SampleBlock(
                    steps.time_s[part],
                    dt_s,
                    host_s[part],
                    *raw,
                    covariates={name: c[part] for name, c in extracted.covariates.items()},
                    epoch=epoch.number,
                    gap_before=gap,
                )
            )
    return blocks


def _raw(
    extractor: Extractor, extracted: Extracted, rows: NDArray[np.intp], compensation: Compensation
) -> tuple[Array, Array, Array]:
    """Field, rate and specific force of these rows as the sensor read them."""
    return (
        compensation.raw_mag(extracted.mag_gauss[rows], extractor.mag_compensated),
        compensation.raw_gyro(extracted.gyro_rad_s[rows]),
        compensation.raw_accel(extracted.accel_m_s2[rows]),
    )
