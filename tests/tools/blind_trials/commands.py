"""`ahrsd challenge make|run|score`: sealed blind trials of `diagnose`.

See docs/validation/blind-trials.md.
"""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.cli import WholeGroup
from ahrsd.cli.files import refuse_unwritable
from ahrsd.cli.long_work import count_progress
from ahrsd.errors import EXIT_DONE, EXIT_NO
from ahrsd.printable import counted

_RINGS = (
    "full",
    "nulls",
    "singles",
    "pairs",
    "withheld",
    "outside",
    "unidentifiable",
    "semireal",
)
_FOLDER = click.Path(file_okay=False, path_type=Path)
_FILE = click.Path(dir_okay=False, path_type=Path)


@click.group(cls=WholeGroup)
def command() -> None:
    """Sealed blind trials: cases with concealed physics, answers, then the key and the scores."""


@command.command("make")
@click.option("--cases", type=click.IntRange(1), default=600, show_default=True)
@click.option("--ring", type=click.Choice(_RINGS), default="full", show_default=True)
@click.option("--seed", type=click.IntRange(0), help="Drawn in secret where it is left out.")
@click.option("-o", "--output", "folder", type=_FOLDER, required=True, help="Folder of the cases.")
@click.option("--key", "key_path", type=_FILE, help="The key; FOLDER-key/key.json if left out.")
@click.option("--recordings", type=_FOLDER, help="Folder of real recordings, for ring semireal.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True)
def make_command(
    cases: int,
    ring: str,
    seed: int | None,
    folder: Path,
    key_path: Path | None,
    recordings: Path | None,
    jobs: int,
) -> None:
    """Generate cases and seal their key."""
    from blind_trials.making import make

    key = key_path or folder.with_name(folder.name + "-key") / "key.json"
    with count_progress("cases") as done:
        trial = make(
            folder, key, ring, cases, seed=seed, jobs=jobs, recordings=recordings, done=done
        )
    click.echo(f"{counted(len(trial.cases), 'case')} in {folder}, key in {key}")
    click.echo(f"sealed: sha256 {trial.sha256}")


@command.command("run")
@click.argument("folder", type=_FOLDER)
@click.option(
    "--tool",
    default="ahrsd",
    show_default=True,
    help="ahrsd, stlsq, lasso-bic, ruptures, or a command line with {case}, {spec} and {json}.",
)
@click.option("--name", help="Name of the answers' folder; the tool's if left out.")
@click.option("--jobs", type=click.IntRange(1), default=1, show_default=True)
def run_command(folder: Path, tool: str, name: str | None, jobs: int) -> None:
    """Let a tool answer every case in FOLDER, then close its answers; goes on where it stopped.

    A tool that cannot run, for want of a package or a program, is refused before the first case.
    """
    from blind_trials.running import run
    from blind_trials.sealing import open_round

    trial = open_round(folder)
    with count_progress(name or tool.split(maxsplit=1)[0]) as done:
        digest = run(trial, tool, name=name, jobs=jobs, done=done)
    click.echo(f"{counted(len(trial.cases), 'answer')} closed: sha256 {digest}")


@command.command("score")
@click.argument("folder", type=_FOLDER)
@click.option("--key", "key_path", type=_FILE, required=True)
@click.option("-o", "--output", type=_FOLDER, help="Folder of the report; FOLDER if left out.")
def score_command(folder: Path, key_path: Path, output: Path | None) -> None:
    """Open the key and judge all closed answers.

    Writes score.json, report.md and report.html; exit 1 where the first tool missed a wanted score.
    """
    from blind_trials.scoring import score, unable
    from blind_trials.sealing import open_round

    trial = open_round(folder)
    for name in ("score.json", "report.md", "report.html"):
        if (path := (output or folder) / name).exists():
            refuse_unwritable(path)
    results = score(trial, key_path, output or folder)
    for tool, why in unable(trial).items():
        click.echo(f"{tool}: not scored: {why}", err=True)
    for result in results:
        rate = result.mistakes
        if rate.value is not None:
            cases = counted(rate.cases, "case")
            click.echo(f"{result.tool}: {rate.value:.1%} mistakes in {cases}")
    for row in results[0].scores:
        value = "" if row.value is None else f"{row.value:.3f}"
        met = {None: "", True: "met", False: "NOT MET"}[row.met]
        click.echo(f"  {row.name:45s} {value:>7s} of {row.cases:4d}  {row.target:>9s} {met}")
    missed = any(row.met is False for row in results[0].scores)
    raise SystemExit(EXIT_NO if missed else EXIT_DONE)
