"""What the demo achieved, judged by the truth that was hidden from the daemon, and its report."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ahrsd.calibration import Affine, Estimate
from ahrsd.calibration_json import calibration_json
from ahrsd.core.core import Core
from ahrsd.demo.scene import DemoScene, live_samples
from ahrsd.heading import tilt_compensated_heading, wrapped
from ahrsd.report import EventCollector, HeadingError, KeyFigure, write_report
from ahrsd.report.summary import heading_errors, serial_of
from ahrsd.samples import Array
from ahrsd.writeback.states import State
from drivers.vn100.emulator.physics import EmulatedTruth
from drivers.vn100.registers import same

LIMIT_DEG: Final = 0.5
LIMIT_BIAS_RAD_S: Final = 3e-4
LIMIT_SIGMAS: Final = 3.0
_BEFORE_DEG: Final = 10.0  # a smaller error before would not prove much
MAG, GYRO = 23, 84  # registers
_AXES = "xyz"


@dataclass(frozen=True, slots=True, eq=False)
class DemoResult:
    """Before, after, truth.

    present, written, written_gyro: registers 23 before, 23 and 84 as the device holds them at the
    end; estimate: the one that was approved; live_*: (N,) deg, data that it has not seen
    """

    truth: EmulatedTruth
    present: Affine
    written: Affine
    written_gyro: Affine
    read_back_exact: bool
    estimate: Estimate | None
    state: str
    goal: str
    decision_sha256: str
    live_heading_deg: Array
    live_before_deg: Array
    live_after_deg: Array

    @property
    def worst_before_deg(self) -> float:
        """Worst heading error over all level headings with the registers as found."""
        return self.truth.heading_error_deg(self.present.matrix, self.present.offset)

    @property
    def worst_after_deg(self) -> float:
        """The same with the registers as the device now holds them."""
        return self.truth.heading_error_deg(self.written.matrix, self.written.offset)

    @property
    def bias_error_rad_s(self) -> Array:
        """Gyro bias error (3,) of what register 84 now removes."""
        return np.asarray(self.written_gyro.offset - self.truth.gyro_bias_rad_s)

    @property
    def bias_sigmas(self) -> Array:
        """The same (3,) in standard deviations that the estimate claimed; nan without estimate."""
        if self.estimate is None:
            return np.full(3, np.nan)
        return np.asarray(self.bias_error_rad_s / self.estimate.sigma[9:])

    def failures(self) -> list[str]:
        """What the demo promises and did not keep."""
        promises = (
            (self.state == self.goal, f"it ended in {self.state}, not in {self.goal}"),
            (self.read_back_exact, "the device does not hold what was approved"),
            (
                self.worst_before_deg > _BEFORE_DEG,
                f"the heading error before was only {self.worst_before_deg:.1f} deg",
            ),
            (
                self.worst_after_deg <= LIMIT_DEG,
                f"the heading error after is {self.worst_after_deg:.2f} deg",
            ),
            (
                bool(np.all(np.abs(self.bias_error_rad_s) <= LIMIT_BIAS_RAD_S)),
                f"the gyro bias is off by {np.max(np.abs(self.bias_error_rad_s)) * 1e3:.2f} mrad/s",
            ),
            (
                bool(np.all(np.abs(self.bias_sigmas) <= LIMIT_SIGMAS)),
                f"the gyro bias is off by {np.max(np.abs(self.bias_sigmas)):.1f} sigma",
            ),
        )
        return [text for kept, text in promises if not kept]

    @property
    def good(self) -> bool:
        """Whether the demo did what it promises."""
        return not self.failures()


def verdict(result: DemoResult) -> str:
    """One sentence."""
    if result.good:
        return (
            f"The worst heading error fell from {result.worst_before_deg:.1f} to "
            f"{result.worst_after_deg:.2f} deg; the device holds exactly what was approved."
        )
    return f"The demo did not reach its goal: {'; '.join(result.failures())}."


def figures(result: DemoResult) -> tuple[KeyFigure, ...]:
    """Before, after and limit of what matters."""
    before, after = result.truth.gyro_bias_rad_s * 1e3, result.bias_error_rad_s * 1e3
    heading = KeyFigure(
        "Worst heading error, all headings, level",
        "deg",
        result.worst_before_deg,
        result.worst_after_deg,
        LIMIT_DEG,
    )
    limit = LIMIT_BIAS_RAD_S * 1e3
    return (
        heading,
        *(
            KeyFigure(f"Gyro bias {axis}", "mrad/s", float(b), float(a), limit)
            for axis, b, a in zip(_AXES, before, after, strict=True)
        ),
    )


def lines(result: DemoResult) -> Iterator[str]:
    """The result for a person at a terminal."""
    if result.estimate is not None:
        yield from _beside_the_truth(result, result.estimate)
    before, after = result.worst_before_deg, result.worst_after_deg
    yield f"worst heading error  before {before:.2f} deg   after {after:.2f} deg   limit 0.5 deg"
    exact = "exact" if result.read_back_exact else "NOT what was approved"
    yield f"registers read back  {exact}"
    yield f"decisions            {result.decision_sha256}"
    yield ""
    yield verdict(result)


def _beside_the_truth(result: DemoResult, estimate: Estimate) -> Iterator[str]:
    truth, sigma = result.truth, estimate.sigma
    yield f"{'':22}{'hidden truth':>12}{'estimate':>12}{'1 sigma':>10}{'error':>10}{'limit':>8}"
    upper = np.triu_indices(3)
    soft = [f"soft iron {_AXES[i]}{_AXES[j]}" for i, j in zip(*upper, strict=True)]
    rows = [
        *zip(soft, truth.soft_iron[upper], estimate.soft_iron[upper], sigma[:6], [""] * 6),
        *_axes("hard iron", "mG", truth.hard_iron_gauss, estimate.hard_iron_gauss, sigma[6:9], ""),
        *_axes(
            "gyro bias",
            "mrad/s",
            truth.gyro_bias_rad_s,
            estimate.gyro_bias_rad_s,
            sigma[9:],
            f"{LIMIT_BIAS_RAD_S * 1e3:.2f}",
        ),
    ]
    for name, true, found, one, limit in rows:
        yield f"{name:22}{true:12.4f}{found:12.4f}{one:10.4f}{found - true:+10.4f}{limit:>8}"
    yield ""


_Row = tuple[str, float, float, float, str]


def _axes(name: str, unit: str, true: Array, found: Array, sigma: Array, limit: str) -> list[_Row]:
    return [
        (f"{name} {axis} [{unit}]", t * 1e3, f * 1e3, s * 1e3, limit)
        for axis, t, f, s in zip(_AXES, true, found, sigma, strict=True)
    ]


def conclude(
    truth: EmulatedTruth, registers: dict[int, tuple[float, ...]], scene: DemoScene, core: Core
) -> DemoResult:
    """Judge by the truth."""
    sent = scene.proposed
    exact = bool(sent) and all(same(n, sent[n], registers[n]) for n in sent)
    present = Affine.identity()  # the emulated device comes from the factory
    written = Affine.from_register(registers[MAG])
    true = Affine(np.asarray(np.linalg.inv(truth.soft_iron), float), truth.hard_iron_gauss)
    heading, before, after = _live_headings(scene, true, present, written)
    return DemoResult(
        truth=truth,
        present=present,
        written=written,
        written_gyro=Affine.from_register(registers[GYRO]),
        read_back_exact=exact,
        estimate=scene.approved or scene.estimate,
        state=scene.state,
        goal=State.CONFIRMED.value,
        decision_sha256=core.decisions.sha256,
        live_heading_deg=heading,
        live_before_deg=before,
        live_after_deg=after,
    )


def _live_headings(
    scene: DemoScene, true: Affine, old: Affine, new: Affine
) -> tuple[Array, Array, Array]:
    """Heading, error before and error after (deg) of the samples since the write.

    All three corrections see the same samples, so sensor noise cancels in the differences.
    """
    raw, accel = live_samples(scene)
    heading = tilt_compensated_heading(true.apply(raw), accel)
    errors = [
        np.degrees(wrapped(tilt_compensated_heading(c.apply(raw), accel) - heading))
        for c in (old, new)
    ]
    return np.degrees(heading), errors[0], errors[1]


def write_files(
    directory: Path, seed: int, result: DemoResult, scene: DemoScene, core: Core
) -> None:
    """calibration.json and report.html; the other files are there already."""
    body = calibration_json(
        "capture.mcap",
        result.estimate,
        scene.in_force or core.registers,
        heading=heading_errors(core),
        warnings=list(core.stream.warnings),
        serial=serial_of(core),
    )
    (directory / "calibration.json").write_text(json.dumps(body, indent=1) + "\n")
    _report(directory / "report.html", seed, result, scene.collector)


def _report(path: Path, seed: int, result: DemoResult, collector: EventCollector) -> None:
    truth = result.truth
    heading = HeadingError(
        result.live_heading_deg,
        result.live_before_deg,
        result.live_after_deg,
        "Live samples after the new registers were written: the approved estimate has not seen "
        "them. The error is against the emulator's hidden truth.",
        LIMIT_DEG,
    )
    report = collector.report(
        "ahrsd demo",
        {
            "hard_iron_gauss": truth.hard_iron_gauss,
            "soft_iron": truth.soft_iron,
            "gyro_bias_rad_s": truth.gyro_bias_rad_s,
        },
        verdict=verdict(result),
        good=result.good,
        summary=figures(result),
        seed=seed,
        command=f"ahrsd demo --output {path.parent.name} --seed {seed}",
        heading=heading if len(result.live_heading_deg) else None,
    )
    write_report(path, report)
