"""calibration.json read back, and refused in one line where it is not what it says.

The units are in its names; a number that cannot be in its unit is called out rather than used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ahrsd.calibration import Affine
from ahrsd.errors import AhrsdError
from ahrsd.samples import Array

SCHEMA = "ahrsd.calibration/1"
SCHEMA_OF_MANY = "ahrsd.calibrations/1"
_MOST_GAUSS = 10.0  # no VN-100 reads that much
_MOST_BIAS_RAD_S = 1.0  # 57 deg/s is no bias
_MOST_DISTORTED = 1e3  # condition number of C
_INVERSE = 1e-3  # C A against the identity: both are printed


class CalibrationFileError(AhrsdError):
    """A calibration.json that cannot be used: file, what, remedy."""

    def __init__(self, source: str, what: str, remedy: str) -> None:
        super().__init__(f"{source}: {what}; {remedy}")
        self.what = what


@dataclass(frozen=True, slots=True, eq=False)
class StoredCalibration:
    """What calibration.json says. correction: h = C (m - b), C the identity where only b is known.

    gyro_bias_rad_s: (3,) or None; recording: name of what it was made from; remarks: what a reader
    of results must know
    """

    source: str
    method: str
    recording: str
    converged: bool
    correction: Affine
    gyro_bias_rad_s: Array | None = None
    field_known: bool = False
    remarks: tuple[str, ...] = ()


def parse_calibration(body: object, source: str, method: str | None = None) -> StoredCalibration:
    """The calibration in a decoded calibration.json, or of `method` where the file holds several.

    Raises CalibrationFileError.
    """
    entry = _chosen(body, source, method)
    name = str(entry.get("method", "unknown"))
    if entry.get("hard_iron_gauss") is None:
        said = entry.get("warnings")
        reason = f": {said[-1]}" if isinstance(said, list) and said else ""
        raise CalibrationFileError(
            source, f"holds no answer of {name}{reason}", "calibrate from another recording"
        )
    hard_iron = _numbers(entry, "hard_iron_gauss", (3,), source)
    _small(source, "hard_iron_gauss", hard_iron, _MOST_GAUSS, "gauss (not mG, uT or nT)")
    bias = None
    if entry.get("gyro_bias_rad_s") is not None:
        bias = _numbers(entry, "gyro_bias_rad_s", (3,), source)
        _small(source, "gyro_bias_rad_s", bias, _MOST_BIAS_RAD_S, "rad/s (not deg/s)")
    if entry.get("field_gauss") is not None:
        field = _numbers(entry, "field_gauss", (), source)
        _small(source, "field_gauss", field, _MOST_GAUSS, "gauss (not mG, uT or nT)")
    converged = entry.get("converged")
    if not isinstance(converged, bool):
        raise CalibrationFileError(source, "converged is not true or false", "write it again")
    matrix, remarks = _matrix(entry, source)
    if not converged:
        remarks.append("the calibration says that it has not converged; it is judged all the same")
    return StoredCalibration(
        source=source,
        method=name,
        recording=str(entry.get("recording", "")),
        converged=converged,
        correction=Affine(matrix, hard_iron),
        gyro_bias_rad_s=bias,
        field_known=entry.get("field_known") is True,
        remarks=tuple(remarks),
    )


def parse_calibrations(body: object, source: str) -> tuple[list[StoredCalibration], dict[str, str]]:
    """Every calibration of a file of several, and by method why one has no answer.

    Raises CalibrationFileError where the file holds none at all, or one alone.
    """
    entries = body.get("calibrations") if isinstance(body, dict) else None
    if not isinstance(entries, list) or not entries:
        raise CalibrationFileError(
            source, "holds no list of calibrations", "leave `--method all` out"
        )
    found: list[StoredCalibration] = []
    without: dict[str, str] = {}
    for name in (str(entry.get("method")) for entry in entries if isinstance(entry, dict)):
        try:
            found.append(parse_calibration(body, source, name))
        except CalibrationFileError as error:
            without[name] = error.what.removeprefix(f"holds no answer of {name}: ")
    if not found:
        raise CalibrationFileError(source, "no method has an answer", "use another recording")
    return found, without


def _chosen(body: object, source: str, method: str | None) -> Mapping[str, object]:
    remedy = "write it with `ahrsd calibrate RECORDING --json FILE`"
    if not isinstance(body, dict):
        raise CalibrationFileError(source, "is no calibration.json: no JSON object", remedy)
    schema = body.get("schema")
    entries = body.get("calibrations")
    if schema == SCHEMA_OF_MANY and isinstance(entries, list):
        known = {str(e.get("method")): e for e in entries if isinstance(e, dict)}
        if method in known:
            return known[method]
        what = "holds several calibrations" if method is None else f"holds none of {method}"
        raise CalibrationFileError(source, what, f"choose one with --method: {', '.join(known)}")
    if schema != SCHEMA:
        raise CalibrationFileError(source, f"its schema is {schema!r}, not {SCHEMA!r}", remedy)
    if method is not None and body.get("method") != method:
        raise CalibrationFileError(
            source, f"is of {body.get('method')}, not of {method}", "leave --method out"
        )
    return body


def _matrix(entry: Mapping[str, object], source: str) -> tuple[Array, list[str]]:
    """C (3, 3), and a remark where it is not in the file."""
    if entry.get("correction_matrix") is None:
        return np.eye(3), ["the calibration has no soft iron: only the hard iron is corrected"]
    matrix = _numbers(entry, "correction_matrix", (3, 3), source)
    if np.linalg.det(matrix) <= 0 or np.linalg.cond(matrix) > _MOST_DISTORTED:
        raise CalibrationFileError(
            source, "correction_matrix is no correction: singular, or it mirrors", "calibrate again"
        )
    if entry.get("soft_iron") is not None:
        product = matrix @ _numbers(entry, "soft_iron", (3, 3), source)
        if np.max(np.abs(product - np.eye(3))) > _INVERSE:
            raise CalibrationFileError(
                source, "correction_matrix is not the inverse of soft_iron", "write the file again"
            )
    return matrix, []


def _numbers(entry: Mapping[str, object], key: str, shape: tuple[int, ...], source: str) -> Array:
    try:
        value = np.array(entry.get(key), dtype=np.float64)
    except (TypeError, ValueError):
        value = np.array([])
    if value.shape != shape or not np.isfinite(value).all():
        size = " x ".join(map(str, shape)) or "one"
        raise CalibrationFileError(source, f"{key} is not {size} finite numbers", "write it again")
    return value


def _small(source: str, key: str, value: Array, limit: float, unit: str) -> None:
    size = float(np.linalg.norm(value))
    if size > limit:
        raise CalibrationFileError(
            source, f"{key} has size {size:.4g}, more than {limit:g}", f"it must be in {unit}"
        )
