"""Monte Carlo: methods on many seeds of one scenario, against truth and the Cramer-Rao bound.

One run is one seed: simulate, compute the bound, let every method answer at every time asked for.
Each finished run is one line of a file, so that a stopped experiment goes on where it was
(`resume`). The record of a seed does not depend on the others, so they may come in any order from
as many processes; `ahrsd montecarlo` gives them to those of `fleet.processes`.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ahrsd.baselines import METHODS, MethodError, MethodSettings, calibrate_with
from ahrsd.errors import AhrsdError
from ahrsd.estimator.online import WHOLE, Estimator
from ahrsd.estimator.parameters import EstimatorParameters
from ahrsd.montecarlo import nuisances
from ahrsd.montecarlo.accuracy import (
    HEADINGS,
    MethodAnswer,
    expected_heading_deg,
    figures,
    unit_volume,
)
from ahrsd.montecarlo.cramer_rao import Bound, Trajectory, UnobservableError, cramer_rao
from ahrsd.montecarlo.summary import BOUNDED
from ahrsd.samples import Array
from ahrsd.simulation import Experiment, Iron, ScenarioSettings, simulate

# -- Methods by name -------------------------------------------------------------------------------
#
# The methods that a Monte Carlo knows: ours, whole and as a stream, and the published ones.
#
# The published ones are given what each needs and a simulation knows: the attitude, the field in
# the world and its magnitude (`magfactor3`, `twostep`, [L]'s) and the gyro bias (`magical-ls`). The
# name of a method that uses the gyro may end in "+savgol": readings smoothed by a Savitzky-Golay
# filter first, as the authors' notebooks do.


Batch = Callable[[Experiment], MethodAnswer]

OURS = "magyc"
STREAM = "magyc-stream"
SMOOTHED = "+savgol"
_BLOCK = 1000


#: a simulated instrument has no imperfections but iron and bias; the published methods know of none
IDEAL = EstimatorParameters(imperfections=())


def known_methods() -> tuple[str, ...]:
    """Ids of all methods, ours first."""
    return (OURS, STREAM, *METHODS)


def is_known(name: str) -> bool:
    """Whether it is an id, or one of a method that uses the gyro with "+savgol"."""
    plain = name.removesuffix(SMOOTHED)
    smoothable = plain in METHODS and "gyro" in METHODS[plain].needs
    return smoothable if plain != name else name in known_methods()


def batch_method(name: str) -> Batch:
    """What answers from a whole experiment; raises MethodError where it has no answer."""
    if name == OURS:
        return _ours
    return lambda experiment: _published(name, experiment)


def _ours(experiment: Experiment) -> MethodAnswer:
    estimator = Estimator(IDEAL, at_once=WHOLE)
    for block in experiment.blocks(_BLOCK):
        estimator.add(block)
    estimate = estimator.finish()
    if estimate is None:
        raise MethodError("no estimate")
    return MethodAnswer.of(estimate)


def present(estimator: Estimator) -> MethodAnswer:
    """What a stream's estimator says now.  MethodError before its first estimate."""
    estimate = estimator.estimate()
    if estimate is None:
        raise MethodError("no estimate yet")
    return MethodAnswer.of(estimate)


def _published(name: str, experiment: Experiment) -> MethodAnswer:
    plain = name.removesuffix(SMOOTHED)
    truth = experiment.truth
    result = calibrate_with(
        plain,
        list(experiment.blocks(_BLOCK)),
        settings=MethodSettings(
            known_gyro_bias_rad_s=truth.gyro_bias_rad_s,
            derivative="savgol" if plain != name else "median",
        ),
        R_nb=experiment.R_nb,
        field_n_gauss=experiment.R_nb[0] @ experiment.field_b[0],
        field_norm_gauss=truth.field_gauss,
    )
    if not result.converged:
        raise MethodError(result.reason)
    return MethodAnswer(result.soft_iron, result.hard_iron_gauss, result.gyro_bias_rad_s)


Record = dict[str, Any]  # one run, as it stands in the file: see `run_one`

_CHUNK = 25  # samples handed to the stream at a time
_FORMAT = 3  # of a record: bounds hold `sigma`, headings and what is ordinary


