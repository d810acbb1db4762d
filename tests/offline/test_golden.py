"""Golden replays: the expected result of each stream in fixtures/replays/golden.toml, decision
by decision.

Counts, gates, states and the hash of all decisions are compared on every Python and processor. The
bytes of the streams are compared only with the arithmetic on which they were made (reason:
tests/support/files/golden.py).
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tomllib
from pathlib import Path

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


def test_at_least_thirty_streams_exist_ten_of_them_with_faults():
    assert set(FACTS) == set(golden.STREAMS)
    assert len(FACTS) >= 30
    assert sum(bool(one.setup.faults) for one in golden.STREAMS.values()) >= 10
    assert sum(path.stat().st_size for path in golden.FOLDER.iterdir()) < 2_500_000


@pytest.mark.parametrize("name", FACTS)
def test_stream_replays_to_its_expected_facts(found, name):
    expected, seen = FACTS[name], found(name)
    assert set(seen) == set(expected)
    for key in set(expected) - {"sha256", *NUMBERS}:
        assert seen[key] == expected[key], key
    for key in set(expected) & set(NUMBERS):
        assert seen[key] == pytest.approx(expected[key], rel=1e-4, abs=1e-6), key


@pytest.mark.parametrize("name", FACTS)
def test_hash_of_the_decisions_is_reproduced(found, name):
    why = f"the hashes were made on {ARITHMETIC}, this is {golden.arithmetic()}"
    assert found(name)["sha256"] == FACTS[name]["sha256"], why


@pytest.mark.parametrize("kernels", ["Prescott", pytest.param("Nehalem", marks=pytest.mark.slow)])
def test_hash_of_the_decisions_is_the_same_with_older_processor_kernels(kernels):
    """OpenBLAS has kernels per processor; with those of an older one the last digits differ."""
    names = ["clean_rov_binary", "clean_narrow", "fault_iron"]
    code = "import golden, sys; print(*(golden.found_in(name)['sha256'] for name in sys.argv[1:]))"
    folder = Path(golden.__file__).parent
    paths = [str(folder), str(folder.parents[2]), os.environ.get("PYTHONPATH", "")]
    ended = subprocess.run(
        [sys.executable, "-c", code, *names],
        env=os.environ
        | {"OPENBLAS_CORETYPE": kernels, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        check=False,
        capture_output=True,
        text=True,
    )
    assert ended.stdout.split() == [FACTS[name]["sha256"] for name in names], ended.stderr


def test_faults_of_the_streams_appear_in_their_facts():
    """The streams differ in the faults applied to them."""
    assert len({facts["sha256"] for facts in FACTS.values()}) == len(FACTS)
    assert {name for name, facts in FACTS.items() if facts["restarts"]} == {
        "fault_reset", "fault_clock_wrap",
    }  # fmt: skip
    for name in ("fault_byte_drop", "fault_bit_flip", "fault_mute", "fault_clock_step"):
        assert FACTS[name]["gaps"] > 0, name
    for name in ("fault_bit_flip", "fault_noise_insert", "fault_byte_drop"):
        assert FACTS[name]["rejected"] > 0, name
    for name in ("fault_garbage", "fault_wrong_rate"):  # not even the shape of a message remains
        assert FACTS[name]["samples"] < 0.95 * FACTS["clean_tumble_vnymr"]["samples"], name


@pytest.mark.parametrize("name", ["clean_tumble_vnymr", "fault_garbage"])
def test_stream_can_be_generated_again_from_its_description(name, tmp_path, monkeypatch):
    kept = golden.path_of(name).read_bytes()
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    golden.make_stream(name)
    made = golden.path_of(name).read_bytes()
    if golden.arithmetic() == ARITHMETIC:
        assert hashlib.sha256(made).hexdigest() == hashlib.sha256(kept).hexdigest()
    assert len(made) == pytest.approx(len(kept), rel=0.01)
