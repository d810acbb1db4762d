"""`ahrsd fleet run` itself, whose recordings only take time: who is killed, who is interrupted and
what is left does not depend on what is done with a recording.

    python quick_fleet.py fleet run ARCHIVE -o OUT ...
"""

from __future__ import annotations

import sys
from pathlib import Path

from fleet_rows import held

import ahrsd.cli.recordings.fleet
from ahrsd.__main__ import main


def write_quick_archive(folder: Path, recordings: int, *, milliseconds: int) -> None:
    """Recordings of three vehicles that take so long each."""
    for number in range(recordings):
        own = folder / f"rov{number % 3}"
        own.mkdir(parents=True, exist_ok=True)
        (own / f"dive_{number}.mcap").write_bytes(bytes(milliseconds))


if __name__ == "__main__":
    ahrsd.cli.recordings.fleet.EXAMINER, ahrsd.cli.recordings.fleet.LOADS = held, ()  # type: ignore[assignment]
    main(sys.argv[1:])
