"""All gates, one row per number that is judged; docs/reference/gates.md is checked against it."""

from __future__ import annotations

from ahrsd.gates.row import Gate
from ahrsd.gates.rows_data import FIELD, MOTION, STREAM
from ahrsd.gates.rows_result import CHANGE, PROOF, STEADY

GATES: tuple[Gate, ...] = STREAM + MOTION + FIELD + PROOF + CHANGE + STEADY
