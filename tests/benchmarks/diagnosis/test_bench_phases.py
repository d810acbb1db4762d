"""The benchmark of `diagnose` times functions that the engine has."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import bench_diagnose_time

from ahrsd.diagnosis.inference import diagnose as engine


def test_every_phase_is_a_function_of_the_engine() -> None:
    assert [name for name in bench_diagnose_time.PHASES if not hasattr(engine, name)] == []
