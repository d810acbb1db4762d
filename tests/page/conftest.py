"""Statuses as a daemon told them beside an emulated device, and a page that is asked without one.

`gathering`: the circle is nearly shown, no held-out segment yet. `qualified`: a candidate waits.
"""

from __future__ import annotations

import copy
import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ahrsd.page.app import Heard

HERE = Path(__file__).parent


def status_of(name: str) -> dict[str, Any]:
    return json.loads((HERE / f"{name}.json").read_text())


@pytest.fixture
def gathering() -> dict[str, Any]:
    return status_of("gathering")


@pytest.fixture
def qualified() -> dict[str, Any]:
    return status_of("qualified")


@pytest.fixture
def feed(qualified):
    """A feed that heard a candidate just now; a test may let it hear something else."""
    found = SimpleNamespace(heard=Heard(copy.deepcopy(qualified), time.monotonic()))
    found.hear = lambda status: setattr(found, "heard", Heard(status, time.monotonic()))
    return found
