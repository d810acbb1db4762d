"""Which methods there are, what each needs and estimates, and one way to call them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ahrsd.baselines import ellipsoid, magfactor3, magical, magyc, norm_preserving, twostep
from ahrsd.baselines.checks import agrees_with_gyro, check_motion, usable
from ahrsd.baselines.data import MethodData, MethodError, MethodFit, MethodResult, MethodSettings
from ahrsd.samples import Array, SampleBlock


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
    "magical-ls": Method(magical.estimate_ls, ("gyro",), _IRON, "[R] least squares, bias known"),
    "magical-nls": Method(magical.estimate_nls, ("gyro",), _ALL, "[R] nonlinear least squares"),
    "magical-bfg": Method(magical.estimate_bfg, ("gyro",), _ALL, "[R] batch factor graph"),
    "magical-ifg": Method(magical.estimate_ifg, ("gyro",), _ALL, "[R] incremental factor graph"),
    "magyc-bfg": Method(magyc.estimate_bfg, ("gyro",), _ALL, "[M] batch factor graph"),
    "magyc-ifg": Method(magyc.estimate_ifg, ("gyro",), _ALL, "[M] incremental factor graph"),
    "twostep": Method(twostep.estimate, ("field norm",), _IRON, "Alonso & Shuster 2002"),
    "ellipsoid": Method(ellipsoid.estimate, (), _IRON, "Fang et al. 2011, [R] appendix A"),
    "magfactor3": Method(
        magfactor3.estimate, ("attitude", "field"), ("scale", "hard iron"), "GTSAM", axes=2
    ),
    "tls": Method(
        norm_preserving.estimate_tls, ("field norm",), _HARD, "Crassidis & Cheng, [L] 2.25-2.32"
    ),
    "np": Method(norm_preserving.estimate_np, ("field norm",), _HARD, "[L] 2.33-2.37"),
    "fnp": Method(norm_preserving.estimate_fnp, ("field norm",), _HARD, "[L] 2.38-2.55"),
    "np-uncertain-field": Method(
        norm_preserving.estimate_np_uncertain_field, ("field norm",), _HARD, "[L] 2.56-2.73"
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