# -- Runs ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Plan:
    """What every run does.

    at_s: times at which the methods answer, from the samples up to then; the last one is the length
    offset_behind_iron: b = m_b as in [R]'s Table 5.1, else b = A m_b
    hard_iron_scale: times [R]'s hard iron
    """

    scenario: str
    motion: str = "slow"
    methods: tuple[str, ...] = (OURS, STREAM)
    at_s: tuple[float, ...] = (50.0, 100.0, 200.0, 400.0)
    rate_hz: float = 25.0
    noise_mag_gauss: float = 1e-3
    noise_gyro_rad_s: float = 5e-3
    offset_behind_iron: bool = False
    hard_iron_scale: float = 1.0

    def __post_init__(self) -> None:
        """Raises ValueError naming the method, the time or the setting that cannot be."""
        if not self.at_s or any(b <= a for a, b in zip((0.0, *self.at_s), self.at_s)):
            raise ValueError(f"times must be positive and increase: {list(self.at_s)}")
        for name in self.methods:
            if not is_known(name):
                raise ValueError(f"no method {name!r}; there are {', '.join(known_methods())}")
        self.settings(0)

    def settings(self, seed: int) -> ScenarioSettings:
        """The experiment of a seed."""
        return ScenarioSettings(
            scenario=self.scenario,
            motion=self.motion,
            seed=seed,
            samples=self.samples(self.at_s[-1]),
            rate_hz=self.rate_hz,
            noise_mag_gauss=self.noise_mag_gauss,
            noise_gyro_rad_s=self.noise_gyro_rad_s,
            iron=Iron(offset_behind_iron=self.offset_behind_iron).scaled(self.hard_iron_scale),
        )

    def samples(self, at_s: float) -> int:
        """How many samples there are up to a time."""
        return round(at_s * self.rate_hz)

    @property
    def name(self) -> str:
        """What it is, for people: only what differs from the thesis is named."""
        usual = Plan(self.scenario)
        said = [f"{self.scenario.upper()} {self.motion}"]
        if self.noise_mag_gauss != usual.noise_mag_gauss:
            said.append(f"{self.noise_mag_gauss * 1e3:g} mG noise")
        if self.hard_iron_scale != usual.hard_iron_scale:
            said.append(f"hard iron x {self.hard_iron_scale:g}")
        return ", ".join(said)

    @property
    def key(self) -> str:
        """Names the file of this plan's runs; another plan never shares it."""
        text = json.dumps(asdict(self) | {"format": _FORMAT}, sort_keys=True)
        return f"{self.scenario}-{self.motion}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def run_one(plan: Plan, seed: int) -> Record:
    """One seed: `bounds` by time, and `results` by method and time."""
    experiment = simulate(plan.settings(seed))
    results: list[Record] = []
    for method in plan.methods:
        answers = _streamed if method == STREAM else _in_batches
        results += answers(plan, method, experiment)
    return {"seed": seed, "bounds": [bound_at(plan, experiment, t) for t in plan.at_s]} | {
        "results": results
    }


def lost_record(plan: Plan, seed: int, words: str) -> Record:
    """The record of a seed whose process gave no answer: no figure, and the same failure in each
    result. It is counted and not kept: `resume` runs the seed again."""
    unknown = dict.fromkeys((*BOUNDED, *HEADINGS, "sigma", "ordinary"))
    return {
        "seed": seed,
        "bounds": [{"at_s": at_s} | unknown for at_s in plan.at_s],
        "results": [
            {"method": method, "at_s": at_s, "failure": words, "cpu_s": None}
            for method in plan.methods
            for at_s in plan.at_s
        ],
        "lost": words,
    }


def bound_at(plan: Plan, experiment: Experiment, at_s: float) -> Record:
    """The bound from the samples up to a time; every figure None where the motion leaves it open.

    sigma (12,): of each parameter, in the order of `Truth.parameters`; ordinary: the same figures
    but for sigma, of an instrument with the imperfections that are ordinary, at an ordinary place
    """
    truth = experiment.truth
    whole = Trajectory(experiment.field_b, experiment.rate_b_rad_s, experiment.samples.dt_s)
    part = whole.before(plan.samples(at_s))
    noise = plan.noise_mag_gauss, plan.noise_gyro_rad_s
    try:
        plain = cramer_rao(part, truth.soft_iron, *noise)
        extra = nuisances.ordinary(part, truth.soft_iron, plan.noise_mag_gauss)
        wider = cramer_rao(part, truth.soft_iron, *noise, nuisances=extra)
    except UnobservableError:
        return {"at_s": at_s} | dict.fromkeys((*BOUNDED, *HEADINGS, "sigma", "ordinary"))
    sigma = np.sqrt(np.diag(plain.covariance).clip(min=0.0)).tolist()
    own = {"at_s": at_s, "sigma": sigma, "ordinary": _bounded(experiment, wider)}
    return own | _bounded(experiment, plain)


def _bounded(experiment: Experiment, bound: Bound) -> Record:
    return {
        "hard_iron_gauss": bound.hard_iron_gauss,
        "soft_iron": bound.soft_iron,
        "gyro_bias_rad_s": bound.gyro_bias_rad_s,
    } | {
        name: expected_heading_deg(experiment, bound.covariance, noise_gauss)
        for name, noise_gauss in HEADINGS.items()
    }


