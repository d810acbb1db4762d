"""The short form: a few of the streams, and those that once ended in an exception or a warning."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from broken_sensors import broken, check

#: what was wrong with them: no attitude, no reading, no step, a field of zero, times far apart;
#: so were 0, 12, 46 and 113 of the long ones
ONCE_WRONG = [39, 106, 278]
LONG = [0, 12, 14, 46, 90, 113, 276, 70078]


@pytest.mark.parametrize("seed", range(1000, 1012))
def test_the_core_ends_in_words(seed):
    assert check(seed, diagnosed=False)


@pytest.mark.parametrize(
    "seed", [*ONCE_WRONG, *(pytest.param(seed, marks=pytest.mark.slow) for seed in LONG)]
)
def test_the_diagnosis_ends_in_words(seed):
    assert check(seed, diagnosed=True)


def test_a_seed_gives_the_same_stream():
    (first, names), (again, _) = broken(7), broken(7)
    assert names == "clipped noise_only"
    assert (first.mag == again.mag).all()
