"""The decision log: plain values, bounded memory, and a hash that shows whether two runs agree."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from ahrsd.core.decision_log import DecisionLog, hashed_form
from ahrsd.events import GateResult


def gate(value: float) -> GateResult:
    return GateResult("observability.score", value, 1.0, value > 1.0, 0.0, "", "turn")


def test_entry_has_the_documented_form():
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


def test_hash_can_be_recomputed_from_the_entries():
    log = DecisionLog()
    log.add(1.0, "OBSERVING", [gate(0.5)])
    log.add(2.0, "CANDIDATE", [gate(1.5)], reason="all gates open")
    expected = hashlib.sha256()
    for entry in log.entries:
        expected.update(hashed_form(entry))
    assert log.sha256 == expected.hexdigest()
    assert log.count == 2


def hash_of(value: float) -> str:
    log = DecisionLog()
    log.add(1.0, "OBSERVING", [gate(value)])
    return log.sha256


def test_hash_ignores_processor_dependent_rounding():
    assert hash_of(0.123456789) == hash_of(0.123456789 * (1 + 3e-9))
    assert hash_of(0.123456789) != hash_of(0.123556789)
    assert hash_of(2.2e-14) == hash_of(0.0) == hash_of(-1e-15)  # what is left of a difference
    assert hash_of(0.000321) != hash_of(0.000322)
    assert hash_of(20.7) != hash_of(20.8)


def test_hash_input_has_the_documented_bytes():
    log = DecisionLog()
    log.add(120.123456, "CANDIDATE", [gate(2.1000049)], hard_iron_gauss=[0.10220049, -1e-9])
    assert log.entries[0]["hard_iron_gauss"] == [0.10220049, -1e-9]
    assert hashed_form(log.entries[0]) == (
        b'{"at_s": 120.123456, "gates": [{"gate": "observability.score", "limit": 1.0, "ok": true, '
        b'"value": 2.1}], "hard_iron_gauss": [0.1022, 0.0], "state": "CANDIDATE"}'
    )


def test_values_that_json_cannot_represent_become_null():
    log = DecisionLog()
    log.add(1.0, "OBSERVING", [gate(float("nan")), gate(float("inf"))], more={"a": [np.nan, 1.0]})
    json.dumps(log.entries, allow_nan=False)
    assert [g["value"] for g in log.entries[0]["gates"]] == [None, None]
    assert log.entries[0]["more"] == {"a": [None, 1.0]}


def test_only_the_newest_entries_are_kept_and_all_are_in_the_hash():
    short, whole = DecisionLog(keep=3), DecisionLog()
    for k in range(10):
        short.add(float(k), "OBSERVING")
        whole.add(float(k), "OBSERVING")
    assert [entry["at_s"] for entry in short.entries] == [7.0, 8.0, 9.0]
    assert [entry["at_s"] for entry in whole.entries] == [float(k) for k in range(10)]
    assert short.count == 10
    assert short.sha256 == whole.sha256
