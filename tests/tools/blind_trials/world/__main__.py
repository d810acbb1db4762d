"""`python -m blind_trials.world --cases N --seed S -o DIR --key FILE`: cases into DIR, truth into
FILE.

With --some FIRST LAST only those of the N cases, counted from 0, the last one not: together such
runs make what one makes.
"""

from __future__ import annotations

import argparse
import gzip
import json
from pathlib import Path

import numpy as np

from blind_trials.world.cases import make_case
from blind_trials.world.rings import RINGS, orders
from blind_trials.world.semireal import make_semireal, plan

_VECTORS = ("mag_{}_gauss", "gyro_{}_rad_s", "accel_{}_m_s2")


def csv_bytes(rows):
    """The table, gzipped; the same rows give the same bytes."""
    names = ["time_s", *(v.format(axis) for v in _VECTORS for axis in "xyz"), *rows.columns]
    table = np.column_stack([rows.time_s, rows.mag, rows.gyro, rows.force, *rows.columns.values()])
    formats = ["%.6f", *["%.7f"] * 3, *["%.8f"] * 3, *["%.5f"] * 3, *["%.6g"] * len(rows.columns)]
    line = ",".join(formats)
    text = "\n".join([",".join(names), *(line % tuple(row) for row in table.tolist())]) + "\n"
    return gzip.compress(text.encode(), compresslevel=6, mtime=0)


def write_case(folder, rows, spec):
    """`case.csv.gz` and `spec.json` in a folder of their own."""
    folder.mkdir(parents=True)
    (folder / "case.csv.gz").write_bytes(csv_bytes(rows))
    (folder / "spec.json").write_text(json.dumps(spec, indent=1) + "\n", encoding="utf-8")


def make_one(ring, what, entropy, folder, recordings):
    """Make and write one case; its truth."""
    if ring == "semireal":
        rows, spec, truth = make_semireal(recordings, *what, entropy)
    else:
        case = make_case(what, entropy)
        rows, spec, truth = case.rows, case.spec, case.truth
    write_case(Path(folder), rows, spec)
    return truth


def case_ids(cases, seed):
    """Names that say nothing."""
    rng = np.random.default_rng([seed, 1])
    found = {}
    while len(found) < cases:
        found[f"{rng.integers(2**32):08x}"] = None
    return list(found)


def make_ring(ring, cases, seed, output, recordings, some=None):
    """Write the cases, or some of them; their truths in the order of the names."""
    work = plan(cases, seed) if ring == "semireal" else orders(ring, cases, seed)
    names = case_ids(cases, seed)
    truths = {
        names[n]: make_one(ring, work[n], [seed, n], str(output / names[n]), recordings)
        for n in range(*(some or (0, cases)))
    }
    return [{"id": name, **truths[name]} for name in sorted(truths)]


def main(arguments=None):
    """The command."""
    parser = argparse.ArgumentParser(prog="blind_trials.world", description=__doc__)
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--ring", choices=[*RINGS, "semireal"], default="full")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--some", type=int, nargs=2, metavar=("FIRST", "LAST"))
    parser.add_argument("--recordings", default="../shared/recordings")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--key", type=Path, required=True)
    asked = parser.parse_args(arguments)
    seed = asked.seed
    if asked.ring == "semireal" and not Path(asked.recordings).is_dir():
        parser.error(f"{asked.recordings}: no such folder; name the real recordings' folder")
    cases = make_ring(asked.ring, asked.cases, seed, asked.output, asked.recordings, asked.some)
    key = {"schema": "ahrsd.challenge.key/1", "ring": asked.ring, "seed": seed, "cases": cases}
    asked.key.parent.mkdir(parents=True, exist_ok=True)
    asked.key.write_text(json.dumps(key, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
