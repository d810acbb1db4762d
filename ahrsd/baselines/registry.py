"""Which methods there are, what each needs and estimates, and one way to call them all.

Methods beside each other on one recording: a row each, and the halves it is judged on. Held out:
the recording is cut into ten pieces in time; what was fitted on the even ones corrects the odd ones
and the other way round. The spread of both together, std |h| / mean |h| ([R] 4.4), is what the
calibration is worth on readings that it has not seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ahrsd.baselines import attitude_independent, graph_methods
from ahrsd.baselines.data import (
    MethodData,
    MethodError,
    MethodFit,
    MethodResult,
    MethodSettings,
    agrees_with_gyro,
    check_motion,
    corrected,
    usable,
)
from ahrsd.samples import Array, SampleBlock

# -- Methods beside each other ---------------------------------------------------------------------


PIECES = 10
Halves = tuple[list[SampleBlock], list[SampleBlock]]


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonRow:
    """What one method says.

    Without an answer hard_iron_gauss is None and `reason` says why; with one, `reason` is a remark
    or empty. spread, held_out: std over mean of the corrected field, on everything and held out;
    None where there is no answer. converged: whether the method itself calls it determined.
    """

    method: str
    soft_iron: Array | None
    hard_iron_gauss: Array | None
    gyro_bias_rad_s: Array | None
    converged: bool
    reason: str
    spread: float | None = None
    held_out: float | None = None


def halves(blocks: Sequence[SampleBlock]) -> Halves:
    """Even and odd pieces of the samples; each piece begins after a gap, nothing is bridged."""
    count = sum(len(block) for block in blocks)
    edges = np.linspace(0, count, PIECES + 1).astype(int)
    parts: Halves = ([], [])
    row = 0
    for block in blocks:
        ends = [e - row for e in edges if row < e < row + len(block)]
        begins = [0, *ends]
        for a, b in zip(begins, [*ends, len(block)], strict=True):
            piece = int(np.searchsorted(edges, row + a, side="right")) - 1
            new = row + a in edges
            parts[piece % 2].append(
                _cut(block, slice(a, b), gap=new or (a == 0 and block.gap_before))
            )
        row += len(block)
    return parts


def _cut(block: SampleBlock, rows: slice, *, gap: bool) -> SampleBlock:
    part = block.part(rows, gap_before=gap)
    if not (gap and len(part)):
        return part
    dt_s = part.dt_s.copy()
    dt_s[0] = np.nan
    return replace(part, dt_s=dt_s)


def spread_of(
    sets: Sequence[Sequence[SampleBlock]], answers: Sequence[tuple[Array | None, Array]]
) -> float:
    """Spread of |h| over all of the sets, each corrected by its own (A or None, b).

    The scale of a soft iron is a gauge, so each set is divided by its own mean first.
    """
    sizes = []
    for blocks, (soft_iron, hard_iron) in zip(sets, answers, strict=True):
        raw = np.vstack([block.raw_b_gauss for block in blocks])
        size = np.linalg.norm(corrected(raw, soft_iron, hard_iron), axis=1)
        sizes.append(size / size.mean())
    return float(np.std(np.concatenate(sizes)))


# -- The methods -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Method:
    """A row of METHODS.

    needs: beyond the magnetometer: "gyro", "field norm", "field", "attitude"
    estimates: "soft iron", "hard iron", "gyro bias", or "scale" (a soft iron alpha I)
    axes: principal directions in which the field's readings must vary
    """

    function: Callable[[MethodData, MethodSettings], MethodFit]
    needs: tuple[str, ...]
    estimates: tuple[str, ...]
    source: str
    axes: int = 3


_ALL = ("soft iron", "hard iron", "gyro bias")
_IRON = ("soft iron", "hard iron")
_HARD = ("hard iron",)

METHODS: dict[str, Method] = {
    "magical-ls": Method(
        graph_methods.estimate_magical_ls, ("gyro",), _IRON, "[R] least squares, bias known"
    ),
    "magical-nls": Method(
        graph_methods.estimate_magical_nls, ("gyro",), _ALL, "[R] nonlinear least squares"
    ),
    "magical-bfg": Method(
        graph_methods.estimate_magical_bfg, ("gyro",), _ALL, "[R] batch factor graph"
    ),
    "magical-ifg": Method(
        graph_methods.estimate_magical_ifg, ("gyro",), _ALL, "[R] incremental factor graph"
    ),
    "magyc-bfg": Method(
        graph_methods.estimate_magyc_bfg, ("gyro",), _ALL, "[M] batch factor graph"
    ),
    "magyc-ifg": Method(
        graph_methods.estimate_magyc_ifg, ("gyro",), _ALL, "[M] incremental factor graph"
    ),
    "twostep": Method(
        attitude_independent.estimate_twostep, ("field norm",), _IRON, "Alonso & Shuster 2002"
    ),
    "ellipsoid": Method(
        attitude_independent.estimate_ellipsoid, (), _IRON, "Fang et al. 2011, [R] appendix A"
    ),
    "magfactor3": Method(
        graph_methods.estimate_magfactor3,
        ("attitude", "field"),
        ("scale", "hard iron"),
        "GTSAM",
        axes=2,
    ),
    "tls": Method(
        attitude_independent.estimate_tls,
        ("field norm",),
        _HARD,
        "Crassidis & Cheng, [L] 2.25-2.32",
    ),
    "np": Method(attitude_independent.estimate_np, ("field norm",), _HARD, "[L] 2.33-2.37"),
    "fnp": Method(attitude_independent.estimate_fnp, ("field norm",), _HARD, "[L] 2.38-2.55"),
    "np-uncertain-field": Method(
        attitude_independent.estimate_np_uncertain_field, ("field norm",), _HARD, "[L] 2.56-2.73"
    ),
}


def run(
    method: str,
    data: MethodData,
    settings: MethodSettings | None = None,
    clock: Callable[[], float] | None = None,
) -> MethodResult:
    """One method on these samples; what it cannot do is in the result's `reason`.

    clock: seconds of processor time, if it shall be measured.  KeyError for an unknown method.
    """
    row = METHODS[method]
    began = clock() if clock else float("nan")
    try:
        chosen = settings or MethodSettings()
        usable(data)
        remark = check_motion(data, chosen, row.axes)
        fit = row.function(data, chosen)
        _finite(fit)
        if "gyro" in row.needs:
            agrees_with_gyro(data, fit)
    except (MethodError, np.linalg.LinAlgError) as error:
        seconds = clock() - began if clock else began
        return MethodResult(method, None, None, None, False, _reason(error), 0, seconds)
    seconds = clock() - began if clock else began
    return MethodResult(
        method,
        fit.soft_iron,
        fit.hard_iron_gauss,
        fit.gyro_bias_rad_s,
        True,
        "; ".join(text for text in (fit.note, remark) if text),
        fit.iterations,
        seconds,
    )


def _reason(error: MethodError | np.linalg.LinAlgError) -> str:
    if isinstance(error, np.linalg.LinAlgError):
        return f"the motion does not determine the answer ({error})"
    return str(error)


def _finite(fit: MethodFit) -> None:
    for part in (fit.soft_iron, fit.hard_iron_gauss, fit.gyro_bias_rad_s):
        if part is not None and not np.isfinite(part).all():
            raise MethodError("diverged: the answer is not finite")


def joined(
    blocks: Sequence[SampleBlock],
    *,
    R_nb: Array | None = None,
    field_n_gauss: Array | None = None,
    field_norm_gauss: float | Array | None = None,
) -> MethodData:
    """Blocks as one: a new segment wherever a gap is or a step is unknown.

    R_nb (N, 3, 3) and a field_norm_gauss of (N,) belong to all the samples, block after block.
    MethodError where there is no sample.
    """
    kept = [block for block in blocks if len(block)]
    if not kept:
        raise MethodError("no samples")
    dt = np.concatenate([block.dt_s for block in kept])
    begins = np.cumsum([0, *(len(block) for block in kept[:-1])])
    gaps = {int(k) for k, block in zip(begins, kept, strict=True) if block.gap_before}
    starts = sorted({0, *gaps, *np.flatnonzero(np.isnan(dt)).tolist()})
    return MethodData(
        time_s=np.concatenate([block.time_s for block in kept]),
        dt_s=dt,
        raw_b_gauss=np.vstack([block.raw_b_gauss for block in kept]),
        gyro_b_rad_s=np.vstack([block.gyro_b_rad_s for block in kept]),
        starts=tuple(starts),
        accel_b_m_s2=np.vstack([block.accel_b_m_s2 for block in kept]),
        R_nb=R_nb,
        field_n_gauss=field_n_gauss,
        field_norm_gauss=field_norm_gauss,
    )


def calibrate_with(
    method: str,
    blocks: Sequence[SampleBlock],
    *,
    settings: MethodSettings | None = None,
    R_nb: Array | None = None,
    field_n_gauss: Array | None = None,
    field_norm_gauss: float | Array | None = None,
    clock: Callable[[], float] | None = None,
) -> MethodResult:
    """One method on a recording's blocks; as `joined` and `run`."""
    try:
        data = joined(
            blocks, R_nb=R_nb, field_n_gauss=field_n_gauss, field_norm_gauss=field_norm_gauss
        )
    except MethodError as error:
        return MethodResult(method, None, None, None, False, str(error), 0, float("nan"))
    return run(method, data, settings, clock)
