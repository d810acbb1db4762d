"""The decision log: plain values, bounded memory, a hash that says whether two runs agree."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from ahrsd.decisions import DecisionLog
from ahrsd.events import GateResult


def gate(value: float) -> GateResult:
    return GateResult("observability.score", value, 1.0, value > 1.0, 0.0, "", "turn")


def test_an_entry_is_what_the_contract_says():
    log = DecisionLog()
    log.add(120.0, "CANDIDATE", [gate(2.1)], hard_iron_gauss=[0.1, -0.2, 0.3])
    assert log.entries == [
        {
            "at_s": 120.0,
            "state": "CANDIDATE",
            "gates": [{"gate": "observability.score", "value": 2.1, "limit": 1.0, "ok": True}],
            "hard_iron_gauss": [0.1, -0.2, 0.3],
        }
    ]


def test_the_hash_is_that_of_the_entries_and_can_be_checked_by_others():
    log = DecisionLog()
    log.add(1.0, "OBSERVING", [gate(0.5)])
    log.add(2.0, "CANDIDATE", [gate(1.5)], reason="all gates open")
    expected = hashlib.sha256()
    for entry in log.entries:
        expected.update(json.dumps(entry, sort_keys=True).encode())
    assert log.sha256 == expected.hexdigest()
    assert log.count == 2


def test_what_differs_below_the_ninth_digit_is_the_same_and_above_is_not():
    hashes = []
    for value in (0.123456789, 0.1234567890004, 0.123456799):
        log = DecisionLog()
        log.add(1.0, "OBSERVING", [gate(value)])
        hashes.append(log.sha256)
    assert hashes[0] == hashes[1]
    assert hashes[0] != hashes[2]


def test_what_json_cannot_say_becomes_null():
    log = DecisionLog()
    log.add(1.0, "OBSERVING", [gate(float("nan")), gate(float("inf"))], more={"a": [np.nan, 1.0]})
    json.dumps(log.entries, allow_nan=False)
    assert [g["value"] for g in log.entries[0]["gates"]] == [None, None]
    assert log.entries[0]["more"] == {"a": [None, 1.0]}


def test_only_the_newest_are_kept_and_all_are_in_the_hash():
    short, whole = DecisionLog(keep=3), DecisionLog()
    for k in range(10):
        short.add(float(k), "OBSERVING")
        whole.add(float(k), "OBSERVING")
    assert [entry["at_s"] for entry in short.entries] == [7.0, 8.0, 9.0]
    assert [entry["at_s"] for entry in whole.entries] == [float(k) for k in range(10)]
    assert short.count == 10
    assert short.sha256 == whole.sha256
