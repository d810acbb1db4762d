"""The published methods on a recording: one of them, or all of them and ours in one table."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from ahrsd.baselines import METHODS, MethodResult, calibrate_with
from ahrsd.baselines.data import stuck
from ahrsd.baselines.registry import ComparisonRow, halves, spread_of
from ahrsd.calibration_json import calibration_json
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.events import SamplesSeen
from ahrsd.report.summary import BatchResult
from ahrsd.samples import Array, SampleBlock

OURS = "magyc"
Answer = tuple[Array | None, Array]  # A and b
_YPR = (("vn_yaw_deg", "vn_pitch_deg", "vn_roll_deg"), ("yaw_rad", "pitch_rad", "roll_rad"))


def run_published(result: BatchResult, method: str) -> MethodResult:
    """Run one method on the samples of a batch calibration; the result holds a failure."""
    return _run_method(result, method, _blocks(result))


def published_json(
    result: BatchResult, found: MethodResult, row: ComparisonRow | None = None
) -> dict[str, object]:
    """calibration.json of a published method; null for what it does not estimate.

    `registers` stays empty: these methods do not report their uncertainty, and without it nothing
    is written to a device. With `row`, the spreads of the table are included.
    """
    warnings = [*result.all_warnings(), *([found.reason] if found.reason else [])]
    body = calibration_json(
        result.name, None, {}, method=found.method, samples=result.samples, warnings=warnings
    )
    body["warnings"] = warnings
    body["converged"] = found.converged
    if blocks := _blocks(result):
        body["duration_s"] = float(blocks[-1].time_s[-1] - blocks[0].time_s[0])
    if found.soft_iron is not None:
        body["soft_iron"] = found.soft_iron.tolist()
        body["correction_matrix"] = np.linalg.inv(found.soft_iron).tolist()
    if found.hard_iron_gauss is not None:
        body["hard_iron_gauss"] = found.hard_iron_gauss.tolist()
    if found.gyro_bias_rad_s is not None:
        body["gyro_bias_rad_s"] = found.gyro_bias_rad_s.tolist()
    return body if row is None else with_spread(body, row)


def with_spread(body: dict[str, object], row: ComparisonRow) -> dict[str, object]:
    """calibration.json with the spreads of the corrected field added."""
    return body | {"field_spread": {"everything": row.spread, "held_out": row.held_out}}


def run_all_methods(result: BatchResult) -> list[MethodResult]:
    """Run every published method, in the order of the table."""
    return [run_published(result, method) for method in METHODS]


def method_row(result: BatchResult, found: MethodResult, *, held_out: bool = True) -> ComparisonRow:
    """The table's row of a published method."""
    if found.hard_iron_gauss is None:
        return ComparisonRow(found.method, None, None, None, False, found.reason)
    answers: list[Answer] = [(found.soft_iron, found.hard_iron_gauss)]
    spread = spread_of([_blocks(result)], answers)
    held_out_spread = _held_out_spread(result, found.method) if held_out else None
    reason = found.reason
    if held_out and held_out_spread is None:
        reason = "; ".join(text for text in (reason, "no answer on half of the data") if text)
    return ComparisonRow(
        found.method,
        found.soft_iron,
        found.hard_iron_gauss,
        found.gyro_bias_rad_s,
        found.converged,
        reason,
        spread,
        held_out_spread,
    )


def our_row(result: BatchResult, *, held_out: bool = True) -> ComparisonRow:
    """The table's row of our method."""
    estimate = result.estimate
    reasons = "; ".join(result.reasons())
    if estimate is None:
        return ComparisonRow(OURS, None, None, None, False, reasons)
    if words := describe_saturation(result):
        return ComparisonRow(OURS, None, None, None, False, words)
    answers: list[Answer] = [(estimate.soft_iron, estimate.hard_iron_gauss)]
    return ComparisonRow(
        OURS,
        estimate.soft_iron,
        estimate.hard_iron_gauss,
        estimate.gyro_bias_rad_s,
        result.converged,
        "" if result.converged else f"not converged: {reasons.removeprefix('not converged: ')}",
        spread_of([_blocks(result)], answers),
        _held_out_spread(result, OURS) if held_out else None,
    )


