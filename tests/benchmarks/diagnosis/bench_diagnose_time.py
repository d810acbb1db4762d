"""Processor time of the whole `ahrsd diagnose` command: 400 s at 40 Hz, whole library, one core.

    python tests/benchmarks/diagnosis/bench_diagnose_time.py [--rounds N]

Prints the median and the quartiles over recordings of several kinds, then the phases of each kind,
measured inside one process (a phase that is called by another is counted in both).
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from mismatch_trials import Trial, made

from ahrsd.diagnosis.inference import both_rates
from ahrsd.diagnosis.inference import diagnose as engine
from ahrsd.diagnosis.inference.likelihood import richest_model
from ahrsd.diagnosis.track import Track
from ahrsd.offline.diagnose import diagnose_recording
from ahrsd.recording.table import write_table

ROWS, RATE_HZ = 16_000, 40.0
KINDS = {
    "null, white": {},
    "null, red": {"noise": "red"},
    "current": {"effects": (("motor_current_field", 1.0),)},
    "gyro scale": {"effects": (("gyro_scale", 1.0),)},
    "step": {"effects": (("hard_iron_step", 1.0),)},
    "lag and gradient": {"effects": (("mag_time_lag", 1.0), ("field_gradient", 1.0))},
    "withheld current": {
        "effects": (("motor_current_field", 1.0),),
        "hidden": ("motor_current_a",),
    },
}
#: functions that are timed, in the order in which they run, and the modules that call them
PHASES = {
    **dict.fromkeys(
        ("prepare", "build_problem", "fit_null", "find_lost_turns_at_start", "find_wrong_clock"),
        engine,
    ),
    "fit_richest_model": richest_model,
    **dict.fromkeys(("search_until_stable", "search_recorded_rate"), both_rates),
    **dict.fromkeys(("find_lost_turns_given", "build_diagnosis", "diagnose_beyond_chance"), engine),
}


def written(track: Track, path: Path) -> Path:
    """The track as a table."""
    columns = {"time_s": track.time_s}
    readings = {
        "mag_{}_gauss": track.mag_b_gauss,
        "gyro_{}_rad_s": track.gyro_b_rad_s,
        "accel_{}_m_s2": track.accel_b_m_s2,
    }
    for name, values in readings.items():
        columns |= {name.format(axis): values[:, k] for k, axis in enumerate("xyz")}
    write_table(path, {**columns, **track.covariates})
    return path


def command_s(path: Path) -> float:
    """User and system seconds of the command on one core, start-up included."""

    def spent() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    before = spent()
    arguments = [sys.executable, "-m", "ahrsd", "diagnose", str(path), "--json", "-"]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL, env=environment)
    return spent() - before


def phases_s(path: Path) -> dict[str, float]:
    """Processor seconds of every phase."""
    spent: dict[str, float] = defaultdict(float)
    plain = {name: getattr(module, name) for name, module in PHASES.items()}

    def timed(name):
        def run(*arguments, **options):
            begin = time.process_time()
            try:
                return plain[name](*arguments, **options)
            finally:
                spent[name] += time.process_time() - begin

        return run

    for name, module in PHASES.items():
        setattr(module, name, timed(name))
    begin = time.process_time()
    diagnose_recording(path)
    whole = time.process_time() - begin
    for name, module in PHASES.items():
        setattr(module, name, plain[name])
    return {"in process": whole, **{name: spent[name] for name in PHASES}}


def main() -> None:
    """Make, run, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3, help="recordings of each kind")
    options = parser.parse_args()
    seconds: dict[str, list[float]] = defaultdict(list)
    phases: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.rounds):
            for kind, more in KINDS.items():
                trial = Trial(seed=400 + number, samples=ROWS, rate_hz=RATE_HZ, **more)
                path = written(made(trial).track, Path(folder) / "case.csv.gz")
                seconds[kind].append(command_s(path))
                if number == 0:
                    phases[kind] = phases_s(path)
    every = np.concatenate([*seconds.values()])
    low, middle, high = np.quantile(every, (0.25, 0.5, 0.75))
    print(f"{len(every)} recordings, {ROWS / RATE_HZ:.0f} s at {RATE_HZ:.0f} Hz: {middle:.2f} s "
          f"in the median, {low:.2f} to {high:.2f} s the middle half, {every.max():.2f} s at "
          "most")  # fmt: skip
    for kind, values in seconds.items():
        inside = ", ".join(f"{name} {s:.2f}" for name, s in phases[kind].items() if s > 0.02)
        print(f"{kind:18s} {np.median(values):5.2f} s   {inside}")


if __name__ == "__main__":
    main()
