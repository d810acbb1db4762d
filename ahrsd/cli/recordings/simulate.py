"""`ahrsd simulate SCENARIO -o FILE`: a recording whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from ahrsd.cli import Number
from ahrsd.cli.files import columns_option, refuse_unwritable, write_json
from ahrsd.errors import EXIT_DONE, AhrsdError
from ahrsd.printable import counted

if TYPE_CHECKING:
    from ahrsd.recording.column_names import ColumnMap
    from ahrsd.simulation import Experiment
    from ahrsd.simulation.scenarios import Disturbances

_MG, _MRAD = 1e-3, 1e-3
_RECORDED = "recorded"
_MOST_SAMPLES = 1e7
_USUAL_HZ = 25.0
#: options that --model and --along leave without use
_OF_A_SCENARIO = (
    *("motion", "seconds", "mag_mg", "gyro_mrad", "hard_iron_as_read", "gyro_path"),
    *("outliers", "magnet_at_s", "step_at_s", "gap_at_s", "effects"),
)


@click.command()
@click.argument("scenario", required=False, type=click.Choice(["wam", "mam", "lam", _RECORDED]))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="File to write."
)
@click.option("--motion", type=click.Choice(["slow", "rov"]), default="slow", show_default=True)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Chooses motion and noise."
)
@click.option("--seconds", default=400.0, show_default=True, help="Length.")
@click.option(
    "--rate",
    "rate_hz",
    type=float,
    show_default=f"{_USUAL_HZ:g}",
    help="Samples per second; with --along messages per second, if messages have no time.",
)
@click.option("--noise-mag", "mag_mg", default=1.0, show_default=True, help="mG per sample.")
@click.option(
    "--noise-gyro", "gyro_mrad", default=5.0, show_default=True, help="mrad/s per sample."
)
@click.option("--hard-iron-as-read", is_flag=True, help="b = m_b as in [R]'s tables, not A m_b.")
@click.option(
    "--gyro",
    "gyro_path",
    type=click.Path(path_type=Path),
    help="Gyro table, for SCENARIO recorded.",
)
@click.option("--outliers", default=0.0, help="Fraction of samples that are 100 mG off.")
@click.option("--magnet", "magnet_at_s", type=Number(0.0), help="A magnet passes at this second.")
@click.option("--step", "step_at_s", type=Number(0.0), help="The hard iron steps by 30 mG here.")
@click.option("--gap", "gap_at_s", type=Number(0.0), help="Two seconds without samples from here.")
@click.option(
    "--effect",
    "effects",
    multiple=True,
    help="ID, ID=STRENGTH (times its typical size) or ID=name=value,...: reference/effects.md.",
)
@click.option("--model", type=click.Path(path_type=Path), help="A repaired model, with --along.")
@click.option(
    "--along",
    "along_path",
    type=click.Path(path_type=Path),
    help="Recording whose motion --model follows.",
)
@columns_option
def command(**options: object) -> None:
    """Simulate SCENARIO: wam, mam or lam (wide, medium, low angular movement) of the MAGYC thesis,
    or recorded: a field on the motion of a recorded gyro stream (--gyro), without soft iron.
    With --model and --along instead: what a repaired model reads along a measured motion.

    FILE is a table (.csv, .csv.gz, .parquet) with the true attitude in ref_q{w,x,y,z}, or a byte
    stream of VNYMR sentences (.vnraw, .vnraw.gz). The truth goes into FILE.truth.json; columns
    that an effect needs (a motor's current, a temperature, ...) are invented and written as well.
    """
    wanted = _Options(**cast("dict[str, Any]", options))
    read = (wanted.gyro_path, wanted.model, wanted.along_path)
    for output in (wanted.output, wanted.truth):
        refuse_unwritable(output, read)
    if (wanted.model is None) != (wanted.along_path is None):
        raise AhrsdError("--model and --along need each other")
    if wanted.model is not None and wanted.along_path is not None:
        if wanted.scenario is not None:
            raise AhrsdError("--model and --along take no scenario")
        if unused := _given(_OF_A_SCENARIO):
            raise AhrsdError(
                f"--model and --along take no {' and no '.join(unused)}: motion, noise and effects "
                "are the recording's and the model's"
            )
        _simulate_along(wanted, wanted.model, wanted.along_path)
    else:
        _simulate_scenario(wanted)
    raise SystemExit(EXIT_DONE)


def _given(names: tuple[str, ...]) -> list[str]:
    """Those of these options that the command line has, as it spells them."""
    context = click.get_current_context()
    return [
        one.opts[0]
        for one in context.command.params
        if one.name in names
        and context.get_parameter_source(one.name) is click.core.ParameterSource.COMMANDLINE
    ]


@dataclass(frozen=True, slots=True)
class _Options:
    """What the command line says, by the options' names."""

    scenario: str | None
    output: Path
    motion: str
    seed: int
    seconds: float
    rate_hz: float | None
    mag_mg: float
    gyro_mrad: float
    hard_iron_as_read: bool
    gyro_path: Path | None
    outliers: float
    magnet_at_s: float | None
    step_at_s: float | None
    gap_at_s: float | None
    effects: tuple[str, ...]
    model: Path | None
    along_path: Path | None
    columns: ColumnMap

    @property
    def truth(self) -> Path:
        """The file with the truth, next to the recording."""
        return Path(f"{self.output}.truth.json")


def _simulate_scenario(wanted: _Options) -> None:
    """Write a scenario's experiment, its effects in it, and its truth beside it."""
    from ahrsd.offline.simulate import add_effects, write_experiment
    from ahrsd.simulation.scenarios import truth_json

    experiment, made_from = _experiment(wanted)
    truth: dict[str, object] = {}
    if wanted.effects:
        experiment, truth["effects"] = add_effects(experiment, wanted.effects, wanted.seed)
    wanted.truth.unlink(missing_ok=True)  # the last recording's is never next to this one
    write_experiment(wanted.output, experiment)
    write_json(str(wanted.truth), {**truth_json(experiment, made_from), **truth})
    count, name = len(experiment), experiment.name
    click.echo(f"{wanted.output}: {counted(count, 'sample')} of {name}; truth next to it")


def _experiment(wanted: _Options) -> tuple[Experiment, dict[str, object]]:
    """The scenario's experiment, and what makes the same one again."""
    from ahrsd.simulation import Iron, ScenarioSettings, simulate
    from ahrsd.simulation.scenarios import Disturbances, settings_json

    if wanted.scenario is None:
        raise AhrsdError("name a scenario (wam, mam, lam, recorded), or give --model and --along")
    if (wanted.scenario == _RECORDED) != (wanted.gyro_path is not None):
        raise AhrsdError("the scenario recorded and the option --gyro need each other")
    rate_hz = _USUAL_HZ if wanted.rate_hz is None else wanted.rate_hz
    if not (0 < wanted.seconds * rate_hz < _MOST_SAMPLES):
        raise AhrsdError(f"--seconds times --rate must be positive and below {_MOST_SAMPLES:g}")
    try:
        disturbances = Disturbances(
            outlier_fraction=wanted.outliers,
            magnet_at_s=wanted.magnet_at_s,
            step_at_s=wanted.step_at_s,
            gap_at_s=wanted.gap_at_s,
        )
        if wanted.gyro_path is not None:
            made = _recorded(wanted.gyro_path, wanted, disturbances)
            return made, {"gyro": wanted.gyro_path.name, "seed": wanted.seed}
        settings = ScenarioSettings(
            scenario=wanted.scenario,
            motion=wanted.motion,
            seed=wanted.seed,
            samples=round(wanted.seconds * rate_hz),
            rate_hz=rate_hz,
            noise_mag_gauss=wanted.mag_mg * _MG,
            noise_gyro_rad_s=wanted.gyro_mrad * _MRAD,
            iron=Iron(offset_behind_iron=wanted.hard_iron_as_read),
            disturbances=disturbances,
        )
        return simulate(settings), settings_json(settings)
    except ValueError as error:
        raise AhrsdError(str(error)) from None


def _recorded(path: Path, wanted: _Options, disturbances: Disturbances) -> Experiment:
    """[L]'s experiment on the longest stretch without a gap; the recorded rates are the truth."""
    import numpy as np

    from ahrsd.recording.table import read_table
    from ahrsd.simulation.scenarios import disturbed, generator, simulate_recorded

    table = read_table(path, columns=wanted.columns)
    ends = np.array([*table.starts, len(table.rows)])
    longest = int(np.argmax(np.diff(ends)))
    rows = slice(ends[longest], ends[longest + 1])
    time_s, gyro = table.rows.time_s[rows], table.rows.gyro_b_rad_s[rows]
    kept = time_s <= time_s[0] + wanted.seconds
    made = simulate_recorded(
        time_s[kept], gyro[kept], seed=wanted.seed, noise_mag_gauss=wanted.mag_mg * _MG
    )
    return disturbed(made, disturbances, generator(wanted.seed, 3))


def _simulate_along(wanted: _Options, model_path: Path, recording: Path) -> None:
    """Write a table of what a repaired model reads along a recording, and its truth beside it."""
    from ahrsd.diagnosis.repaired_model.injection import terms_json
    from ahrsd.offline.diagnose import load_model, load_track
    from ahrsd.offline.simulate import simulate_along_motion, write_columns
    from ahrsd.recording.table import TABLE_SUFFIXES, is_table

    output, seed = wanted.output, wanted.seed
    if not is_table(output):
        raise AhrsdError(f"{output}: the name must end in one of {', '.join(TABLE_SUFFIXES)}")
    model = load_model(model_path)
    read, notes = load_track(recording, wanted.rate_hz, columns=wanted.columns)
    columns, refused = simulate_along_motion(model, recording, read, seed)
    for note in [*notes, *refused]:
        click.echo(f"{recording}: {note}", err=True)
    wanted.truth.unlink(missing_ok=True)
    write_columns(output, columns)
    truth = {
        "schema": "ahrsd.truth/1",
        "name": f"{model_path.name} along {recording.name}, seed {seed}",
        "soft_iron": model.calibration.soft_iron.tolist(),
        "hard_iron_gauss": model.calibration.hard_iron_gauss.tolist(),
        "gyro_bias_rad_s": model.calibration.gyro_bias_rad_s.tolist(),
        "effects": terms_json(model.terms),
        "made_from": {"model": model_path.name, "along": recording.name, "seed": seed},
    }
    write_json(str(wanted.truth), truth)
    click.echo(
        f"{output}: {counted(len(columns['time_s']), 'sample')} of {truth['name']}; truth next to "
        "it"
    )
