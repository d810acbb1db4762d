"""The long form: coverage-guided fuzzing of one target with atheris.

    pip install atheris
    python tests/fuzz/fuzz.py TARGET [-max_total_time=3600] [more of libFuzzer's options]

New inputs that reach new code are written to fixtures/fuzz/TARGET; one that breaks something is
left as crash-HASH in the folder where this was started. Put it into the corpus together with the
repair: the short form (pytest tests/fuzz) runs the whole corpus.
"""

from __future__ import annotations

import sys
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["ahrsd", "drivers"]):
    from targets import TARGETS

CORPUS = Path(__file__).parents[2] / "fixtures" / "fuzz"


def main() -> None:
    """Fuzz until stopped."""
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        sys.exit(f"usage: fuzz.py TARGET [libFuzzer options]; targets: {', '.join(TARGETS)}")
    name = sys.argv.pop(1)
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    atheris.Setup([sys.argv[0], str(folder), "-max_len=4096", *sys.argv[1:]], TARGETS[name])
    atheris.Fuzz()


if __name__ == "__main__":
    main()
