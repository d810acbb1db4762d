"""The repaired model as text: calibration, noise and effects (schema ahrsd.model/1).

The caller reads and writes files; this module converts text to values and back.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.effects.effect import Effect
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Noise, NullModel, Term
from ahrsd.diagnosis.repaired_model.forward import model_noise
from ahrsd.samples import Array

SCHEMA = "ahrsd.model/1"
_LEAST_FREEDOM = 2.0  # of Student's t: with less it has no deviation
_LEVELS = ("mag_gauss", "gyro_rad_s", "gyro_walk_rad_s_sqrt_s")


@dataclass(frozen=True, slots=True, eq=False)
class RepairedModel:
    """What explains a recording: calibration, noise and effects."""

    calibration: NullModel
    noise: Noise
    terms: tuple[Term, ...] = ()
    recording: str = ""


def to_text(model: RepairedModel, library: Mapping[str, Effect] = EFFECTS) -> str:
    """The model as JSON text."""
    calibration = model.calibration
    body = {
        "schema": SCHEMA,
        "recording": model.recording,
        "convention": "m = A h + b + terms + noise; w_read = w + w_b + terms + noise",
        "calibration": {
            "soft_iron": calibration.soft_iron.tolist(),
            "hard_iron_gauss": calibration.hard_iron_gauss.tolist(),
            "gyro_bias_rad_s": calibration.gyro_bias_rad_s.tolist(),
        },
        "noise": _noise_json(model.noise),
        "terms": [_term_json(term, library[term.identifier]) for term in model.terms],
    }
    return json.dumps(body, indent=1, allow_nan=False) + "\n"


def from_text(text: str, library: Mapping[str, Effect] = EFFECTS) -> RepairedModel:
    """Parse the text of a model file.

    Raises ValueError in one line: no JSON, another schema, a missing key, an unknown effect.
    """
    try:
        body = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"is no JSON: {error}") from None
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        raise ValueError(f"is no model: its schema must be {SCHEMA!r}")
    noise = _parse_noise(body)
    calibration = NullModel(
        soft_iron=_parse_array(body, "calibration", "soft_iron", (3, 3)),
        hard_iron_gauss=_parse_array(body, "calibration", "hard_iron_gauss", (3,)),
        gyro_bias_rad_s=_parse_array(body, "calibration", "gyro_bias_rad_s", (3,)),
        sigma_mag_gauss=noise.mag_gauss,
        sigma_gyro_rad_s=noise.gyro_rad_s,
        gyro_walk_rad_s_sqrt_s=noise.gyro_walk_rad_s_sqrt_s,
    )
    terms = body.get("terms")
    if not isinstance(terms, list):
        raise ValueError("terms must be a list")
    return RepairedModel(
        calibration,
        noise,
        tuple(_parse_term(entry, number, library) for number, entry in enumerate(terms)),
        str(body.get("recording", "")),
    )


def repaired_model_of(found: Diagnosis) -> RepairedModel:
    """The repaired model of a diagnosis.  ValueError where it has none."""
    if found.model is None:
        raise ValueError("the diagnosis has no model: the recording could not be fitted")
    noise = found.noise or model_noise(found.model)
    return RepairedModel(found.model, noise, found.terms, found.recording)


def _noise_json(noise: Noise) -> dict[str, object]:
    """Levels and colour; the freedom of the Student-t only where it is finite."""
    out = {name: getattr(noise, name) for name in (*_LEVELS, "colour")}
    return out | ({"freedom": noise.freedom} if np.isfinite(noise.freedom) else {})


def _parse_noise(body: dict[str, Any]) -> Noise:
    mag, gyro, walk = (_parse_number(body, "noise", name) for name in _LEVELS)
    colour = body["noise"].get("colour")
    if not isinstance(colour, list):
        raise ValueError("noise.colour must be a list of numbers")
    by_row = {str(k): value for k, value in enumerate(colour)}
    taps = tuple(_finite_number(by_row, key, "noise.colour") for key in by_row)
    freedom = (
        _parse_number(body, "noise", "freedom") if "freedom" in body["noise"] else float("inf")
    )
    if freedom <= _LEAST_FREEDOM:
        raise ValueError(f"noise.freedom: more than {_LEAST_FREEDOM:g} is needed")
    return Noise(mag, gyro, walk, taps, freedom)


def _term_json(term: Term, effect: Effect) -> dict[str, object]:
    return {
        "effect": term.identifier,
        "setting": term.setting,
        "parameters": [
            {"name": p.name, "value": float(value), "std": float(std), "unit": p.unit}
            for p, value, std in zip(effect.parameters, term.value, term.deviation, strict=True)
        ],
    }


def _parse_term(entry: object, number: int, library: Mapping[str, Effect]) -> Term:
    """A term; its parameters are found by name, in any order."""
    if not isinstance(entry, dict):
        raise ValueError(f"terms[{number}] is no object")
    name = str(entry.get("effect"))
    if name not in library:
        raise ValueError(f"terms[{number}]: no effect {name!r}: docs/reference/effects.md")
    given = entry.get("parameters")
    setting = entry.get("setting", {})
    if not isinstance(given, list) or not isinstance(setting, dict):
        raise ValueError(f"terms[{number}]: {name} needs parameters (a list) and a setting")
    by_name = {row.get("name"): row for row in given if isinstance(row, dict)}
    wanted = [parameter.name for parameter in library[name].parameters]
    if set(by_name) != set(wanted):
        raise ValueError(f"terms[{number}]: the parameters of {name} are {', '.join(wanted)}")
    value, std = (
        np.array([_finite_number(by_name[p], key, f"terms[{number}].{p}") for p in wanted])
        for key in ("value", "std")
    )
    return Term(name, value, std, setting)


def _parse_number(body: dict[str, Any], part: str, key: str) -> float:
    section = body.get(part)
    if not isinstance(section, dict):
        raise ValueError(f"{part} is missing")
    return _finite_number(section, key, part)


def _finite_number(section: dict[str, Any], key: str, where: str) -> float:
    number = section.get(key)
    if isinstance(number, bool) or not isinstance(number, int | float) or not np.isfinite(number):
        raise ValueError(f"{where}.{key}: {number!r} is no finite number")
    return float(number)


def _parse_array(body: dict[str, Any], part: str, key: str, shape: tuple[int, ...]) -> Array:
    section = body.get(part)
    given = section.get(key) if isinstance(section, dict) else None
    try:
        out = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        out = np.array(np.nan)
    if out.shape != shape or not np.isfinite(out).all():
        raise ValueError(f"{part}.{key}: {shape} finite numbers are needed")
    return out
