"""`ahrsd montecarlo SCENARIO --runs N`: how accurate the methods are, and how good one could be."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.cli.files import refuse_unwritable, write_json
from ahrsd.cli.long_work import count_progress, limit_options
from ahrsd.errors import EXIT_DONE, EXIT_NO, AhrsdError
from ahrsd.printable import counted

if TYPE_CHECKING:
    from ahrsd.fleet.processes import Crew, Loss
    from ahrsd.montecarlo.runs import Plan, Record
    from ahrsd.montecarlo.summary import SummaryRow

_ALL = "all"
_MG, _MRAD = 1e-3, 1e-3


def _list(_context: click.Context, _option: click.Parameter, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r}: numbers separated by commas") from None


@click.command()
@click.argument("scenario", type=click.Choice(["wam", "mam", "lam", _ALL]))
@click.option("--runs", type=click.IntRange(1), default=100, show_default=True, help="Seeds.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="First seed.")
@click.option(
    "--method",
    "methods",
    multiple=True,
    default=("magyc", "magyc-stream"),
    show_default=True,
    help="A method's id, or all; may be repeated. The suffix +savgol smooths the readings first.",
)
@click.option("--motion", type=click.Choice(["slow", "rov", _ALL]), default="slow")
@click.option("--at", "at_s", default="50,100,200,400", show_default=True, callback=_list)
@click.option("--rate", "rate_hz", default=25.0, show_default=True, help="Samples per second.")
@click.option(
    "--noise-mag",
    "noise_mg",
    default="1",
    show_default=True,
    callback=_list,
    help="mG per sample; several, separated by commas, are a sweep.",
)
@click.option(
    "--bias-scale",
    "scales",
    default="1",
    show_default=True,
    callback=_list,
    help="Factor on the hard iron; several are a sweep.",
)
@click.option(
    "--noise-gyro", "gyro_mrad", default=5.0, show_default=True, help="mrad/s per sample."
)
@click.option("--hard-iron-as-read", is_flag=True, help="b = m_b as in [R]'s tables, not A m_b.")
@click.option("--jobs", type=click.IntRange(1), default=os.cpu_count() or 1, show_default=True)
@limit_options("a seed")
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    help="Folder of finished runs; runs in it are not repeated.",
)
@click.option("--json", "json_path", help="Figures into this file, - for stdout.")
@click.option("--figure", "figure_path", type=click.Path(path_type=Path), help="A picture, PNG.")
def command(
    scenario: str,
    runs: int,
    seed: int,
    methods: tuple[str, ...],
    motion: str,
    at_s: tuple[float, ...],
    rate_hz: float,
    noise_mg: tuple[float, ...],
    scales: tuple[float, ...],
    gyro_mrad: float,
    hard_iron_as_read: bool,
    jobs: int,
    limit_s: float,
    memory_bytes: int,
    resume: Path | None,
    json_path: str | None,
    figure_path: Path | None,
) -> None:
    """Simulate SCENARIO (wam, mam, lam or all of them) for many seeds; compare with the bound.

    "bound" is that of the simulated instrument, which is perfect but for iron, bias and white
    noise. "bound, ordinary" is that of a real one on the same motion: a gyro with scales and axes
    1 % off, axes turned by a degree, a field read 15 ms late, offsets that follow the temperature,
    a field that differs by place and noise that is not white, each known to that much beforehand.

    A seed that takes too long or too much memory, or whose process crashes, is a failure of every
    method and not the end; --resume runs it again. Exit 1 where a method had no answer at the last
    time in some run.
    """
    from ahrsd.fleet.processes import Limits, Place, crew

    refuse_unwritable(json_path)
    refuse_unwritable(figure_path)
    wanted = _plans(
        scenario, motion, methods, at_s, rate_hz, noise_mg, scales, gyro_mrad, hard_iron_as_read
    )
    sets = []
    place = Place(min(jobs, runs), loads=("ahrsd.montecarlo.runs",))
    with crew(place, Limits(limit_s, memory_bytes)) as processes:
        for plan in wanted:
            rows = _run(plan, range(seed, seed + runs), processes, resume)
            sets.append((plan, rows))
            if json_path != "-":
                _say(plan, rows)
    if json_path != "-":
        _say_headings(sets)
    if json_path is not None:
        write_json(json_path, _json(sets, seed, runs))
    if figure_path is not None:
        _draw(figure_path, sets)
    last = [row for _, rows in sets for row in rows if row.at_s == at_s[-1]]
    raise SystemExit(EXIT_NO if any(row.answered < row.runs for row in last) else EXIT_DONE)


def _plans(
    scenario: str,
    motion: str,
    methods: tuple[str, ...],
    at_s: tuple[float, ...],
    rate_hz: float,
    noise_mg: tuple[float, ...],
    scales: tuple[float, ...],
    gyro_mrad: float,
    hard_iron_as_read: bool,
) -> list[Plan]:
    """One plan per scenario, motion, noise and hard iron that were asked for."""
    from ahrsd.montecarlo.runs import Plan, known_methods, plans

    everyone = known_methods() if _ALL in methods else ()
    chosen = tuple(dict.fromkeys(name for name in (*everyone, *methods) if name != _ALL))
    scenarios = ("wam", "mam", "lam") if scenario == _ALL else (scenario,)
    motions = ("slow", "rov") if motion == _ALL else (motion,)
    try:
        base = Plan(
            "wam",
            methods=chosen,
            at_s=at_s,
            rate_hz=rate_hz,
            noise_gyro_rad_s=gyro_mrad * _MRAD,
            offset_behind_iron=hard_iron_as_read,
        )
        return plans(base, scenarios, motions, [mg * _MG for mg in noise_mg], scales)
    except ValueError as error:
        raise AhrsdError(str(error)) from None


def _run(plan: Plan, seeds: range, processes: Crew, resume: Path | None) -> list[SummaryRow]:
    from ahrsd.montecarlo.runs import run_many, run_one
    from ahrsd.montecarlo.summary import summarise

    def runner(plan: Plan, seeds: Sequence[int]) -> Iterator[Record]:
        lost = partial(_lost, plan)
        return (record for _, record in processes.map(partial(run_one, plan), seeds, lost))

    with count_progress(plan.name) as done:
        return summarise(run_many(plan, seeds, runner=runner, resume=resume, done=done))


def _lost(plan: Plan, seed: int, loss: Loss) -> Record:
    from ahrsd.montecarlo.runs import lost_record

    return lost_record(plan, seed, loss.words)


def _say(plan: Plan, rows: list[SummaryRow]) -> None:
    from ahrsd.montecarlo.summary import accuracy_lines, bound_lines, parameter_lines

    truth = plan.settings(0).truth
    listed = [
        *truth.soft_iron.ravel().tolist(),
        *(1e3 * truth.hard_iron_gauss).tolist(),
        *(1e3 * truth.gyro_bias_rad_s).tolist(),
    ]
    click.echo(f"\n{plan.name}, {counted(rows[0].runs, 'run')}")
    for line in [*accuracy_lines(rows), *bound_lines(rows)]:
        click.echo(line)
    click.echo(
        f"\nMean and spread at {plan.at_s[-1]:g} s; A with det A = 1, b in mG, w_b in mrad/s"
    )
    for line in parameter_lines(rows, listed):
        click.echo(line)


def _say_headings(sets: list[tuple[Plan, list[SummaryRow]]]) -> None:
    from ahrsd.montecarlo.summary import heading_lines

    click.echo("\nHeading RMSE in deg, of readings with 10 mG of noise (without noise)")
    for line in heading_lines([(plan.name, rows) for plan, rows in sets]):
        click.echo(line)


def _json(sets: list[tuple[Plan, list[SummaryRow]]], seed: int, runs: int) -> dict[str, object]:
    return {
        "schema": "ahrsd.montecarlo/1",
        "runs": runs,
        "seeds": [seed, seed + runs - 1],
        "sets": [
            {
                "scenario": plan.scenario,
                "motion": plan.motion,
                "rate_hz": plan.rate_hz,
                "noise_mag_gauss": plan.noise_mag_gauss,
                "noise_gyro_rad_s": plan.noise_gyro_rad_s,
                "hard_iron_scale": plan.hard_iron_scale,
                "hard_iron_is": "m_b" if plan.offset_behind_iron else "A m_b",
                "truth": plan.settings(0).truth.json(),
                "rows": [row.json() for row in rows],
            }
            for plan, rows in sets
        ],
    }


def _draw(path: Path, sets: list[tuple[Plan, list[SummaryRow]]]) -> None:
    from ahrsd.report.accuracy_figures import write_montecarlo_figure

    try:
        write_montecarlo_figure(path, [(plan.name, rows) for plan, rows in sets])
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
