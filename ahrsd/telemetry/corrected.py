"""The records of a share with send = "corrected", schema `ahrsd.corrected/1`; pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

import ahrsd
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array, SampleBlock
from ahrsd.sharing.tilt import has_heading
from ahrsd.telemetry.calibration_in_use import InUse
from ahrsd.telemetry.explain import STATES, estimator_trouble, stream_trouble
from ahrsd.telemetry.records import Record

SCHEMA: Final = "ahrsd.corrected/1"
ALARMS: Final = ("FAULT", "FLASH_TORN", "LOCKED")  # states of the write-back that need a person
_DIGITS = 7


def headings_deg(mag_body: Array, up_body: Array, in_use: InUse, limit_deg: float) -> Array:
    """(N,) magnetic heading in 0..360 deg; nan where it is not known to `limit_deg` (1 sigma)."""
    sigma_deg = in_use.heading_sigma_deg
    if sigma_deg is None or sigma_deg > limit_deg:
        return np.full(len(mag_body), np.nan)
    heading = np.degrees(tilt_compensated_heading(mag_body, up_body)) % 360.0
    return np.where(has_heading(up_body), heading, np.nan)


def sample_records(
    block: SampleBlock,
    mag_body: Array,
    gyro_body: Array,
    heading_deg: Array,
    in_use: InUse,
    wall_offset_s: float,
) -> list[Record]:
    """A record for each sample; `wall_offset_s` is the wall clock less the monotonic one."""
    host_s = block.host_s
    columns = zip(
        np.round(block.time_s, 6).tolist(),
        np.round(host_s, 6).tolist(),
        np.round(host_s + wall_offset_s, 6).tolist(),
        np.round(mag_body, _DIGITS).tolist(),
        np.round(gyro_body, _DIGITS).tolist(),
        np.round(heading_deg, 2).tolist(),
        strict=True,
    )
    sigma_deg = in_use.heading_sigma_deg
    return [
        {
            "record": "sample",
            "time_s": time_s,
            "host_s": host_s,
            "unix_s": unix_s,
            "mag_body_gauss": mag,
            "gyro_body_rad_s": gyro,
            "calibration": in_use.by,
            "magnetic_heading_deg": heading,
            "heading_sigma_deg": None if sigma_deg is None else round(sigma_deg, 2),
            "gap_before": block.gap_before and not number,
        }
        for number, (time_s, host_s, unix_s, mag, gyro, heading) in enumerate(columns)
    ]


def state_record(status: Mapping[str, Any], in_use: InUse, wall_offset_s: float) -> Record:
    """How the device, the calibration and its proof stand, out of a status."""
    estimate = status["estimate"] or {}
    sigma_deg = in_use.heading_sigma_deg
    return {
        "record": "state",
        "schema": SCHEMA,
        "version": ahrsd.__version__,
        "host_s": round(status["host_s"], 6),
        "unix_s": round(status["host_s"] + wall_offset_s, 6),
        "device": status["device"],
        "device_present": status["link"]["open"],
        "mode": status["mode"],
        "write_back": status["write_back"]["state"],
        "calibration": in_use.by,
        "candidate": in_use.candidate,
        "heading_sigma_deg": None if sigma_deg is None else round(sigma_deg, 2),
        "sigma_hard_iron_gauss": estimate.get("sigma_hard_iron_gauss"),
        "sigma_gyro_bias_rad_s": estimate.get("sigma_gyro_bias_rad_s"),
        "alarms": alarms(status),
    }


def alarms(status: Mapping[str, Any]) -> list[str]:
    """What makes the corrected values doubtful or missing, in sentences."""
    state = status["write_back"]["state"]
    found = [stream_trouble(status), *status["sensors"]]
    found += [STATES[state]] if state in ALARMS else []
    if status["mismatch"]["open"]:
        found.append(str(status["mismatch"]["step"]["text"]))
    if trouble := estimator_trouble(status):
        found.append(f"estimator {trouble}")
    return [text for text in found if text]
