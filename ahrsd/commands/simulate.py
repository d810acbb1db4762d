"""`ahrsd simulate SCENARIO -o FILE`: a recording whose truth is known."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ahrsd.commands.json_output import write_json
from ahrsd.errors import EXIT_DONE, AhrsdError

if TYPE_CHECKING:
    from ahrsd.simulation import Experiment
    from ahrsd.simulation.disturbance import Disturbances

_STREAM_SUFFIXES = (".vnraw", ".vnraw.gz")
_MG, _MRAD = 1e-3, 1e-3
_RECORDED = "recorded"
_MOST_SAMPLES = 1e7


@click.command()
@click.argument("scenario", type=click.Choice(["wam", "mam", "lam", _RECORDED]))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The file.")
@click.option("--motion", type=click.Choice(["slow", "rov"]), default="slow", show_default=True)
@click.option("--seed", default=0, show_default=True, help="Chooses motion and noise.")
@click.option("--seconds", default=400.0, show_default=True, help="Length.")
@click.option("--rate", "rate_hz", default=25.0, show_default=True, help="Samples per second.")
@click.option("--noise-mag", "mag_mg", default=1.0, show_default=True, help="mG per sample.")
@click.option(
    "--noise-gyro", "gyro_mrad", default=5.0, show_default=True, help="mrad/s per sample."
)
@click.option("--hard-iron-as-read", is_flag=True, help="b = m_b as in [R]'s tables, not A m_b.")
@click.option("--gyro", "gyro_path", type=click.Path(path_type=Path), help="Table for recorded.")
@click.option("--outliers", default=0.0, help="Fraction of samples that are 100 mG off.")
@click.option("--magnet", "magnet_at_s", type=float, help="A magnet passes at this second.")
@click.option("--step", "step_at_s", type=float, help="The hard iron steps by 30 mG here.")
@click.option("--gap", "gap_at_s", type=float, help="Two seconds without samples from here.")
def command(
    scenario: str,
    output: Path,
    motion: str,
    seed: int,
    seconds: float,
    rate_hz: float,
    mag_mg: float,
    gyro_mrad: float,
    hard_iron_as_read: bool,
    gyro_path: Path | None,
    outliers: float,
    magnet_at_s: float | None,
    step_at_s: float | None,
    gap_at_s: float | None,
) -> None:
    """Simulate SCENARIO: wam, mam or lam (wide, medium, low angular movement) of the MAGYC thesis,
    or recorded: a field on the motion of a recorded gyro stream (--gyro), without soft iron.

    FILE is a table (.csv, .csv.gz, .parquet) with the true attitude in ref_q{w,x,y,z}, or a byte
    stream of VNYMR sentences (.vnraw, .vnraw.gz). The truth goes into FILE.truth.json.
    """
    from ahrsd.simulation import Iron, Settings, simulate
    from ahrsd.simulation.disturbance import Disturbances
    from ahrsd.simulation.tabular import settings_json, truth_json

    if (scenario == _RECORDED) != (gyro_path is not None):
        raise AhrsdError("the scenario recorded and the option --gyro need each other")
    if not (0 < seconds * rate_hz < _MOST_SAMPLES):
        raise AhrsdError(f"--seconds times --rate must be positive and below {_MOST_SAMPLES:g}")
    try:
        wanted = Disturbances(
            outlier_fraction=outliers,
            magnet_at_s=magnet_at_s,
            step_at_s=step_at_s,
            gap_at_s=gap_at_s,
        )
        if gyro_path is not None:
            experiment = _recorded(gyro_path, seconds, seed, mag_mg, wanted)
            made_from: dict[str, object] = {"gyro": gyro_path.name, "seed": seed}
        else:
            settings = Settings(
                scenario=scenario,
                motion=motion,
                seed=seed,
                samples=round(seconds * rate_hz),
                rate_hz=rate_hz,
                noise_mag_gauss=mag_mg * _MG,
                noise_gyro_rad_s=gyro_mrad * _MRAD,
                iron=Iron(offset_behind_iron=hard_iron_as_read),
                disturbances=wanted,
            )
            experiment, made_from = simulate(settings), settings_json(settings)
    except ValueError as error:
        raise AhrsdError(str(error)) from None
    _write(output, experiment)
    write_json(f"{output}.truth.json", truth_json(experiment, made_from))
    click.echo(f"{output}: {len(experiment)} samples of {experiment.name}; truth beside it")
    raise SystemExit(EXIT_DONE)


def _recorded(
    path: Path, seconds: float, seed: int, mag_mg: float, wanted: Disturbances
) -> Experiment:
    """[L]'s experiment on the longest stretch without a gap; the recorded rates are the truth."""
    import numpy as np

    from ahrsd.recording.table import read_table
    from ahrsd.simulation.disturbance import disturbed
    from ahrsd.simulation.recorded import simulate_recorded
    from ahrsd.simulation.scenarios import generator

    table = read_table(path)
    ends = np.array([*table.starts, len(table.rows)])
    longest = int(np.argmax(np.diff(ends)))
    rows = slice(ends[longest], ends[longest + 1])
    time_s, gyro = table.rows.time_s[rows], table.rows.gyro_b_rad_s[rows]
    kept = time_s <= time_s[0] + seconds
    made = simulate_recorded(time_s[kept], gyro[kept], seed=seed, noise_mag_gauss=mag_mg * _MG)
    return disturbed(made, wanted, generator(seed, 3))


def _write(path: Path, experiment: Experiment) -> None:
    from ahrsd.recording.table_writer import TABLE_SUFFIXES, is_table, write_table
    from ahrsd.simulation.tabular import columns, sentences

    try:
        if is_table(path):
            write_table(path, columns(experiment))
            return
        if not path.name.endswith(_STREAM_SUFFIXES):
            known = ", ".join((*TABLE_SUFFIXES, *_STREAM_SUFFIXES))
            raise AhrsdError(f"{path}: unknown kind of file; the name must end in one of {known}")
        content = b"".join(sentences(experiment))
        path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
    except OSError as error:
        raise AhrsdError(f"{path}: cannot be written: {error.strerror}") from error
