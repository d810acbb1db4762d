"""The memory of a run is allocated at its start and does not change."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys

import pytest

from ahrsd.daemon.heap import needed_bytes, take_heap
from ahrsd.estimator.parameters import EstimatorParameters

MB = 1 << 20
GLIBC = pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallopt"), reason="another C library than glibc"
)


def run(text):
    """The last line that a separate process prints, as JSON."""
    head = (
        "import json, resource, threading\n"
        "import numpy as np\n"
        "from ahrsd.errors import ConfigError\n"
        "from ahrsd.daemon.heap import take_heap\n"
        "def rss(): return int(open('/proc/self/statm').read().split()[1]) * 4096 / 2**20\n"
        "def fill(n=700): return [np.ones(4000) for _ in range(n)]  # 32 kB each, 21 MB\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", head + text], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@GLIBC
def test_allocated_memory_is_resident_and_stays():
    before, taken, filled, emptied = run(
        "fill(); at = [rss()]\n"
        "take_heap(32 << 20); at.append(rss())\n"
        "kept = fill(); at.append(rss())\n"
        "del kept; at.append(rss())\n"
        "print(json.dumps(at))"
    )
    assert 31.0 < taken - before < 34.0
    assert abs(filled - taken) < 1.0
    assert abs(emptied - taken) < 1.0


@GLIBC
def test_threads_use_the_allocated_memory():
    taken, filled = run(
        "take_heap(32 << 20); at, kept = [rss()], []\n"
        "for _ in range(4):\n"
        "    one = threading.Thread(target=lambda: kept.append(fill(175))); one.start()\n"
        "    one.join()\n"
        "at.append(rss()); print(json.dumps(at))"
    )
    assert abs(filled - taken) < 2.0


@GLIBC
def test_missing_memory_is_reported_at_the_start():
    (said,) = run(
        "_, most = resource.getrlimit(resource.RLIMIT_AS)\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2**31, most))\n"
        "try: take_heap(2**31)\n"
        "except ConfigError as error: print(json.dumps([str(error)]))"
    )
    assert said == "estimator.window_steps: its 2048 MB of memory are not there; less of it"


def test_other_c_libraries_are_not_changed(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert take_heap(MB) is False


def test_larger_window_needs_more_memory():
    usual = EstimatorParameters()
    twice = EstimatorParameters(window_steps=2 * usual.window_steps)
    assert 20 * MB < needed_bytes(usual) < 32 * MB
    assert needed_bytes(twice) - needed_bytes(usual) == 512 * usual.window_steps


@GLIBC
def test_arrays_of_a_short_command_reuse_pages():
    """Page faults of a hundred arrays of 16 MB after the first: none."""
    faults, kept = run(
        "from ahrsd.daemon.heap import keep_heap\n"
        "def faults(): return resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "def hundred():\n"
        "    before = faults()\n"
        "    for _ in range(100): np.full(1 << 21, 1.0)\n"
        "    return faults() - before\n"
        "import ctypes\n"
        "ctypes.CDLL(None).mallopt(-3, 1 << 20)\n"
        "mapped = hundred()\n"
        "assert keep_heap()\n"
        "hundred()\n"
        "print(json.dumps([mapped, hundred()]))\n"
    )
    assert faults >= 100  # with or without huge pages
    assert kept <= 10
