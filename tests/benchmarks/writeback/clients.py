"""Random histories of two clients beside a daemon that writes (support: client_histories).

    python tests/benchmarks/writeback/clients.py
        [--histories N] [--first SEED] [--passes] [--json FILE]

Some 375 commands of clients each; with `--passes` the owner may write what calibrates. Exit code 1
where anything was seen that must not be.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

sys.path.extend(map(str, (Path(__file__).parents[2] / "support").glob("**/")))

from client_histories import ClientHistory


def main() -> int:
    """Play the histories; what was seen that must not be."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--histories", type=int, default=300)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--passes", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    wrong: Counter[str] = Counter()
    states: Counter[str] = Counter()
    asked, let_through, bad = 0, 0, []
    for seed in range(options.first, options.first + options.histories):
        history = ClientHistory(seed, passes=options.passes)
        history.play()
        asked += history.asked
        let_through += history.let_through
        wrong += history.wrong
        states.update(history.run.states)
        if history.wrong:
            bad.append(seed)
        done = seed - options.first + 1
        seen = f"{asked} commands, wrong: {dict(wrong)} {bad[:5]}"
        print(f"\r{done} of {options.histories}, {seen} ", end="", file=sys.stderr)
    print(file=sys.stderr)
    found = {"histories": options.histories, "first_seed": options.first, "commands": asked}
    found |= {"passes": options.passes, "let_through": let_through}
    found |= {"wrong": dict(wrong), "seeds": bad, "states": dict(states)}
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
