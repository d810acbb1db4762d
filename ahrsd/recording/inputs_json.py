"""Inputs as JSON and back, exactly: what the `input` channel of a capture holds.

`Received` is not here: its bytes are stored as they are.  decode(encode(x)) == x for every input;
arrays of `Samples` travel as lists, NaN as the JSON extension `NaN` that Python reads and writes.
"""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import numpy as np

from ahrsd.inputs import (
    Columns,
    Examined,
    Input,
    Interlock,
    Journalled,
    JournalOpened,
    LimitsChanged,
    LinkLost,
    LinkOpened,
    Operator,
    RegistersKnown,
    Samples,
    Stop,
    TermsKnown,
    Tick,
    WallClock,
)
from ahrsd.samples import SampleBlock

_TYPES = {
    kind.__name__: kind
    for kind in (
        Tick,
        WallClock,
        LinkOpened,
        LinkLost,
        Interlock,
        Columns,
        TermsKnown,
        Operator,
        RegistersKnown,
        Samples,
        JournalOpened,
        Journalled,
        Examined,
        LimitsChanged,
        Stop,
    )
}
_ARRAYS = ("time_s", "dt_s", "host_s", "raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")


def to_json(value: object) -> bytes:
    """Compact JSON of any fact; arrays become lists and what JSON has no word for its text."""
    return json.dumps(value, default=_plain, separators=(",", ":")).encode()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, SampleBlock):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return str(value)


def encode(item: Input) -> bytes:
    """One input, its type's name first."""
    body = {field.name: getattr(item, field.name) for field in fields(item)}
    return to_json({"type": type(item).__name__, **body})


def decode(data: bytes) -> Input:
    """Undo `encode`.  Raises ValueError where the bytes are no input."""
    try:
        body: dict[str, Any] = json.loads(data)
        kind = _TYPES[body.pop("type")]
        if kind is RegistersKnown:
            body["values"] = {int(k): tuple(v) for k, v in body["values"].items()}
        elif kind is Samples:
            body["block"] = _block(body["block"])
        return kind(**body)
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"not a recorded input: {error}") from error


def _block(body: dict[str, Any]) -> SampleBlock:
    for name in _ARRAYS:
        body[name] = np.array(body[name], dtype=np.float64)
    covariates = {k: np.array(v, dtype=np.float64) for k, v in body.pop("covariates").items()}
    return SampleBlock(**body, covariates=covariates)
