"""`ahrsd demo`: the main job with no hardware."""

from __future__ import annotations

from pathlib import Path

import click

from ahrsd.errors import EXIT_DONE, EXIT_NO


@click.command()
@click.option(
    "--output",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("ahrsd-demo"),
    show_default=True,
    help="Folder for what it leaves.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(60.0),
    default=2400.0,
    show_default=True,
    help="Device time at most.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Which hidden truth.")
def command(directory: Path, seconds: float, seed: int) -> None:
    """Calibrate an emulated VN-100 with hidden iron and gyro bias, and write its registers.

    The real daemon on one end of a pseudo-terminal, the emulated device on the other, both many
    times faster than real time. Exit 1 where the result is not what is promised.
    """
    from ahrsd.demo import figures, run_demo, verdict

    click.echo(f"emulated VN-100, seed {seed}; output in {directory}")
    result = run_demo(directory, seconds=seconds, seed=seed, say=click.echo)
    click.echo("")
    click.echo(f"{'':42}{'before':>10}{'after':>10}{'limit':>8}")
    for figure in figures(result):
        name = f"{figure.name} [{figure.unit}]"
        click.echo(f"{name:42}{figure.before:10.3f}{figure.after:10.3f}{figure.limit:8.2f}")
    click.echo(f"read-back exact: {'yes' if result.read_back_exact else 'no'}")
    click.echo(verdict(result))
    for name in ("report.html", "run.rrd", "capture.mcap", "calibration.json", "journal.jsonl"):
        click.echo(f"  {directory / name}")
    raise SystemExit(EXIT_DONE if result.good else EXIT_NO)
