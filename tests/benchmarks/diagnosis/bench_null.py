"""Whether `simulate` and `diagnose` agree with themselves: every scenario, motion and noise.

    python tests/benchmarks/diagnosis/bench_null.py
        [--seeds N] [--first N] [--seconds S] [--noises K]
                                          [--short] [--out FILE.md]

Runs `ahrsd simulate SCENARIO --motion M --seed N ...` and `ahrsd diagnose` on what it wrote, as a
user does, and counts the recordings that are told to differ from their own simulation; there should
be none.  --noises K: the first K of the noises, the default's first; all by default.  --short: one
seed of the default and of the three that are hardest, slow motion.
Some four seconds of CPU a recording, twice to five times that where the gyro is the louder sensor.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections import Counter
from pathlib import Path

from ahrsd.cli.recordings import simulate
from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.offline.diagnose import diagnose_recording

SCENARIOS, MOTIONS = ("wam", "mam", "lam"), ("slow", "rov")
#: mG and mrad/s per sample: the default; noise that hides slow turns, no noise of the magnetometer,
#: a gyro that is far louder than it; a quiet gyro, the theses' loud sensors, a quiet compass
HARDEST = ((50.0, 50.0), (0.0, 5.0), (0.1, 50.0))
NOISES = ((1.0, 5.0), *HARDEST, (1.0, 0.5), (10.0, 10.0), (0.1, 2.0))


def recording(
    folder: Path, scenario: str, motion: str, seed: int, noise: tuple[float, float], seconds: float
) -> Path:
    """What `ahrsd simulate` writes with these options."""
    path = folder / f"{scenario}_{motion}_{seed}.csv.gz"
    options = {"--motion": motion, "--seed": seed, "--seconds": seconds}
    options |= {"--noise-mag": noise[0], "--noise-gyro": noise[1], "-o": path}
    words = [str(word) for pair in options.items() for word in pair]
    try:
        simulate.command.main([scenario, *words], standalone_mode=False)
    except SystemExit as done:
        if done.code:
            raise
    return path


def told(found: Diagnosis) -> str:
    """What is wrong by the answer, in a few words; empty where the two agree."""
    words = [one.effect for one in found.findings]
    left = found.unexplained
    if left.detected and left.where is not None:
        words.append(f"unknown in {left.where.frame} ({left.evidence_nats:.0f} nats)")
    if found.mismatch and not words:
        words.append("mismatch without a finding")
    return ", ".join(words)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=400.0)
    parser.add_argument("--noises", type=int, default=len(NOISES))
    parser.add_argument("--short", action="store_true", help="one seed, slow, the hardest noises")
    parser.add_argument("--out", type=Path, help="the counts as a table of Markdown")
    given = parser.parse_args()
    count: Counter[tuple[str, str, tuple[float, float]]] = Counter()
    false: Counter[tuple[str, str, tuple[float, float]]] = Counter()
    seeds = range(given.first, given.first + given.seeds)
    motions, noises = MOTIONS, NOISES[: given.noises]
    if given.short:
        seeds, motions, noises = range(given.first, given.first + 1), ("slow",), NOISES[:4]
    kinds = itertools.product(SCENARIOS, motions, noises)
    for seed, kind in itertools.product(seeds, list(kinds)):
        scenario, motion, noise = kind
        begin = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            path = recording(Path(folder), scenario, motion, seed, noise, given.seconds)
            found = diagnose_recording(path)
        count[kind] += 1
        false[kind] += found.mismatch
        if found.mismatch or found.failed_checks:
            words = told(found) or f"agrees, fails {', '.join(found.failed_checks)}"
            took_s = time.process_time() - begin
            print(f"{scenario} {motion} seed {seed} {noise}: {words} ({took_s:.1f} s)", flush=True)
    rows = ["| scenario | motion | noise (mG, mrad/s) | recordings | told to differ |"]
    rows.append("|---|---|---|---|---|")
    rows += [
        f"| {scenario} | {motion} | {mag:g}, {gyro:g} | {count[kind]} | {false[kind]} |"
        for kind in count
        for scenario, motion, (mag, gyro) in [kind]
    ]
    rows.append(f"| all | | | {sum(count.values())} | {sum(false.values())} |")
    print("\n".join(rows))
    if given.out:
        given.out.write_text("\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
