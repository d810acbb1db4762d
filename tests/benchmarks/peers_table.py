"""The tables of bench_peers.py, in markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ahrsd.montecarlo_summary import BOUNDED, Row

Found = Mapping[str, Any]
_WORDS = {"hard_iron_gauss": "hard iron", "soft_iron": "soft iron", "gyro_bias_rad_s": "gyro bias"}
_HEAD = (
    "| method | answers | hard iron, mG | / bound | soft iron, F | / bound "
    "| gyro bias, mrad/s | / bound | CPU, s |"
)


def set_lines(name: str, rows: Sequence[Row], best: Mapping[str, Found]) -> list[str]:
    """One set: the bound, ours and the peers, and which peer comes nearest to the bound in what."""
    out = [f"\n### {name}\n", _HEAD, "|---" * _HEAD.count(" | ") + "|---|", _bound_line(rows[0])]
    out += [_line(row) for row in rows]
    for figure, said in best.items():
        out.append(
            f"\nNearest to the bound in {_WORDS[figure]}: `{said['peer']}` "
            f"({said['answered']} answers), {number(said['peer_over_bound'])} times the bound, "
            f"{number(said['peer_over_ours'])} times ours on the same seeds."
        )
    return out


def _bound_line(row: Row) -> str:
    hard, soft, gyro = (row.against_bound[figure].bound for figure in BOUNDED)
    return f"| bound | | {number(hard, 1e3)} | | {number(soft)} | | {number(gyro, 1e3)} | | |"


def _line(row: Row) -> str:
    hard, soft, gyro = (row.against_bound[figure] for figure in BOUNDED)
    spread = "" if hard.standard_error is None else f" ± {number(hard.standard_error)}"
    doubted = f" ({row.unconverged} doubted)" if row.unconverged else ""
    cells = (
        f"`{row.method}`",
        f"{row.answered}/{row.runs}{doubted}",
        number(hard.rmse, 1e3),
        number(hard.over_bound) + spread,
        number(soft.rmse),
        number(soft.over_bound),
        number(gyro.rmse, 1e3),
        number(gyro.over_bound),
        number(row.cpu_s),
    )
    return f"| {' | '.join(cells)} |"


def time_lines(timed: Sequence[Found]) -> list[str]:
    """Processor time; nothing where none was measured."""
    if not timed:
        return []
    return [
        "\n### Processor time, seconds\n",
        f"| {' | '.join(timed[0])} |",
        "|---" * len(timed[0]) + "|",
        *(f"| {' | '.join(_cell(value) for value in row.values())} |" for row in timed),
    ]


def _cell(value: object) -> str:
    return number(value) if isinstance(value, float) else str(value)


def number(value: float | None, factor: float = 1.0) -> str:
    """Three digits."""
    return "-" if value is None else f"{value * factor:#.3g}".rstrip(".")
