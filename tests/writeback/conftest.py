"""Rigs for the tests of the write-back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from writeback_rig import Device, Rig

from ahrsd.writeback.policy import WriteBackPolicy
from ahrsd.writeback.states import Mode
from ahrsd.writeback.trial import TrialPolicy


@pytest.fixture
def make_rig() -> Callable[..., Rig]:
    """`make_rig(mode, **policy)`: a rig that is not connected yet."""

    def make(mode: Mode = Mode.COMMIT, device: Device | None = None, **policy: Any) -> Rig:
        defaults: dict[str, Any] = {"trial": TrialPolicy(duration_s=600.0)}
        return Rig(WriteBackPolicy(mode=mode, **{**defaults, **policy}), device)

    return make
