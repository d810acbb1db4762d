"""The JSON that other programs rely on (contract, sections 3 and 4), as a table and its check."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

NUMBER = (int, float)
NULL = type(None)

DECISION = {
    "at_s": NUMBER,
    "state": str,
    "gates": [{"gate": str, "value": (*NUMBER, NULL), "limit": (*NUMBER, NULL), "ok": bool}],
}

CALIBRATION = {
    "schema": "ahrsd.calibration/1",
    "method": str,
    "recording": str,
    "samples": int,
    "duration_s": NUMBER,
    "converged": bool,
    "correction_matrix": (3, 3),
    "soft_iron": (3, 3),
    "hard_iron_gauss": (3,),
    "gyro_bias_rad_s": (3,),
    "field_gauss": NUMBER,
    "field_known": bool,
    "standard_deviation": {"soft_iron": (6,), "hard_iron_gauss": (3,), "gyro_bias_rad_s": (3,)},
    "heading_error_deg": {
        "expected_worst": NUMBER,
        "before_rms": (*NUMBER, NULL),
        "after_rms": (*NUMBER, NULL),
    },
    "observability": {"dominated_by": (str, NULL)},
    "registers": dict,
    "warnings": [str],
}

REPLAY = {
    "schema": "ahrsd.replay/1",
    "recording": str,
    "bytes": int,
    "packets": {"valid": int, "rejected": int, "by_type": dict},
    "skipped_bytes": int,
    "samples": int,
    "duration_s": NUMBER,
    "rate_hz": NUMBER,
    "gaps": [{"at_s": NUMBER, "length_s": NUMBER}],
    "device_restarts": int,
    "calibration": CALIBRATION,
    "decisions": [DECISION],
    "decision_sha256": str,
}


def faults(value: object, schema: Any, at: str = "$") -> list[str]:
    """What of `value` is not as `schema` says.

    A schema is a mapping (each of its keys must be there), a list of one (each element), a type or
    several, a text (this very one) or a shape: (3, 3) is nested lists of finite numbers.
    """
    if isinstance(schema, Mapping):
        return _of_mapping(value, schema, at)
    if isinstance(schema, list):
        if not isinstance(value, list):
            return [f"{at}: {value!r} is no list"]
        return [f for k, one in enumerate(value) for f in faults(one, schema[0], f"{at}[{k}]")]
    if isinstance(schema, str):
        return [] if value == schema else [f"{at}: {value!r} is not {schema!r}"]
    if isinstance(schema, tuple) and all(isinstance(size, int) for size in schema):
        return _of_shape(value, schema, at)
    kinds = schema if isinstance(schema, tuple) else (schema,)
    if isinstance(value, bool) and bool not in kinds:
        return [f"{at}: {value!r} is a truth value"]
    return [] if isinstance(value, kinds) else [f"{at}: {value!r} is not of {kinds}"]


def _of_mapping(value: object, schema: Mapping[str, Any], at: str) -> list[str]:
    if not isinstance(value, dict):
        return [f"{at}: {value!r} is no object"]
    missing = [f"{at}: no key {key}" for key in schema if key not in value]
    return missing + [
        fault
        for key in schema
        if key in value
        for fault in faults(value[key], schema[key], f"{at}.{key}")
    ]


def _of_shape(value: object, shape: tuple[int, ...], at: str) -> list[str]:
    if not shape:
        good = isinstance(value, NUMBER) and not isinstance(value, bool) and math.isfinite(value)
        return [] if good else [f"{at}: {value!r} is no finite number"]
    if not isinstance(value, list) or len(value) != shape[0]:
        return [f"{at}: {value!r} is no list of {shape[0]}"]
    return [f for k, one in enumerate(value) for f in _of_shape(one, shape[1:], f"{at}[{k}]")]
