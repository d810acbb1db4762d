"""The short form of fuzzing: the whole corpus, and seeded mutations of it."""

import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from targets import TARGETS

CORPUS = Path(__file__).parents[2] / "fixtures" / "fuzz"
MUTATIONS = {"pipeline": 40, "capture": 60}  # the others are cheap
OTHERS = 300


def corpus(target):
    """Every input of a target."""
    return [path.read_bytes() for path in sorted((CORPUS / target).iterdir())]


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus(target):
    inputs = corpus(target)
    assert len(inputs) >= 2
    for data in [*inputs, b""]:
        TARGETS[target](data)


@pytest.mark.parametrize("target", TARGETS)
def test_mutations_of_the_corpus(target):
    rng = random.Random(f"ahrsd {target}")
    inputs = corpus(target)
    for _ in range(MUTATIONS.get(target, OTHERS)):
        TARGETS[target](mutated(rng, rng.choice(inputs), rng.choice(inputs)))


def mutated(rng, data, other):
    """Bytes changed, cut, doubled, spliced with another input; several times."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out) + 1)
        match rng.randrange(6):
            case 0 if out:
                out[at % len(out)] ^= 1 << rng.randrange(8)
            case 1:
                del out[at : at + rng.randint(1, 40)]
            case 2:
                out[at:at] = rng.randbytes(rng.randint(1, 20))
            case 3:
                out[at:at] = out[at : at + rng.randint(1, 200)]
            case 4:
                start = rng.randrange(len(other) + 1)
                out[at:at] = other[start : start + rng.randint(1, 300)]
            case 5:
                out[at : at + 4] = rng.choice((b"\xff" * 4, b"\0" * 4, b"nan,", b"1e99", b"-inf"))
    return bytes(out)
