"""calibration.json, written and read back (docs: README, "File formats").

The units are in its names. A file that is not what it says is refused in one line; a number that
cannot be in its unit is called out rather than used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.errors import AhrsdError
from ahrsd.samples import Array
from ahrsd.writeback.composition import UnwritableError, compose
from drivers.vn100.registers import Values

# -- Written ---------------------------------------------------------------------------------------


MAG, GYRO = 23, 84
#: 1-sigma of the heading beyond which it is not known: any heading is within some 100 deg
UNKNOWN_HEADING_DEG = 45.0
_HOPELESS_DEG = 5.0  # worst heading sigma beyond which the estimator calls nothing converged
_SIGMAS = ("soft_iron", "hard_iron_gauss", "gyro_bias_rad_s")


@dataclass(frozen=True, slots=True)
class HeadingErrors:
    """Heading errors in deg on data that the estimate has not seen; None where nobody can say."""

    before_rms: float | None = None
    after_rms: float | None = None


def calibration_json(
    recording: str,
    estimate: Estimate | None,
    registers: Mapping[int, Values],
    *,
    method: str = "magyc",
    samples: int = 0,
    gyro_is_raw: bool = True,
    heading: HeadingErrors | None = None,
    warnings: Sequence[str] = (),
    serial: int | None = None,
    wrong: Sequence[str] = (),
) -> dict[str, object]:
    """The contract's `ahrsd.calibration/1`; `registers` are those in force, empty for unknown.

    serial: of the device that the recording is of, where it says so; with `registers_in_force` it
    is what `registers write --from` asks before it writes
    """
    base: dict[str, object] = {
        "schema": "ahrsd.calibration/1",
        "method": method,
        "recording": recording,
        "samples": samples,
        "device": None if serial is None else {"serial": serial},
        "registers_in_force": {str(n): list(registers[n]) for n in (MAG, GYRO) if n in registers},
    }
    if estimate is None:
        return base | _nothing(warnings)
    written, refusal = _registers(estimate, registers, gyro_is_raw)
    most = "" if wrong else estimate.widened_by
    widened = [f"most of the heading's sigma: {most}"] * bool(most)
    not_yet = why_not_converged(estimate, wrong)
    all_warnings = [*warnings, *estimate.warnings, *refusal, *not_yet, *widened]
    return (
        base
        | _found(estimate, heading or HeadingErrors(), most)
        | {
            "registers": written,
            "warnings": list(dict.fromkeys(all_warnings)),
        }
    )


def _found(estimate: Estimate, heading: HeadingErrors, most: str) -> dict[str, object]:
    """What the estimate says, in the contract's names; most: what dominates the heading's sigma."""
    parts = np.split(estimate.sigma, [6, 9])
    return {
        "samples": estimate.samples,
        "duration_s": _number(estimate.duration_s),
        "converged": estimate.converged,
        "correction_matrix": estimate.correction.matrix.tolist(),
        "soft_iron": estimate.soft_iron.tolist(),
        "hard_iron_gauss": estimate.hard_iron_gauss.tolist(),
        "gyro_bias_rad_s": estimate.gyro_bias_rad_s.tolist(),
        "field_gauss": _number(estimate.field_gauss),
        "field_known": estimate.field_known,
        "standard_deviation": {
            name: part.tolist() for name, part in zip(_SIGMAS, parts, strict=True)
        },
        "noise": {
            "mag_gauss": _number(estimate.noise_mag_gauss),
            "gyro_rad_s": _number(estimate.noise_gyro_rad_s),
            "misfit": _number(estimate.misfit),
        },
        "heading_error_deg": {
            "expected_worst": _number(estimate.heading_sigma_deg),
            "before_rms": heading.before_rms,
            "after_rms": heading.after_rms,
        },
        "mag_lag_s": _number(estimate.mag_lag_s),
        "observability": {
            "score": _number(estimate.observability.score),
            "unobservable": list(estimate.observability.unobservable),
            "prior_ratio": estimate.observability.prior_ratio.tolist(),
            "dominated_by": most or None,
        },
    }


def heading_words(sigma_deg: float) -> str:
    """How well the heading is known, as a clause behind "heading"."""
    if not sigma_deg < UNKNOWN_HEADING_DEG:
        return "not known"
    return f"known to {sigma_deg:.2f} deg (1 sigma, worst direction)"


def why_not_converged(estimate: Estimate | None, wrong: Sequence[str] = ()) -> list[str]:
    """Reasons, one clause each; empty where it has converged.

    wrong: what of the recording cannot be as it is; then that is why, whatever followed from it
    """
    if estimate is None:
        return ["too few samples for an estimate"]
    if estimate.converged:
        return []
    if wrong:
        return [f"not converged: {words}: put this right and calibrate again" for words in wrong]
    if scale := estimate.gyro_misscaled:
        return [
            f"not converged: the field turns {abs(scale):.0%} {'more' if scale > 0 else 'less'} "
            "than the gyro says: the rate in Hz, the times of samples, the gyro's unit or the axes "
            "of one of the two sensors are wrong (`ahrsd diagnose` on the recording says which)"
        ]
    if (since_s := estimate.contradicted_s) is not None:
        return [
            f"not converged: from about {since_s:.0f} s on the field contradicts what was before: "
            "a magnet came near or the iron changed; turn on, away from steel and magnets"
        ]
    if blind := estimate.observability.unobservable:
        return [f"this motion does not determine: {'; '.join(blind)}"]
    if estimate.heading_sigma_deg >= UNKNOWN_HEADING_DEG:
        return ["not converged: the heading is not known; turn further, about more than one axis"]
    if estimate.heading_sigma_deg >= _HOPELESS_DEG:
        return [
            f"not converged: headings would be known to {estimate.heading_sigma_deg:.1f} deg only "
            f"(limit {_HOPELESS_DEG:.0f}); turn further, about more than one axis"
        ]
    return [
        "not converged: the data still allow more than one answer; turn further, about more than "
        "one axis, away from steel and magnets"
    ]


def _registers(
    estimate: Estimate, registers: Mapping[int, Values], gyro_is_raw: bool
) -> tuple[dict[str, list[object]], list[str]]:
    """What would be written, by register number; nothing and the reason where nothing may be."""
    if not estimate.converged:
        return {}, []
    identity = Affine.identity().to_register()
    present = {MAG: identity, GYRO: identity, **registers}
    try:
        proposal = compose(estimate, present, gyro_is_raw=gyro_is_raw)
    except UnwritableError as error:
        return {}, [str(error)]
    return {str(number): list(values) for number, values in proposal.new.items()}, []


def _nothing(warnings: Sequence[str]) -> dict[str, object]:
    keys = (
        "duration_s",
        "correction_matrix",
        "soft_iron",
        "hard_iron_gauss",
        "gyro_bias_rad_s",
        "field_gauss",
    )
    return {
        **dict.fromkeys(keys),
        "converged": False,
        "field_known": False,
        "standard_deviation": dict.fromkeys(_SIGMAS),
        "heading_error_deg": {"expected_worst": None, "before_rms": None, "after_rms": None},
        "observability": {},
        "registers": {},
        "warnings": [*warnings, *why_not_converged(None)],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


# -- Read back -------------------------------------------------------------------------------------


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
