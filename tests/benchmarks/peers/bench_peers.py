"""Ours beside the authors' package magyc 1.0.0, on the same samples in the same run.

    python tests/benchmarks/peers/bench_peers.py --cache DIR --runs 10
    python tests/benchmarks/peers/bench_peers.py --cache DIR --runs 100,30,10 --time \\
        --output docs/validation/peers

The package runs in an environment of its own (made in the cache folder; its numpy and ours cannot
share one), as released and with its one wrong Jacobian column corrected, each with and without the
Savitzky-Golay filter of the authors' notebooks; Fang's ellipsoid has its sign mended. The peers'
answers are kept in the cache, ours too as long as the estimator's source is the same: a stopped
run goes on. Processor times of peers come from the peers' process, without its imports.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
import venv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from peers_figure import write_peers_figure
from peers_table import best_peers, set_lines, time_lines, verdict_lines

from ahrsd.baselines import MethodError
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.montecarlo.accuracy import MethodAnswer
from ahrsd.montecarlo.runs import OURS, STREAM, Plan, Record, run_many, scored
from ahrsd.montecarlo.summary import SummaryRow, summarise
from ahrsd.simulation import Experiment, ScenarioSettings, simulate

PROJECT = Path(__file__).resolve().parents[3]
TOOL = PROJECT.parent / "shared" / "tools" / "magyc_peers.py"
PROCESS = Path(__file__).with_name("peer_process.py")
PACKAGE = "magyc==1.0.0"
IFG = "MAGYC-IFG"
#: by what a run costs: half a second, ten, and up to a minute
TIERS = (
    (
        "MAGYC-NLS +sg",
        "ellipsoid_fit_fang mended",
        "ellipsoid_fit_fang mended +sg",
        "MAGYC-BFG jacfix +sg",
    ),
    ("MAGYC-NLS", IFG, "MAGYC-IFG +sg", "MAGYC-IFG jacfix", "MAGYC-IFG jacfix +sg"),
    ("MAGYC-BFG", "MAGYC-BFG +sg", "MAGYC-BFG jacfix"),
)
PEERS = tuple(name for tier in TIERS for name in tier)
AT_S, EARLIER_S = 400.0, (50.0, 100.0, 200.0)
_SECONDS = 7200.0  # after which a peer's process is given up


class NoPeersError(Exception):
    """The peers cannot be run here; the text is one line that says why."""


# -- the peers' side ---------------------------------------------------------------------------


def environment(cache: Path) -> Path:
    """The interpreter of the peers' environment, made where it is missing."""
    folder = cache / "env"
    python = folder / "bin" / "python"
    if not (folder / "ready").exists():
        say(f"making the peers' environment in {folder}")
        venv.create(folder, with_pip=True)
        made = subprocess.run(
            [python, "-m", "pip", "install", "-q", PACKAGE],
            check=False, capture_output=True, text=True,
        )  # fmt: skip
        if made.returncode:
            words = made.stderr.strip().splitlines() or ["pip failed"]
            raise NoPeersError(f"{PACKAGE} cannot be installed: {words[-1]}")
        (folder / "ready").touch()
    return python


def tool_module() -> Path:
    """The module that puts the package behind one signature; it is not part of the project."""
    if not TOOL.is_file():
        raise NoPeersError("the peers' module ../shared/tools/magyc_peers.py is not here")
    return TOOL


