"""What a whole replay costs: `python tests/benchmarks/daemon/bench_replay.py [RECORDING ...]`.

Processor time of one core from bytes to decisions, without start-up, as a multiple of real time at
40 Hz, the rate of most of the recordings, and who spends it:

    parse     deframing and decoding, in the session
    samples   clock, gaps, un-mapping
    estimate  the estimator
    evidence  what is remembered, judged and passed through the gates
    rest      write-back, events, decision log

`bound` is parsing alone, measured in the same run on the same machine: the ratio of the two does
not depend on how fast or busy the machine is.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ahrsd.config.config import Config
from ahrsd.core.estimation import Calibrator
from ahrsd.estimator.online import Estimator
from ahrsd.evidence.collector import EvidenceCollector
from ahrsd.offline.replay import replay
from ahrsd.recording.bytestream import read_chunks
from ahrsd.stream.assembler import Stream
from drivers.vn100.decode import decode
from drivers.vn100.deframer import Deframer
from drivers.vn100.session import Session

RATE_HZ = 40.0
RECORDINGS = Path(__file__).parents[4] / "shared" / "recordings" / "vn100"
NAMES = (
    "walk_square_2024_sazgar.vnraw.gz",
    "drive_2022_rahul.vnraw.gz",
    "hand_2023_thumatti.vnraw.gz",
    "punch_2024_shaked.vnraw.gz",
    "static_2025_kiran_5min.vnraw.gz",
    "F00379.vnbin.gz",
)
PARTS: tuple[tuple[str, type, tuple[str, ...]], ...] = (
    ("parse", Session, ("receive",)),
    ("samples", Stream, ("take",)),
    ("estimate", Estimator, ("add", "estimate")),
    ("evidence", EvidenceCollector, ("split", "add", "evaluate")),
    ("evidence", Calibrator, ("judge_estimate",)),
)


@dataclass(frozen=True)
class Result:
    """CPU seconds of a replay, its parts and the bound; `factor` is over real time at 40 Hz."""

    name: str
    samples: int
    total_s: float
    bound_s: float
    parts_s: dict[str, float]

    @property
    def factor(self) -> float:
        """How many times faster than 40 samples a second."""
        return self.samples / RATE_HZ / self.total_s

    @property
    def ratio(self) -> float:
        """Whole replay over parsing alone."""
        return self.total_s / self.bound_s

    def __str__(self) -> str:
        shares = "  ".join(f"{n} {100 * s / self.total_s:2.0f} %" for n, s in self.parts_s.items())
        return (
            f"{self.name:36} {self.total_s:5.2f} s  {self.factor:4.0f} x real time  "
            f"{self.ratio:4.1f} x parsing   {shares}"
        )


class Meter:
    """CPU time by part; what a part calls of another counts for the inner one."""

    def __init__(self) -> None:
        self.spent_s: dict[str, float] = {}
        self._stack: list[str] = ["rest"]
        self._since_s = time.process_time()

    def switch(self, part: str | None) -> None:
        """Enter a part, or leave the innermost one with None."""
        now_s = time.process_time()
        top = self._stack[-1]
        self.spent_s[top] = self.spent_s.get(top, 0.0) + now_s - self._since_s
        self._since_s = now_s
        if part is None:
            self._stack.pop()
        else:
            self._stack.append(part)

    def metered(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function with its time taken."""

        def call(*args: object, **more: object) -> object:
            self.switch(part)
            try:
                return function(*args, **more)
            finally:
                self.switch(None)

        return call


@contextmanager
def meter() -> Iterator[Meter]:
    """Take the time of every part while it lasts."""
    found = Meter()
    saved = [(kind, name, getattr(kind, name)) for _, kind, names in PARTS for name in names]
    try:
        for part, kind, names in PARTS:
            for name in names:
                setattr(kind, name, found.metered(part, getattr(kind, name)))
        yield found
    finally:
        for kind, name, function in saved:
            setattr(kind, name, function)


def parse_alone(path: Path) -> float:
    """CPU seconds to unpack, deframe and decode every message."""
    start_s = time.process_time()
    deframer = Deframer()
    for chunk in read_chunks(path):
        for frame in deframer.feed(chunk):
            decode(frame)
    return time.process_time() - start_s


def measure(path: Path) -> Result:
    """One replay with its bound before and behind it, so that both see the same machine."""
    bound = [parse_alone(path)]
    start_s = time.process_time()
    core = replay(path, Config()).core
    total_s = time.process_time() - start_s
    bound.append(parse_alone(path))
    with meter() as metered:
        start_s = time.process_time()
        replay(path, Config())
        metered_s = time.process_time() - start_s
    order = ("parse", "samples", "estimate", "evidence", "rest")
    parts = {n: metered.spent_s.get(n, 0.0) * total_s / metered_s for n in order}
    samples = core.stream.facts.samples
    return Result(path.name, samples, total_s, sum(bound) / len(bound), parts)


def start_up_s() -> float:
    """Wall seconds of `import` of what `ahrsd replay` needs, in a new interpreter."""
    import subprocess

    code = (
        "import time; start = time.process_time(); "
        "import ahrsd.offline.replay, ahrsd.report.summary; "
        "print(time.process_time() - start)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout)


def main() -> None:
    """Print a line per recording."""
    paths = [Path(name) for name in sys.argv[1:]] or [RECORDINGS / name for name in NAMES]
    print(f"start-up (imports): {start_up_s():.2f} s CPU")
    replay(paths[0], Config())  # what is loaded on first use is start-up too
    for path in paths:
        print(measure(path))


if __name__ == "__main__":
    main()
