"""What is done with each recording of an archive: what the commands do with one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ahrsd.fleet.row import Calibrated
from ahrsd.fleet.work import Examiner, Orders

if TYPE_CHECKING:
    from ahrsd.diagnosis.diagnosis import Diagnosis


def calibrated(path: Path, orders: Orders) -> Calibrated:
    """`ahrsd calibrate` of one recording of an archive."""
    from ahrsd.config.loading import Config
    from ahrsd.offline.calibrate import calibrate

    return calibrate(path, Config(), rate_hz=orders.rate_hz, columns=orders.columns)


def diagnosed(path: Path, orders: Orders) -> Diagnosis:
    """`ahrsd diagnose` of one recording of an archive."""
    from ahrsd.offline.diagnose import diagnose_recording

    return diagnose_recording(path, rate_hz=orders.rate_hz, columns=orders.columns)


EXAMINER = Examiner(calibrated, diagnosed)
LOADS = ("ahrsd.offline.calibrate", "ahrsd.offline.diagnose")  # slow to import
