"""What untouched real recordings leave: the table of `ahrsd/diagnosis/rules/ordinary.py`.

    python tests/benchmarks/diagnosis/bench_ordinary.py --measured SIZES.json [--only WORD ...]
    python tests/benchmarks/diagnosis/bench_ordinary.py
        --table SIZES.json [MORE.json ...] [--out FILE.md]

The first diagnoses the recordings beside the project and keeps the sizes of what is left (some ten
minutes of CPU; it goes on where it stopped).  The second makes the table of the untouched ones,
prints it as it stands in the module, and judges every recording twice: by the whole table, and by
the table without the data set that the recording is of.  The disturbed ones are never in a table;
their cause is withheld where it is known, for else it is named and not left.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.rules.engine import diagnose
from ahrsd.diagnosis.rules.ordinary import Row, Table, held_against, is_course_on_sensor, table_of
from ahrsd.diagnosis.rules.remainder_sizes import Left, Size
from ahrsd.errors import RecordingError
from ahrsd.offline.diagnose import load_track

RECORDINGS = Path(__file__).parents[3] / ".." / "shared" / "recordings"
FOLDERS = ("broad", "repoimu", "fiumarg", "arducopter", "vn100", "vn100_distorters")
#: by the recordings' README, parts of names: something was put on or stands there, a current flows
DISTURBED = ("_disturbed_", "vn7", "vn30", "log171_MAG2")
#: of these it says that something changed while they were made, and not what
DOUBTFUL = ("hand_2023_thumatti", "hand_2023_ashutosh")
#: stood still: nothing but noise is to be seen
AT_REST = ("static_2025", "F00379")
#: parts of names: the columns, or the effects, that are withheld besides
COLUMNS = {"log171_MAG2": ("motor_current_a", "throttle", "battery_v")}
STEPS = ("hard_iron_step", "soft_iron_step", "field_step", "hard_iron_drift", "field_anomaly",
         "switched_device")  # fmt: skip
NAMES = {"attached_magnet": STEPS}


@dataclass(frozen=True)
class Measured:
    """One diagnosis: its recording, the names given, and what is left; None where nothing is.

    on_sensor: whether that is located as a course in time on the sensor
    """

    name: str
    given: list[str]
    left: Left | None
    on_sensor: bool

    @property
    def kind(self) -> str:
        """Untouched, disturbed, doubtful or at rest."""
        for words, kind in ((DISTURBED, "disturbed"), (DOUBTFUL, "doubtful"), (AT_REST, "at rest")):
            if any(word in self.name for word in words):
                return kind
        return "untouched"

    @property
    def data_set(self) -> str:
        """The folder; drives of one car and hands of one person are told apart by nothing."""
        return self.name.split("/")[0]

    @property
    def of_table(self) -> Left:
        """What counts: nothing where nothing is left."""
        return self.left or Left((), 0.0, 0.0, 0.0, 0.0)


def left_of(found: Diagnosis) -> Left | None:
    """The sizes that the answer tells."""
    one = found.unexplained.ordinary
    if one is None:
        return None
    sizes = (
        Size(part.component, part.size, part.heading_deg, part.evidence_nats)
        for part in one.components
    )
    return Left(tuple(sizes), one.field_gauss, one.heading_deg, one.gyro_rad_s, one.beside_gauss)


def measured(name: str, path: Path) -> Iterator[Measured]:
    """The recording as it is, and with its known cause withheld."""
    track, _ = load_track(path)
    yield of_diagnosis(name, diagnose(track))
    for word, columns in COLUMNS.items():
        if word in name:
            kept = {k: v for k, v in track.covariates.items() if k not in columns}
            found = diagnose(replace(track, covariates=kept))
            yield of_diagnosis(f"{name}, its current withheld", found)
    for word, names in NAMES.items():
        if word in name:
            few = {k: v for k, v in EFFECTS.items() if k not in names}
            yield of_diagnosis(f"{name}, no step in the library", diagnose(track, library=few))


def of_diagnosis(name: str, found: Diagnosis) -> Measured:
    names = [one.effect for one in found.findings]
    return Measured(name, names, left_of(found), is_course_on_sensor(found.unexplained))


def measure(out: Path, words: Sequence[str]) -> None:
    """Diagnose what is not in the file yet; written after each."""
    known = {} if not out.exists() else json.loads(out.read_text(encoding="utf-8"))
    paths = sorted(p for folder in FOLDERS for p in (RECORDINGS / folder).glob("*.csv.gz"))
    if not paths:
        sys.exit(f"{RECORDINGS}: no recordings there; the table can only be measured on them")
    for path in paths:
        name = f"{path.parent.name}/{path.name.removesuffix('.csv.gz')}"
        side = ".gps" in name or "vnraw" in name
        if side or name in known or not any(word in name for word in words):
            continue
        try:
            for one in measured(name, path):
                known[one.name] = asdict(one)
                print(f"{one.name}: {', '.join(one.given) or 'no name'}; {size_text(one.left)}")
        except (RecordingError, ValueError) as why:
            print(f"{name}: {why}")
        out.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


def size_text(left: Left | None) -> str:
    if left is None:
        return "no course left"
    return f"{1e3 * left.field_gauss:.1f} mG, {left.heading_deg:.2f} deg"


def read(files: Sequence[Path]) -> list[Measured]:
    """What was measured."""
    out = []
    for file in files:
        for one in json.loads(file.read_text(encoding="utf-8")).values():
            out.append(Measured(**{**one, "left": _left(one["left"])}))
    return out


def _left(value: Mapping[str, Any] | None) -> Left | None:
    if value is None:
        return None
    return Left(**{**value, "sizes": tuple(Size(**size) for size in value["sizes"])})


def literal(table: Table) -> str:
    """The table as Python."""

    def row(one: Row) -> str:
        return f"Row({one.median:.3e}, {one.spread:.3f}, {one.seen}, {one.asked})"

    lines = [f"recordings={table.recordings},", "components={"]
    lines += [f'    "{name}": {row(one)},' for name, one in table.components.items()]
    lines.append("},")
    lines += [f"{k}={row(getattr(table, k))}," for k in ("field", "heading", "gyro", "beside")]
    return "\n".join(["TABLE = Table(", *(f"    {line}" for line in lines), ")"])


def judged(all_of: Sequence[Measured]) -> list[str]:
    """A row of Markdown a recording, and what that makes of each kind."""
    untouched = [one for one in all_of if one.kind == "untouched"]
    whole = table_of([one.of_table for one in untouched])
    rows = [
        "| recording | kind | left | by the whole table | without its data set | why |",
        "|---|---|---|---|---|---|",
    ]
    count: dict[str, list[bool]] = {}
    for one in all_of:
        if one.left is None:
            rows.append(f"| {one.name} | {one.kind} | no course | | | |")
            continue
        others = [other.of_table for other in untouched if other.data_set != one.data_set]
        tables = (whole, table_of(others))
        by = [held_against(one.left, table, on_sensor=one.on_sensor) for table in tables]
        said = ["ordinary" if found.within else "beyond" for found in by]
        rows.append(
            f"| {one.name} | {one.kind} | {size_text(one.left)} | {said[0]} | {said[1]} | "
            f"{by[0].why or by[1].why or ''} |"
        )
        count.setdefault(f"{one.kind}, whole table", []).append(by[0].within)
        count.setdefault(f"{one.kind}, without its data set", []).append(by[1].within)
    totals = [f"{kind}: {sum(seen)} of {len(seen)} ordinary" for kind, seen in count.items()]
    return [*rows, "", *totals]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--measured", type=Path, help="diagnose, and keep the sizes in this file")
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names")
    parser.add_argument("--table", nargs="*", type=Path, default=[], help="files of sizes")
    parser.add_argument("--out", type=Path, help="the verdicts as a table of Markdown")
    given = parser.parse_args()
    if given.measured is not None:
        measure(given.measured, given.only)
    if given.table:
        all_of = read(given.table)
        print(literal(table_of([one.of_table for one in all_of if one.kind == "untouched"])))
        text = "\n".join(judged(all_of))
        print(text)
        if given.out:
            given.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
