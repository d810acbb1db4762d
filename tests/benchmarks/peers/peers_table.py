"""Which peer is best, and the tables of bench_peers.py in markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ahrsd.montecarlo.summary import BOUNDED, SummaryRow

Found = Mapping[str, Any]
_ENOUGH = 10  # runs, to be the best of the peers
_WORDS = {"hard_iron_gauss": "hard iron", "soft_iron": "soft iron", "gyro_bias_rad_s": "gyro bias"}
_HEAD = (
    "| method | answers | hard iron, mG | / bound | soft iron, F | / bound "
    "| gyro bias, mrad/s | / bound | CPU, s |"
)


def paired(
    records: Sequence[Found], ours: str, peer: str, name: str
) -> tuple[float | None, float | None]:
    """RMSE of a peer over ours on the seeds that both answer, and its jackknife standard error."""
    pairs = []
    for record in records:
        errors = {r["method"]: r["errors"][name] for r in record["results"] if not r["failure"]}
        if errors.get(ours) is not None and errors.get(peer) is not None:
            pairs.append((errors[peer], errors[ours]))
    if len(pairs) < 2:
        return None, None
    theirs, own = np.square(pairs).T
    without = np.sqrt((theirs.sum() - theirs) / (own.sum() - own))
    n = len(pairs)
    error = float(np.sqrt((n - 1) / n * np.sum(np.square(without - without.mean()))))
    return float(np.sqrt(theirs.sum() / own.sum())), error


def best_peers(
    records: Sequence[Found], rows: Sequence[SummaryRow], peers: Sequence[str], ours: str
) -> dict[str, Found]:
    """By figure: the peer that is nearest to the bound, how far ours is ahead, and the room.

    Among the peers with at least ten runs, where there are so many.
    """
    by_name = {row.method: row for row in rows}
    enough = min(_ENOUGH, max(row.runs for row in rows))
    out: dict[str, Found] = {}
    for name in BOUNDED:
        ratios = {
            peer: ratio
            for peer in peers
            if by_name[peer].runs >= enough
            and (ratio := by_name[peer].against_bound[name].over_bound) is not None
        }
        if not ratios:
            continue
        best = min(ratios, key=lambda peer: ratios[peer])
        ahead, error = paired(records, ours, best, name)
        out[name] = {
            "peer": best,
            "answered": by_name[best].answered,
            "peer_over_bound": ratios[best],
            "ours_over_bound": by_name[ours].against_bound[name].over_bound,
            "standard_error": by_name[ours].against_bound[name].standard_error,
            "peer_over_ours": ahead,
            "peer_over_ours_error": error,
        }
    return out


def set_lines(name: str, rows: Sequence[SummaryRow]) -> list[str]:
    """One set: the bound, ours and the peers."""
    head = [f"\n### {name}\n", _HEAD, "|---" * _HEAD.count(" | ") + "|---|"]
    return [*head, _bound_line(rows[0]), *(_line(row) for row in rows)]


def _bound_line(row: SummaryRow) -> str:
    hard, soft, gyro = (row.against_bound[figure].bound for figure in BOUNDED)
    return f"| bound | | {number(hard, 1e3)} | | {number(soft)} | | {number(gyro, 1e3)} | | |"


def _line(row: SummaryRow) -> str:
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


def verdict_lines(sets: Sequence[tuple[str, Mapping[str, Found]]]) -> list[str]:
    """One row per set and figure: ours and the best peer against the bound, and the goals."""
    out = [
        "\n### Ours and the best peer\n",
        "| set | figure | best peer | its answers | it / bound | ours / bound | it / ours |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, best in sets:
        for figure, said in best.items():
            cells = (
                name,
                _WORDS[figure],
                f"`{said['peer']}`",
                str(said["answered"]),
                number(said["peer_over_bound"]),
                f"{number(said['ours_over_bound'])} ± {number(said['standard_error'])}",
                f"{number(said['peer_over_ours'])} ± {number(said['peer_over_ours_error'])}",
            )
            out.append(f"| {' | '.join(cells)} |")
    return out


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
