"""The benchmark of `diagnose` times functions that the engine has."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import bench_diagnose_time


def test_every_phase_is_a_function_of_the_engine() -> None:
    phases = bench_diagnose_time.PHASES
    assert [name for name, module in phases.items() if not hasattr(module, name)] == []
