"""Inputs as JSON and back, exactly: what the `input` channel of a capture holds.

`Received` is not here: its bytes are stored as they are.  decode(encode(x)) == x for every input;
arrays of `Samples` travel as lists, NaN as the JSON extension `NaN` that Python reads and writes.

A file may hold anything: each field is checked against the type that the input's class declares,
sizes against what a run writes.
"""

from __future__ import annotations

import json
import math
import types
import typing
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np

from ahrsd.inputs import (
    ClientLeft,
    ClientSent,
    Columns,
    EarlierRun,
    EarlierSamples,
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
from ahrsd.writeback.journal_history import StoredRecord
from ahrsd.writeback.reconcile import RecordKind

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
        ClientSent,
        ClientLeft,
        RegistersKnown,
        Samples,
        EarlierSamples,
        EarlierRun,
        JournalOpened,
        Journalled,
        Examined,
        LimitsChanged,
        Stop,
    )
}
_MOST = 2**63  # of any whole number
_MOST_REGISTER, _MOST_VALUES = 255, 64
_COMPENSATING = {23: 12, 25: 12, 26: 9, 44: 2, 47: 12, 84: 12}  # register: values at least
_SINGULAR = 1e-12
_MOST_ROWS = 1_000_000  # of a block
_VECTORS = ("raw_b_gauss", "gyro_b_rad_s", "accel_b_m_s2")
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
            body["values"] = {int(k): _row(v) for k, v in body["values"].items()}
        elif kind is EarlierRun:
            body["registers"] = {int(k): _row(v) for k, v in body["registers"].items()}
            body["compensated"] = _row(body["compensated"])
        elif kind in (Samples, EarlierSamples):
            body["block"] = _block(body["block"])
        _check(kind, body)
        return kind(**body)
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(f"not a recorded input: {error}") from error


def _row(values: object) -> tuple[Any, ...]:
    if not isinstance(values, list):
        raise TypeError(f"a register holds {_short(values)}")
    return tuple(values)


def _block(body: dict[str, Any]) -> SampleBlock:
    for name in _ARRAYS:
        body[name] = np.array(body[name], dtype=np.float64)
    covariates = {k: np.array(v, dtype=np.float64) for k, v in body.pop("covariates").items()}
    rows = len(body["time_s"])
    if not 0 < rows <= _MOST_ROWS:
        raise ValueError(f"a block of {rows} samples")
    shapes = {name: (rows, 3) if name in _VECTORS else (rows,) for name in _ARRAYS}
    found = {name: body[name].shape for name in _ARRAYS} | {
        k: v.shape for k, v in covariates.items()
    }
    for name, shape in found.items():
        if shape != shapes.get(name, (rows,)):
            raise ValueError(f"{name} of a block of {rows} samples has the shape {shape}")
    sound = np.isfinite(body["time_s"]).all() and np.all(np.diff(body["time_s"]) > 0.0)
    readings = np.isfinite(body["raw_b_gauss"]).all() and np.isfinite(body["gyro_b_rad_s"]).all()
    if not (sound and readings):
        raise ValueError("a block whose times do not increase, or whose readings are not finite")
    if not np.all((body["dt_s"] > 0.0) | np.isnan(body["dt_s"])):
        raise ValueError("a block with steps that are not positive")
    _check(SampleBlock, {k: v for k, v in body.items() if k not in _ARRAYS})
    return SampleBlock(**body, covariates=covariates)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _check(kind: type, body: dict[str, Any]) -> None:
    """Raise ValueError for a field that is not of its declared type, or beyond what runs write."""
    for name, value in body.items():
        if name in (hints := _hints(kind)) and not _is(value, hints[name]):
            raise ValueError(f"{name} of {kind.__name__} is {_short(value)}")
    if not 0 <= body.get("host_ns", 0) < _MOST:
        raise ValueError(f"host_ns of {kind.__name__} is {_short(body['host_ns'])}")
    if not math.isfinite(body.get("wall_s", 0.0)):
        raise ValueError(f"wall_s of {kind.__name__} is {body['wall_s']}")
    if kind in (RegistersKnown, EarlierRun):
        for number, values in body.get("values", body.get("registers", {})).items():
            if not 0 <= number <= _MOST_REGISTER or len(values) > _MOST_VALUES:
                raise ValueError(f"register {_short(number)} of {len(values)} values")
            _check_register(number, values)
    elif kind is JournalOpened and not body.get("error"):
        for record in body.get("records", []):
            StoredRecord.of(record)
    elif kind is Journalled:
        RecordKind(body["kind"])


def _check_register(number: int, values: tuple[Any, ...]) -> None:
    """Those that samples are un-mapped through must be numbers, and a matrix that can be undone."""
    if number not in _COMPENSATING:
        return
    least = _COMPENSATING[number]
    if len(values) < least or not all(_is(v, float) and math.isfinite(v) for v in values):
        raise ValueError(f"register {number} is not {least} numbers: {_short(values)}")
    if least >= 9 and abs(np.linalg.det(np.array(values[:9], float).reshape(3, 3))) < _SINGULAR:
        raise ValueError(f"register {number} holds a matrix that cannot be undone")


def _short(value: object) -> str:
    text = repr(value)
    return f"{text[:40]}..." if len(text) > 40 else text


def _is(value: object, hint: object) -> bool:
    """Whether a decoded value is what an annotation says; a float may be a whole number."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_is(value, part) for part in parts)
    if origin is dict:
        return isinstance(value, dict) and all(
            _is(k, parts[0]) and _is(v, parts[1]) for k, v in value.items()
        )
    if origin in (list, tuple):
        return isinstance(value, origin) and all(_is(part, parts[0]) for part in value)
    if hint in (int, float):
        whole = isinstance(value, int) and not isinstance(value, bool) and -_MOST < value < _MOST
        return whole or (hint is float and isinstance(value, float))
    return hint is object or not isinstance(hint, type) or isinstance(value, hint)
