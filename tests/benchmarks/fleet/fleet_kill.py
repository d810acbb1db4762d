"""A fleet of 200 recordings under 20 SIGKILLs of anything: every recording one row, exactly once.

    python tests/benchmarks/fleet/fleet_kill.py
        [--recordings 200] [--kills 20] [--cluster] [--seed 1]

Killed are the driver, its processes, and with --cluster the scheduler, its workers and theirs. A
reader reads all rows five times a second meanwhile. Exit 1 where a row is missing or twice, a file
that counts was not whole, or anything ran on after the death of its owner.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from fleet_kills import Cluster, Fleet, printed, summary, under_fire, write_archive


def main() -> int:
    words = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words.add_argument("--recordings", type=int, default=200)
    words.add_argument("--kills", type=int, default=20)
    words.add_argument("--seed", type=int, default=1)
    words.add_argument("--cluster", action="store_true")
    given = words.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="fleet-kill-"))
    begun = time.monotonic()
    write_archive(folder / "archive", given.recordings)
    cluster = Cluster(folder) if given.cluster else None
    fleet = Fleet(folder / "archive", folder / "out", cluster=cluster)
    try:
        reader = under_fire(fleet, given.recordings, given.kills, given.seed, 0.5)
    finally:
        fleet.stop()
        if cluster is not None:
            cluster.stop()
    found = summary(fleet, reader)
    print(printed(found))
    print(f"{time.monotonic() - begun:.0f} s")
    good = (
        found["rows"] == found["keys"] == found["recordings"] == given.recordings
        and not found["twice"]
        and not found["left_running"]
        and not found["partial_files"]
        and not found["faults"]
        and sum(found["kills"].values()) == given.kills
    )
    shutil.rmtree(folder)
    print("every recording has one row" if good else "NOT as it has to be")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