def _in_batches(plan: Plan, method: str, experiment: Experiment) -> Iterator[Record]:
    answer = batch_method(method)
    for at_s in plan.at_s:
        part = experiment.first(plan.samples(at_s))
        yield scored(method, at_s, experiment, lambda part=part: answer(part))  # type: ignore[misc]


def _streamed(plan: Plan, method: str, experiment: Experiment) -> Iterator[Record]:
    """The stream as the daemon feeds it, asked at the given times and never stopped."""
    estimator = Estimator(IDEAL)
    begun_s = time.process_time()
    waiting = list(plan.at_s)
    fed = 0
    for block in experiment.blocks(_CHUNK):
        estimator.add(block)
        fed += len(block)
        while waiting and fed >= plan.samples(waiting[0]):
            yield scored(method, waiting.pop(0), experiment, lambda: present(estimator), begun_s)


def scored(
    method: str,
    at_s: float,
    experiment: Experiment,
    ask: Callable[[], MethodAnswer],
    begun_s: float | None = None,
) -> Record:
    """An answer with its errors, or the failure in words; CPU seconds since `begun_s` or now.

    `ask` says a failure by AhrsdError, ValueError (MethodError), ArithmeticError or RuntimeError.
    """
    since_s = time.process_time() if begun_s is None else begun_s
    out: Record = {"method": method, "at_s": at_s, "failure": None}
    try:
        answer = ask()
        out["cpu_s"] = time.process_time() - since_s
        out["errors"] = figures(answer, experiment)
    except (AhrsdError, ValueError, ArithmeticError, RuntimeError) as error:
        # RuntimeError is what GTSAM throws; LinAlgError is a ValueError
        words = str(error).splitlines()
        return out | {
            "failure": words[0] if words else type(error).__name__,
            "cpu_s": time.process_time() - since_s,
        }
    A = answer.soft_iron
    return out | {
        "converged": bool(answer.converged),
        "soft_iron": None if A is None else unit_volume(A).tolist(),
        "hard_iron_gauss": _listed(answer.hard_iron_gauss),
        "gyro_bias_rad_s": _listed(answer.gyro_bias_rad_s),
    }


def _listed(value: Array | None) -> list[float] | None:
    return None if value is None else value.tolist()


#: the records of seeds, in any order
Runner = Callable[[Plan, Sequence[int]], Iterable[Record]]


def one_by_one(plan: Plan, seeds: Sequence[int]) -> Iterator[Record]:
    """In this process."""
    return (run_one(plan, seed) for seed in seeds)


def run_many(
    plan: Plan,
    seeds: Sequence[int],
    *,
    runner: Runner = one_by_one,
    resume: Path | None = None,
    done: Callable[[int, int], None] | None = None,
) -> list[Record]:
    """All runs in the order of the seeds; those already in `resume` are read, not run again.

    done: called with the number of runs finished and of all. Raises AhrsdError where the file
    cannot be used.
    """
    path = None if resume is None else resume / f"{plan.key}.jsonl"
    records = {} if path is None else _kept(path)
    missing = [seed for seed in seeds if seed not in records]
    finished = len(seeds) - len(missing)
    if done is not None:
        done(finished, len(seeds))
    for record in runner(plan, missing):
        records[record["seed"]] = record
        if path is not None and "lost" not in record:
            _keep(path, record)
        finished += 1
        if done is not None:
            done(finished, len(seeds))
    return [records[seed] for seed in seeds]


def _kept(path: Path) -> dict[int, Record]:
    """Finished runs; a last line that was cut short by a kill is run again."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be read: {error.strerror}") from error
    records = {}
    for line in text.split("\n")[:-1]:
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            continue
        records[int(record["seed"])] = record
    return records


def _keep(path: Path, record: Record) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        torn = path.exists() and path.read_bytes()[-1:] not in (b"", b"\n")
        with path.open("a", encoding="utf-8") as file:
            file.write(("\n" if torn else "") + json.dumps(record) + "\n")
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error


def plans(
    plan: Plan,
    scenarios: Sequence[str],
    motions: Sequence[str],
    noise_mag_gauss: Sequence[float],
    hard_iron_scales: Sequence[float],
) -> list[Plan]:
    """The plan for every combination. A seed keeps its trajectory and its draws of noise."""
    return [
        replace(plan, scenario=s, motion=m, noise_mag_gauss=noise, hard_iron_scale=scale)
        for s, m, noise, scale in product(scenarios, motions, noise_mag_gauss, hard_iron_scales)
    ]
