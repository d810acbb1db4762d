"""What `diagnose` says of the real recordings, and of one with its cause taken away.

    python tests/benchmarks/diagnosis/bench_diagnose_real.py [--only WORD ...] [--out FILE.md]

Per recording: findings with confidence, values and times, what no name explains, seconds of CPU.
What is known of them independently: the current of MAG2 (-2.95, -5.18, 3.20) mG/A, about a tenth
of it on MAG; the magnets of broad/32, 34, 36 put on and taken off; the lag of 11.5 ms in every
trial of BROAD; the gyro bias of F00379 with its temperature.  It reads the recordings beside the
project.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Diagnosis, Finding
from ahrsd.diagnosis.inference.diagnose import diagnose
from ahrsd.diagnosis.track import Track
from ahrsd.diagnosis.where_and_when.locate import Located
from ahrsd.offline.diagnose import load_track

RECORDINGS = Path(__file__).parents[3] / ".." / "shared" / "recordings"
FOLDERS = ("arducopter", "broad", "repoimu", "vn100", "vn100_distorters")
#: of these the columns that a cause would show in are taken away
WITHHELD = {
    "arducopter/log171_MAG2_10hz": ("motor_current_a", "throttle", "battery_v"),
    "vn100/F00379": ("temperature_c",),
}


def correlation(track: Track, current_a: np.ndarray, course: Located) -> float:
    """Of a current with the course of an unlogged source, segments weighted by what they know."""
    edges = course.cut.edges_s
    level = np.array(
        [
            current_a[(track.time_s >= a) & (track.time_s < b)].mean()
            for a, b in itertools.pairwise(edges)
        ]
    )
    weights = 1.0 / course.deviation**2
    moment = np.cov(level, course.source, aweights=weights)
    return float(moment[0, 1] / np.sqrt(moment[0, 0] * moment[1, 1]))


def told(finding: Finding) -> str:
    values = " ".join(f"{p.value:.4g}" for p in finding.parameters)
    spans = " ".join(f"{a:.1f}-{b:.1f}" for a, b in finding.where.intervals_s[:2])
    held = finding.heldout
    against = ""
    if held is not None:
        gain, placebo = held.nll_gain_per_sample, held.placebo_gain
        against = f", held out {gain:+.4f}, moved in time {placebo:+.4f}"
    return f"{finding.effect} {finding.confidence:.2f} [{values}] at {spans}{against}"


def left(found: Diagnosis) -> str:
    one = found.unexplained
    if not one.detected or one.where is None:
        return "nothing left"
    spans = " ".join(f"{a:.1f}-{b:.1f}" for a, b in one.where.intervals_s[:3])
    follows = " ".join(f"{s.channel} {s.correlation:.2f}" for s in one.follows[:3])
    return (
        f"unknown in {one.where.frame} {one.size:.3g} {one.unit}, one source "
        f"{one.single_source_share or 0:.2f}, {one.evidence_nats or 0:.0f} nats, "
        f"{one.where.regime or ''} at {spans} {follows}"
    )


def answered(title: str, track: Track) -> tuple[Diagnosis | None, list[str]]:
    """The diagnosis and its lines, the first with the name and the CPU seconds; printed too."""
    begin = time.process_time()
    try:
        found = diagnose(track)
        said = [*map(told, found.findings), left(found)]
    except ValueError as why:
        found, said = None, [str(why)]
    lines = [f"{title} ({time.process_time() - begin:.1f} s)", *said]
    print("\n    ".join(lines), flush=True)
    return found, lines


def recording(name: str, path: Path) -> Iterator[list[str]]:
    """Lines of a recording, and again without the columns in which its cause would show."""
    track, _ = load_track(path)
    yield answered(name, track)[1]
    hidden = WITHHELD.get(name, ())
    if not hidden:
        return
    kept = {k: v for k, v in track.covariates.items() if k not in hidden}
    found, lines = answered(f"{name} without {' '.join(hidden)}", replace(track, covariates=kept))
    if found is not None and found.drawn is not None and "motor_current_a" in hidden:
        for course in found.drawn.courses:
            both = correlation(track, track.covariates["motor_current_a"], course)
            lines.append(f"course in {course.frame}: correlation with the current {both:.3f}")
            print(f"    {lines[-1]}", flush=True)
    yield lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names")
    parser.add_argument("--out", type=Path, help="the same as a table of Markdown")
    given = parser.parse_args()
    rows = ["| recording (CPU) | said |", "|---|---|"]
    for path in sorted(p for f in FOLDERS for p in (RECORDINGS / f).glob("*.csv.gz")):
        name = f"{path.parent.name}/{path.name.removesuffix('.csv.gz')}"
        if ".gps" in name or "vnraw" in name or not any(word in name for word in given.only):
            continue
        for title, *said in recording(name, path):
            rows.append(f"| {title} | {'<br>'.join(said)} |")
    if given.out:
        given.out.write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
