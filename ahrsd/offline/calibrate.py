"""Batch calibration: all samples of a recording in one estimate, iterated until it converges.

Byte streams, tables and captures of `ahrsd capture` go through a core that holds nothing out. In a
capture of the daemon the core must decide as it did in the run, so that each sample is
decompensated with the registers of its time; all samples then go through a separate estimator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ahrsd.config.config import Config
from ahrsd.core.estimation import Calibrator
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel
from ahrsd.events import Estimated, Event, SamplesSeen
from ahrsd.offline.replay import Replayed, replay
from ahrsd.offline.track import find_faults, without_terms
from ahrsd.recording.column_names import NO_MAP, ColumnMap
from ahrsd.recording.limits import TABLE_ROWS, on_one_thread
from ahrsd.report.summary import BatchResult


@on_one_thread
def calibrate(
    path: Path,
    config: Config,
    *,
    rate_hz: float | None = None,
    progress: Callable[[int], None] | None = None,
    model: RepairedModel | None = None,
    columns: ColumnMap = NO_MAP,
) -> BatchResult:
    """Estimate from the whole recording; nothing is held out. RecordingError as `replay`.

    model: its terms are subtracted from the readings first; AhrsdError if a term needs a column
    that the recording does not have. columns: names and units of a table.
    """
    seen: list[Event] = []
    done = replay(
        path,
        config,
        rate_hz=rate_hz,
        listeners=[seen.append],
        progress=progress,
        held_out=False,
        columns=columns,
        most_samples=TABLE_ROWS,
    )
    left: tuple[str, ...] = ()
    if model is not None:
        seen, left = without_terms(path, seen, model)
    calibrator = _calibrator_of_all_samples(done, seen, again=model is not None)
    estimate = calibrator.finish()
    if estimate is not None:
        seen.append(Estimated(done.core.at_s, done.core.at_s, estimate))
    turned = calibrator.estimator.misalignment()
    blocks = [event.block for event in seen if isinstance(event, SamplesSeen)]
    wrong, odd = find_faults(blocks)
    warnings = (
        *done.warnings,
        *(f"{name} is in the model and cannot be taken out" for name in left),
        *odd,
        *([] if calibrator.step is None else [calibrator.step.words]),
    )
    return BatchResult(
        done.recording.name,
        done.core,
        estimate,
        tuple(seen),
        warnings,
        turned,
        tuple(wrong),
        {**done.recording.header, **done.recording.facts},
    )


def _calibrator_of_all_samples(done: Replayed, seen: list[Event], *, again: bool) -> Calibrator:
    """A calibrator that has taken all samples; `again`: they differ from those of the core."""
    core = done.core
    if not done.of_daemon and not again:
        return core.calibrator
    settings = replace(core.settings.calibrator, held_out=False)
    calibrator = Calibrator(
        settings, core.calibrator.present, core.calibrator.present_gyro_bias_rad_s
    )
    for event in seen:
        if isinstance(event, SamplesSeen):
            calibrator.take(event.block)
    return calibrator
