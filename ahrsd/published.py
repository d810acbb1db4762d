"""The published methods on a recording: one of them, or all beside ours in one table."""

from __future__ import annotations

import time

import numpy as np

from ahrsd.batch import BatchResult
from ahrsd.events import SamplesSeen
from ahrsd.methods import METHODS, MethodResult, calibrate_with
from ahrsd.result import calibration_json
from ahrsd.samples import Array

OURS = "magyc"


def run_published(result: BatchResult, method: str) -> MethodResult:
    """One method on the samples of a batch calibration; its failure is in the answer."""
    blocks = [event.block for event in result.events if isinstance(event, SamplesSeen)]
    world = result.core.settings.calibrator.world_field
    return calibrate_with(
        method,
        blocks,
        field_norm_gauss=None if world is None else world.total_gauss,
        field_n_gauss=None if world is None else world.field_n_gauss,
        clock=time.process_time,
    )


def published_json(result: BatchResult, found: MethodResult) -> dict[str, object]:
    """The contract's calibration.json of a published method: what it does not estimate is null.

    `registers` stays empty: these methods say nothing about their own uncertainty, and nothing is
    written to a device without it.
    """
    said = [*result.said(), *([found.reason] if found.reason else [])]
    body = calibration_json(
        result.name, None, {}, method=found.method, samples=result.samples, warnings=said
    )
    body["warnings"] = said
    body["converged"] = found.converged
    if found.soft_iron is not None:
        body["soft_iron"] = found.soft_iron.tolist()
        body["correction_matrix"] = np.linalg.inv(found.soft_iron).tolist()
    if found.hard_iron_gauss is not None:
        body["hard_iron_gauss"] = found.hard_iron_gauss.tolist()
    if found.gyro_bias_rad_s is not None:
        body["gyro_bias_rad_s"] = found.gyro_bias_rad_s.tolist()
    return body


def all_methods(result: BatchResult) -> list[MethodResult]:
    """Every published method, in the order of the table."""
    return [run_published(result, method) for method in METHODS]


def table(result: BatchResult, found: list[MethodResult]) -> list[str]:
    """One line a method: hard iron, gyro bias, spread of the corrected field, or why it failed."""
    estimate = result.estimate
    lines = [f"{'method':20}{'hard iron [mG]':>28}{'gyro bias [mrad/s]':>26}  field spread"]
    if estimate is not None:
        remark = "" if result.converged else "not converged: " + "; ".join(result.reasons())
        spread = _spread(result, estimate.soft_iron, estimate.hard_iron_gauss)
        bias = _triple(estimate.gyro_bias_rad_s, 3)
        lines.append(
            f"{OURS:20}{_triple(estimate.hard_iron_gauss, 1):>28}{bias:>26}{spread:>10}  {remark}"
        )
    for row in found:
        if row.hard_iron_gauss is None:
            lines.append(f"{row.method:20}  no answer: {row.reason}")
            continue
        bias = "-" if row.gyro_bias_rad_s is None else _triple(row.gyro_bias_rad_s, 3)
        soft = np.eye(3) if row.soft_iron is None else row.soft_iron
        spread = _spread(result, soft, row.hard_iron_gauss)
        lines.append(
            f"{row.method:20}{_triple(row.hard_iron_gauss, 1):>28}{bias:>26}{spread:>10}"
            f"  {row.reason}".rstrip()
        )
    return lines


def _triple(values: Array, digits: int) -> str:
    return ", ".join(f"{v * 1e3:+.{digits}f}" for v in values)


def _spread(result: BatchResult, soft_iron: Array, hard_iron_gauss: Array) -> str:
    """std / mean of the corrected field over the whole recording, in percent."""
    raw = np.vstack([e.block.raw_b_gauss for e in result.events if isinstance(e, SamplesSeen)])
    size = np.linalg.norm((raw - hard_iron_gauss) @ np.linalg.inv(soft_iron).T, axis=1)
    return f"{100 * float(size.std() / size.mean()):.2f} %"
