"""Draws the pictures of docs/guide/diagnosis.md: one simulated recording per family.

python docs/guide/examples/mismatch_pictures.py [FOLDER]      default: docs/images
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path

from ahrsd.__main__ import main as ahrsd
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track
from ahrsd.offline.diagnose import load_track
from ahrsd.report import diagnosis_page, figures

_SIZE_PX = (1000, 920)
#: picture -> effect as `ahrsd simulate` takes it, and a column to leave out
CASES: dict[str, tuple[str, str]] = {
    "sensor": ("hard_iron_step=2", ""),
    "world": ("field_gradient=3", ""),
    "gyro": ("gyro_bias_step=3", ""),
    "link": ("mag_time_lag=2", ""),
    "unknown": ("motor_current_field=3", "motor_current_a"),
}


def recording(folder: Path, effect: str, hidden: str) -> Track:
    """A simulated recording with the effect in it, without the column that is to be hidden."""
    path = folder / f"{effect.split('=', maxsplit=1)[0]}.csv"
    words = ["simulate", "mam", "--motion", "rov", "--noise-gyro", "0.5", "--seed", "7"]
    try:
        ahrsd([*words, "--effect", effect, "-o", str(path)])
    except SystemExit as ended:
        if ended.code:
            raise
    track, _ = load_track(path)
    track.covariates.pop(hidden, None)
    for name in [name for name in track.covariates if name.startswith("ref_q")]:
        del track.covariates[name]
    return track


def main() -> None:
    """Draw all of them."""
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    with tempfile.TemporaryDirectory() as name:
        for family, (effect, hidden) in CASES.items():
            found = diagnose(recording(Path(name), effect, hidden), recording=effect)
            drawn = found.drawn
            if drawn is None:
                raise SystemExit(f"{effect}: nothing to draw: {found.notes}")
            what = [one.effect for one in found.findings] or ["unknown"]
            sys.stderr.write(f"{family}: {effect}: {', '.join(what)}\n")
            path = target / f"mismatch-{family}.png"
            figures.save_png(partial(diagnosis_page.residual, found, drawn), path, *_SIZE_PX)


if __name__ == "__main__":
    main()
