"""Golden replays: what each stream of fixtures/replays/golden.toml must give, decision by decision.

Counts, gates and states are compared everywhere. The hash of all decisions is compared where the
arithmetic is the one on which it was made (tests/support/golden.py says why), whatever Python.
"""

from __future__ import annotations

import hashlib
import tomllib

import golden
import pytest

FACTS = tomllib.loads(golden.TABLE.read_text())
ARITHMETIC = FACTS.pop("arithmetic")
NUMBERS = ("hard_iron_gauss", "gyro_bias_rad_s")


@pytest.fixture(scope="module")
def found():
    """`found(name)`: each stream is replayed once."""
    cache = {}

    def get(name):
        if name not in cache:
            cache[name] = golden.found_in(name)
        return cache[name]

    return get


def test_there_are_thirty_and_ten_with_faults():
    assert set(FACTS) == set(golden.STREAMS)
    assert len(FACTS) >= 30
    assert sum(bool(one.setup.faults) for one in golden.STREAMS.values()) >= 10
    assert sum(path.stat().st_size for path in golden.FOLDER.iterdir()) < 2_500_000


@pytest.mark.parametrize("name", FACTS)
def test_a_stream_replays_to_its_facts(found, name):
    expected, seen = FACTS[name], found(name)
    assert set(seen) == set(expected)
    for key in set(expected) - {"sha256", *NUMBERS}:
        assert seen[key] == expected[key], key
    for key in set(expected) & set(NUMBERS):
        assert seen[key] == pytest.approx(expected[key], rel=1e-4, abs=1e-6), key


@pytest.mark.parametrize("name", FACTS)
def test_the_decisions_are_the_same_to_the_last_digit(found, name):
    if golden.arithmetic() != ARITHMETIC:
        pytest.skip(f"other arithmetic: {golden.arithmetic()}, the hashes are of {ARITHMETIC}")
    assert found(name)["sha256"] == FACTS[name]["sha256"]


def test_what_is_wrong_shows():
    """The streams differ in what was done to them."""
    assert len({facts["sha256"] for facts in FACTS.values()}) == len(FACTS)
    assert {name for name, facts in FACTS.items() if facts["restarts"]} == {
        "fault_reset", "fault_clock_wrap",
    }  # fmt: skip
    for name in ("fault_byte_drop", "fault_bit_flip", "fault_mute", "fault_clock_step"):
        assert FACTS[name]["gaps"] > 0, name
    for name in ("fault_bit_flip", "fault_noise_insert", "fault_byte_drop"):
        assert FACTS[name]["rejected"] > 0, name
    for name in ("fault_garbage", "fault_wrong_rate"):  # not even the shape of a message is left
        assert FACTS[name]["samples"] < 0.95 * FACTS["clean_tumble_vnymr"]["samples"], name


@pytest.mark.parametrize("name", ["clean_tumble_vnymr", "fault_garbage"])
def test_a_stream_is_made_as_the_table_says(name, tmp_path, monkeypatch):
    kept = golden.path_of(name).read_bytes()
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    golden.make_stream(name)
    made = golden.path_of(name).read_bytes()
    if golden.arithmetic() == ARITHMETIC:
        assert hashlib.sha256(made).hexdigest() == hashlib.sha256(kept).hexdigest()
    assert len(made) == pytest.approx(len(kept), rel=0.01)
