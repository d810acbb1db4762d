"""The vehicle of `tests/support/simulated/vehicle.py`, made once."""

from __future__ import annotations

import pytest
from vehicle import Vehicle, drive, truth

from ahrsd.evaluation import StoredCalibration


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    return drive()


@pytest.fixture(scope="session")
def perfect() -> StoredCalibration:
    return truth()
