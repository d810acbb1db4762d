"""What a generator conceals, in the form in which `blind_trials.judge` judges answers."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from generators.road_and_air import world as road_and_air
from generators.workboat import world as workboat

Json = dict[str, Any]
Array = NDArray[np.float64]

WORLDS = {"road_and_air": road_and_air, "workboat": workboat}
KINDS = ("null", "single", "pair", "withheld", "outside")

_DELAYS = ("mag_time_lag", "mag_low_pass", "gyro_time_lag", "gyro_integration")
_STEPS_OF_ONE = ("hard_iron_step", "soft_iron_step", "onboard_calibration_active")
#: other names for the very same signal
ALIKE: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(_DELAYS, _DELAYS),
    "gyro_scale": ("clock_rate",),
    "clock_rate": ("gyro_scale",),
    "timestamp_jitter": ("clock_rate",),
    "onboard_calibration_active": _STEPS_OF_ONE,
    "altitude_field": ("field_gradient",),  # along the vertical
    "noise_burst": ("noise_level",),
}
#: what is right where the cause is in no column: the effect seen without it
PARENTS: dict[str, tuple[str, ...]] = {
    "mag_bias_temperature": ("hard_iron_drift",),
    "gyro_bias_temperature": ("gyro_bias_drift", "gyro_startup"),
    "field_gradient": ("field_anomaly",),
    "altitude_field": ("field_gradient", "field_anomaly"),
    "two_state_anode_bracket": ("hysteresis",),
    **dict.fromkeys(
        (
            "passing_hull",
            "chain_on_sea_floor",
            "interrupted_pipeline",
            "steel_bridge",
            "passing_lorry",
        ),
        ("field_anomaly",),
    ),
}
#: names that a noise law, or a logger's gaps, make true whatever else is there
OF_THE_NOISE: dict[str, tuple[str, ...]] = {
    "heavy_tailed": ("noise_burst",),
    "student": ("noise_burst",),
    "throttle_vibration": ("noise_burst", "noise_level"),
    "quantised": ("mag_quantisation",),
    "host_jitter": ("timestamp_jitter",),
    "gaps": ("dropped_samples",),
}


@dataclass(frozen=True)
class Iron:
    """The calibration without what is concealed, contract section 1. `field_n_gauss`: (3,) NED."""

    soft_iron: Array
    hard_iron_gauss: Array
    gyro_bias_rad_s: Array
    field_n_gauss: Array


@dataclass(frozen=True)
class Made:
    """One case on the disk. `spec`: None where nothing is known of the sensors."""

    table: Path
    spec: Path | None
    truth: Json
    iron: Iron


def made(world: str, folder: Path, seed: int, counts: Mapping[str, int]) -> Iterator[Made]:
    """Write the cases of a seed into `folder`; each with its truth."""
    wanted = {kind: counts.get(kind, 0) for kind in KINDS}
    asked = [word for kind, count in wanted.items() for word in (f"--{kind}", str(count))]
    if WORLDS[world].main([str(folder), "--seed", str(seed), *asked]):
        sys.exit(f"{world} made no cases")
    for told in json.loads((folder / "truth.json").read_text())["cases"]:
        spec = folder / f"{told['id']}.spec.json"
        known = spec.exists() and bool(json.loads(spec.read_text()))
        table = folder / f"{told['id']}.csv.gz"
        yield Made(table, spec if known else None, truth_of(told), _iron(told))


def truth_of(told: Json) -> Json:
    """A generator's own words as a truth that can be judged; coefficients are not compared."""
    return {
        "id": told["id"],
        "kind": told["kind"],
        "effects": [_effect(told["kind"], one) for one in told["effects"]],
        "allowed": sorted(
            {name for law, names in OF_THE_NOISE.items() if law in told["noise"] for name in names}
        ),
        "noise": {"law": told["noise"]},
        "what": told["what"],
        "duration_s": 0.0,
        "oracle_gain_nats_per_sample": None,
    }


def _iron(told: Json) -> Iron:
    said = told.get("calibration", told)
    field_n_gauss = said.get("field_ned_gauss", said.get("field_north_east_down_gauss"))
    return Iron(
        np.array(said["soft_iron"]),
        np.array(said["hard_iron_gauss"]),
        np.array(said["gyro_bias_rad_s"]),
        np.array(field_n_gauss),
    )


def _effect(kind: str, told: Json) -> Json:
    name = told["effect"].removeprefix("outside:")
    right = [] if kind == "outside" else [name, *(n for n in ALIKE.get(name, ()) if n != name)]
    return {
        "effect": name,
        "right": right,
        "parents": list(PARENTS.get(name, ())),
        "multiple": told["visibility_without_attitude"],
        "frames": [told["frame"]],
        "onset_s": told["onset_s"],
        "parameters": [],
        "intervals_s": [],
        "either_half": False,
    }
