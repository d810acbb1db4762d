"""Firmware profiles: what is chosen by register 4, and that the unknown may not be written."""

from __future__ import annotations

import pytest

from drivers.vn100.registers import profile_of


@pytest.mark.parametrize("version", ["2.1.0.0", "2.0.0.1", "2.1"])
def test_generation_2(version):
    profile = profile_of(version)
    assert (profile.generation, profile.writable, profile.startup_bias) == (2, True, 74)
    assert profile.tare
    assert profile.default(44) == (1, 3, 5)
    assert profile.has(74)
    assert not profile.has(43)
    assert not profile.has(227 - 21)


@pytest.mark.parametrize("version", ["3.1.0.0", "3.0.0.0"])
def test_generation_3(version):
    profile = profile_of(version)
    assert (profile.generation, profile.writable, profile.startup_bias) == (3, True, 43)
    assert not profile.tare
    assert profile.default(44) == (0, 1, 5)
    assert profile.default(21) == (0.234, 0.0, 0.4212, 0.0, 0.0, -9.79375)
    assert profile.has(43)
    assert not profile.has(74)
    assert not profile.has(22)


@pytest.mark.parametrize("version", ["", "1.1.83.0", "4.0.0.0", "30.1", "v3.1", "3.1.0.0-rc", "²"])
def test_unknown_firmware_is_observe_only(version):
    profile = profile_of(version)
    assert profile.generation == 0
    assert not profile.writable
    assert profile.startup_bias is None
    assert profile.has(23)


def test_gyro_bias_register_exists_on_both_generations():
    assert all(84 in profile_of(v).registers for v in ("2.1.0.0", "3.1.0.0"))