def describe_saturation(result: BatchResult) -> str:
    """Which axis is saturated, if the calibration converged all the same; "" if none.

    Clipped readings fit some other ellipsoid, so neither spread nor sigma shows the error.
    """
    if not result.converged:
        return ""
    return stuck(np.vstack([block.raw_b_gauss for block in _blocks(result)]))


def format_table(rows: Sequence[ComparisonRow]) -> list[str]:
    """One line per method: hard iron, gyro bias, spreads of the field, or its failure."""
    head = f"{'method':20}{'hard iron [mG]':>28}{'gyro bias [mrad/s]':>26}"
    lines = [f"{head}{'spread':>9}{'held out':>10}"]
    for row in rows:
        if row.hard_iron_gauss is None:
            lines.append(f"{row.method:20}  no answer: {row.reason}")
            continue
        bias = "-" if row.gyro_bias_rad_s is None else _vector_text(row.gyro_bias_rad_s, 3)
        lines.append(
            f"{row.method:20}{_vector_text(row.hard_iron_gauss, 1):>28}{bias:>26}"
            f"{_percentage(row.spread):>9}{_percentage(row.held_out):>10}  {row.reason}".rstrip()
        )
    return lines


def _vector_text(values: Array, digits: int) -> str:
    return ", ".join(f"{v * 1e3:+.{digits}f}" for v in values)


def _percentage(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} %"


def _blocks(result: BatchResult) -> list[SampleBlock]:
    return [event.block for event in result.events if isinstance(event, SamplesSeen)]


def _run_method(result: BatchResult, method: str, blocks: list[SampleBlock]) -> MethodResult:
    world = result.core.settings.calibrator.world_field
    field_n = None
    if world is not None:  # the device's yaw is magnetic: its north has no declination
        level = float(np.hypot(*world.field_n_gauss[:2]))
        field_n = np.array([level, 0.0, world.field_n_gauss[2]])
    return calibrate_with(
        method,
        blocks,
        R_nb=_device_attitude(blocks),
        field_norm_gauss=None if world is None else world.total_gauss,
        field_n_gauss=field_n,
        clock=time.process_time,
    )


def _device_attitude(blocks: list[SampleBlock]) -> Array | None:
    """The device's own attitude R_nb (N, 3, 3), used by magfactor3 only; None if missing."""
    for names in _YPR:
        if all(name in block.covariates for block in blocks for name in names):
            angles = [np.column_stack([b.covariates[name] for name in names]) for b in blocks]
            ypr = np.vstack(angles) if angles else np.empty((0, 3))
            if not len(ypr) or not np.isfinite(ypr).all():
                return None
            return Rotation.from_euler("ZYX", ypr, degrees=names[0].endswith("_deg")).as_matrix()
    return None


def _held_out_spread(result: BatchResult, method: str) -> float | None:
    """Held-out spread of a method; None if one half of the data gives no answer."""
    parts = halves(_blocks(result))
    answers: list[Answer] = []
    for part in parts:
        answer = (
            _own_answer(result, part) if method == OURS else _published_answer(result, method, part)
        )
        if answer is None:
            return None
        answers.append(answer)
    return spread_of([parts[1], parts[0]], answers)


def _published_answer(result: BatchResult, method: str, blocks: list[SampleBlock]) -> Answer | None:
    found = _run_method(result, method, blocks)
    hard_iron = found.hard_iron_gauss
    return None if hard_iron is None else (found.soft_iron, hard_iron)


def _own_answer(result: BatchResult, blocks: list[SampleBlock]) -> Answer | None:
    calibrator = result.core.calibrator
    estimator = Estimator(
        calibrator.settings.estimator,
        calibrator.present,
        calibrator.present_gyro_bias_rad_s,
        at_once=WHOLE,
    )
    for block in blocks:
        estimator.add(block)
    estimate = estimator.finish()
    return None if estimate is None else (estimate.soft_iron, estimate.hard_iron_gauss)
