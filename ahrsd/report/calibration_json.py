"""calibration.json and the summary of a run or replay (docs: README, "File formats")."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.writeback.composition import UnwritableError, compose
from drivers.vn100.registers import Values

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
    widened = [f"most of the heading's sigma: {estimate.widened_by}"] * bool(estimate.widened_by)
    not_yet = why_not_converged(estimate, wrong)
    said = [*warnings, *estimate.warnings, *refusal, *not_yet, *widened]
    return (
        base
        | _found(estimate, heading or HeadingErrors())
        | {
            "registers": written,
            "warnings": said,
        }
    )


def _found(estimate: Estimate, heading: HeadingErrors) -> dict[str, object]:
    """What the estimate says, in the contract's names."""
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