def readings(experiment: Experiment, path: Path) -> None:
    """What the peers are given: mG, rad/s, s, true roll, pitch, heading, the field in the world."""
    samples, R = experiment.samples, experiment.R_nb
    pitch = -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0))
    attitude = (np.arctan2(R[:, 2, 1], R[:, 2, 2]), pitch, np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    np.savez(
        path,
        mag=1e3 * samples.raw_b_gauss,
        gyro=samples.gyro_b_rad_s,
        t=samples.time_s,
        rph=np.column_stack(attitude),
        m0=1e3 * R[0] @ experiment.field_b[0],
    )


@dataclass(frozen=True, slots=True)
class Case:
    """One experiment, the peers that are to answer it, and the file that keeps their answers."""

    settings: ScenarioSettings
    kept: Path
    names: tuple[str, ...]

    @property
    def missing(self) -> list[str]:
        """Peers whose answers are not there."""
        found = answers(self.kept)
        return [name for name in self.names if name not in found]


def ask_peers(python: Path, tool: Path, cases: Sequence[Case]) -> None:
    """All answers that are missing, in one process of the peers' environment.

    NoPeersError where the process ends before the last of them.
    """
    orders = [_order(case) for case in cases if case.missing]
    if not orders:
        return
    command = [str(python), str(PROCESS), str(tool), *(json.dumps(order) for order in orders)]
    ran = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=_SECONDS,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    for order in orders:
        Path(order[0]).unlink()
    for case in cases:
        if case.missing:
            words = ran.stderr.strip().splitlines() or [f"exit {ran.returncode}"]
            raise NoPeersError(f"the peers' process ended before {case.missing[0]}: {words[-1]}")


def _order(case: Case) -> list[str]:
    """Readings' file, answers' file, and the missing peers: what the process is told."""
    missing, found = case.missing, answers(case.kept)
    case.kept.parent.mkdir(parents=True, exist_ok=True)
    whole = "".join(f"{json.dumps(said)}\n" for said in found.values())
    case.kept.write_text(whole, encoding="utf-8")  # without a line that a kill cut short
    data = case.kept.with_suffix(".npz")
    readings(simulate(case.settings), data)
    return [str(data), str(case.kept), *missing]


def answers(kept: Path) -> dict[str, Record]:
    """What the file holds; a line cut short by a kill is not there."""
    found = {}
    if kept.exists():
        for line in kept.read_text(encoding="utf-8").split("\n")[:-1]:
            said = json.loads(line)
            found[said["method"]] = said
    return found


def answered(said: Record) -> MethodAnswer:
    """A peer's line as an answer; MethodError with its own words where it has none."""
    if said["failure"] is not None:
        raise MethodError(said["failure"])
    bias = said["gyro_bias_rad_s"]
    return MethodAnswer(
        None if said["soft_iron"] is None else np.array(said["soft_iron"]),
        np.array(said["hard_iron_mg"]) / 1e3,
        None if bias is None else np.array(bias),
    )


# -- one set -----------------------------------------------------------------------------------


def peers_results(case: Case) -> list[Record]:
    """The peers' kept answers, scored against the truth."""
    experiment, found = simulate(case.settings), answers(case.kept)
    return [
        scored(name, AT_S, experiment, lambda name=name: answered(found[name]))  # type: ignore[misc]
        | {"cpu_s": found[name]["cpu_s"]}
        for name in case.names
    ]


def estimator_source() -> str:
    """Names what ours is computed by: a digest of the estimator's source."""
    digest = hashlib.sha256()
    files = sorted((PROJECT / "ahrsd" / "estimator").glob("*.py"))
    for path in [*files, PROJECT / "ahrsd" / "so3.py"]:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


# -- time --------------------------------------------------------------------------------------


def times(cache: Path, python: Path, tool: Path, counts: Sequence[int]) -> list[Record]:
    """Processor seconds of ours, streaming and whole, and of the released IFG on the same samples.

    MAM in both motions; the sensor is read at 25 Hz for as long as it takes.
    """
    out = []
    for motion in ("slow", "rov"):
        for count in counts:
            settings = ScenarioSettings("mam", motion, seed=0, samples=count)
            say(f"time: mam {motion}, {count} samples")
            case = Case(settings, cache / "time" / f"mam-{motion}-{count}.jsonl", (IFG,))
            ask_peers(python, tool, [case])
            peer, experiment = answers(case.kept)[IFG], simulate(settings)
            own = {name: ours_s(experiment, rows) for name, rows in ((STREAM, 25), (OURS, 1000))}
            ratios = {f"ratio {name}": peer["cpu_s"] / seconds for name, seconds in own.items()}
            out.append({"motion": motion, "samples": count, IFG: peer["cpu_s"], **own, **ratios})
    return out


def ours_s(experiment: Experiment, rows: int) -> float:
    """Processor seconds from samples to the estimate at their end: the median of three."""
    blocks = list(experiment.blocks(rows))
    spent = []
    for _ in range(3):
        begun_s = time.process_time()
        estimator = Estimator(at_once=WHOLE if rows > 25 else 1)
        for block in blocks:
            estimator.add(block)
        if rows > 25:
            estimator.finish()
        else:
            estimator.estimate()
        spent.append(time.process_time() - begun_s)
    return float(np.median(spent))


def say(text: str) -> None:
    """Progress goes to stderr."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def tiers(text: str) -> tuple[int, ...]:
    """Runs by tier, from cheap to dear."""
    runs = tuple(int(part) for part in text.split(","))
    if len(runs) > len(TIERS) or min(runs) < 1 or list(runs) != sorted(runs, reverse=True):
        raise argparse.ArgumentTypeError("one to three numbers from 1 on that do not increase")
    return runs


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is missing, write the tables, the JSON and the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cache", type=Path, required=True, help="environment and answers")
    parser.add_argument(
        "--runs",
        type=tiers,
        default=(10,),
        help="seeds from 0; fewer for dearer peers: 100,30,10",
    )
    parser.add_argument("--sets", default="wam,mam,lam")
    parser.add_argument("--motions", default="slow,rov")
    parser.add_argument("--time", action="store_true", help="10,000 and 80,000 samples: minutes")
    parser.add_argument("--only-peers", action="store_true", help="fill the cache, write nothing")
    parser.add_argument("--output", type=Path, default=Path("peers-out"))
    chosen = parser.parse_args(arguments)
    plans = [
        Plan(kind, motion, methods=(OURS, STREAM), at_s=(AT_S,))
        for motion in chosen.motions.split(",")
        for kind in chosen.sets.split(",")
    ]
    try:
        python, tool = environment(chosen.cache), tool_module()
        run = Comparison(chosen.cache, python, tool, chosen.runs)
        run.fill(plans)
        if not chosen.only_peers:
            timed = times(chosen.cache, python, tool, (10_000, 80_000)) if chosen.time else []
            write(chosen.output, [(plan, *run.compared(plan)) for plan in plans], timed)
    except NoPeersError as error:
        raise SystemExit(str(error)) from None


class Comparison:
    """What all sets share."""

    def __init__(self, cache: Path, python: Path, tool: Path, runs: Sequence[int]) -> None:
        self.cache, self.python, self.tool, self.runs = cache, python, tool, runs

    def case(self, plan: Plan, seed: int) -> Case:
        """What a seed asks of the peers."""
        kept = self.cache / "peers" / f"{plan.scenario}-{plan.motion}" / f"{seed}.jsonl"
        names = tuple(name for runs, tier in self.tiers() if seed < runs for name in tier)
        return Case(plan.settings(seed), kept, names)

    def fill(self, plans: Sequence[Plan]) -> None:
        """Ask the peers: every set gets its first seed before any gets its second."""
        for seed in range(self.runs[0]):
            cases = [self.case(plan, seed) for plan in plans]
            if any(case.missing for case in cases):
                say(f"peers: seed {seed}")
            ask_peers(self.python, self.tool, cases)

    def compared(self, plan: Plan) -> tuple[list[Record], list[SummaryRow]]:
        """Records and rows of ours and of all peers; dear ones over fewer seeds."""
        say(f"ours: {plan.name}")
        records = []
        for seed, ours in enumerate(self.ours(plan)):
            results = [*ours["results"], *peers_results(self.case(plan, seed))]
            records.append(ours | {"results": results})
        rows = []
        for runs, names in ((self.runs[0], (OURS, STREAM)), *self.tiers()):
            rows += summarise([only(record, names) for record in records[:runs]])
        return records, rows

    def ours(self, plan: Plan) -> list[Record]:
        """Batch and stream at the end, kept by the plans of the full form."""
        kept = self.cache / f"ours-{estimator_source()}"
        times_s = (*(t for t in EARLIER_S if t < AT_S), AT_S)
        batch, stream = (
            run_many(replace(plan, methods=(m,), at_s=t), range(self.runs[0]), resume=kept)
            for m, t in ((OURS, (AT_S,)), (STREAM, times_s))
        )
        return [
            whole
            | {"results": [*whole["results"], *(r for r in late["results"] if r["at_s"] == AT_S)]}
            for whole, late in zip(batch, stream, strict=True)
        ]

    def tiers(self) -> list[tuple[int, tuple[str, ...]]]:
        """How many runs of which peers; the last number holds for all dearer ones."""
        runs = [*self.runs, *[self.runs[-1]] * len(TIERS)]
        return list(zip(runs, TIERS))


def only(record: Record, names: Sequence[str]) -> Record:
    """A record with the results of these methods alone."""
    return record | {"results": [r for r in record["results"] if r["method"] in names]}


def write(
    folder: Path,
    compared: Sequence[tuple[Plan, list[Record], list[SummaryRow]]],
    timed: list[Record],
) -> None:
    """peers.json, table.md and peers.png."""
    folder.mkdir(parents=True, exist_ok=True)
    lines, body, verdicts = [], [], []
    for plan, records, rows in compared:
        best = {ours: best_peers(records, rows, PEERS, ours) for ours in (OURS, STREAM)}
        verdicts.append((plan.name, best[OURS]))
        lines += set_lines(plan.name, rows)
        body.append({"set": plan.name, "rows": [row.json() for row in rows], "best_peers": best})
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        check=False, capture_output=True, text=True, cwd=PROJECT,
    ).stdout.strip()  # fmt: skip
    result = {
        "schema": "ahrsd.peers/1",
        "commit": commit,
        "estimator": estimator_source(),
        "package": PACKAGE,
        "at_s": AT_S,
        "sets": body,
        "time": timed,
    }
    (folder / "peers.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    lines = [*verdict_lines(verdicts), *time_lines(timed), *lines]
    (folder / "table.md").write_text("\n".join(lines).lstrip() + "\n", encoding="utf-8")
    sets = [(plan.name, rows) for plan, _, rows in compared]
    write_peers_figure(folder / "peers.png", sets, (OURS, STREAM))
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
