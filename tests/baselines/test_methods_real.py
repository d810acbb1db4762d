"""Real recordings of a VN-100: at rest nothing is answered, and circles agree where they can."""

from __future__ import annotations

import numpy as np
import pytest

from ahrsd.baselines import METHODS, MethodSettings, calibrate_with
from ahrsd.recording.table import read_table


@pytest.fixture(scope="module")
def blocks(recordings):
    return lambda name: list(read_table(recordings / "vn100" / f"{name}.csv.gz").blocks())


@pytest.mark.parametrize("method", METHODS)
def test_a_sensor_at_rest_is_refused(method, blocks):
    at_rest = blocks("static_2025_kiran_5min")
    result = calibrate_with(method, at_rest, field_norm_gauss=0.5)
    assert not result.converged
    assert result.hard_iron_gauss is None
    assert "hardly turned" in result.reason


def test_circles_determine_the_horizontal_hard_iron_and_say_that_the_rest_is_weak(blocks):
    circles = blocks("circles_2022_rahul")
    settings = MethodSettings(derivative="savgol")
    found = {
        method: calibrate_with(method, circles, settings=settings, field_norm_gauss=0.5)
        for method in ("magical-ls", "magical-nls", "magyc-bfg", "magyc-ifg", "tls", "fnp")
    }
    for method, result in found.items():
        assert result.converged, (method, result.reason)
        assert "weak motion" in result.reason
    horizontal = np.array([result.hard_iron_gauss[:2] for result in found.values()])
    assert np.allclose(horizontal, [-0.133, 0.328], atol=0.015)


def test_hand_waving_gives_two_kinematic_methods_one_answer(blocks):
    """All attitudes, indoors: soft iron near the identity, hard iron of some tens of mG."""
    waving = blocks("hand_2023_thumatti")
    settings = MethodSettings(derivative="savgol")
    a, b = (
        calibrate_with(method, waving, settings=settings) for method in ("magyc-bfg", "magical-bfg")
    )
    assert np.allclose(a.soft_iron, b.soft_iron, atol=0.02)
    assert np.linalg.norm(a.hard_iron_gauss - b.hard_iron_gauss) < 2e-3
    assert np.linalg.norm(a.soft_iron - np.eye(3)) < 0.1
