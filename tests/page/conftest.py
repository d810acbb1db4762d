"""Statuses of a daemon with an emulated device, and a page that is requested without one.

`gathering`: the circle is nearly complete, without a held-out segment so far. `qualified`: a
candidate waits.
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
    """A feed that has just received a candidate; a test may feed something else."""
    found = SimpleNamespace(heard=Heard(copy.deepcopy(qualified), time.monotonic()))
    found.hear = lambda status: setattr(found, "heard", Heard(status, time.monotonic()))
    return found
