"""Runs in the peers' own environment: readings in, what each method says out.

    python peer_process.py MAGYC_PEERS.PY '["READINGS.NPZ", "ANSWERS.JSONL", METHOD, ...]' ...

READINGS: mag (N, 3) mG, gyro (N, 3) rad/s, t (N,) s, rph (N, 3) rad, m0 (3,) mG. Each answer is one
line as soon as it is there: hard iron in mG, soft iron, gyro bias in rad/s, processor seconds, or
the failure in words. Knows nothing of this project: the two environments cannot share a numpy.

MENDED is Fang's fit as the package has it, whose sign of the soft iron is left to chance, with
that sign chosen so that the trace is positive.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

FANG = "ellipsoid_fit_fang"
MENDED = "ellipsoid_fit_fang mended"
SMOOTHED = " +sg"
Answer = tuple[Any, Any, Any]


def mended(answer: Answer) -> Answer:
    """The same ellipsoid with a soft iron of positive trace."""
    hard, soft, bias = answer
    return hard, None if soft is None else soft * np.sign(np.trace(soft)), bias


def methods(peers: ModuleType, mag: Any, gyro: Any, rest: tuple[Any, ...]) -> dict[str, Any]:
    """The tool's methods by name, and the mended ellipsoid on readings as they are and smoothed."""
    known: dict[str, Callable[[], Answer]] = peers.make(mag, gyro, *rest)
    smooth = peers.make(peers.sg(mag), peers.sg(gyro), *rest)
    return known | {
        MENDED: lambda: mended(known[FANG]()),
        MENDED + SMOOTHED: lambda: mended(smooth[FANG]()),
    }


def answer(name: str, ask: Callable[[], Answer]) -> dict[str, object]:
    """One method's line."""
    begun_s = time.process_time()
    said: dict[str, object] = {"method": name, "failure": None}
    try:
        parts = [None if part is None else np.asarray(part, float) for part in ask()]
    except Exception as error:  # noqa: BLE001 - whatever a foreign package throws is its failure
        words = str(error).strip().splitlines()
        said["failure"] = words[0] if words else type(error).__name__
        parts = []
    said["cpu_s"] = time.process_time() - begun_s
    if any(part is not None and not np.isfinite(part).all() for part in parts):
        return said | {"failure": "the answer is not finite"}
    listed = [None if part is None else part.tolist() for part in parts]
    return said | dict(zip(("hard_iron_mg", "soft_iron", "gyro_bias_rad_s"), listed))


def main(tool: str, *orders: str) -> None:
    """Do the orders, one after the other, methods in the order in which they are named."""
    spec = importlib.util.spec_from_file_location("magyc_peers", tool)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{tool}: not a Python file")
    peers = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(peers)
    for order in orders:
        readings, answers, *names = json.loads(order)
        data = np.load(readings)
        known = methods(peers, data["mag"], data["gyro"], (data["t"], data["rph"], data["m0"]))
        with open(answers, "a", encoding="utf-8") as file:  # noqa: PTH123 - a plain script
            for name in names:
                file.write(json.dumps(answer(name, known[name])) + "\n")
                file.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
