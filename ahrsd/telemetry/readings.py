"""What the sensor reads now, and the heading by the calibration in force and by the new one."""

from __future__ import annotations

import numpy as np

from ahrsd.events import SamplesSeen
from ahrsd.heading import tilt_compensated_heading
from ahrsd.samples import Array


def readings(seen: SamplesSeen, now_s: float) -> dict[str, object]:
    """Means over the newest block of samples; `now_s` is the host's monotonic clock.

    Headings are magnetic, by the field levelled with the specific force, so a vehicle that
    accelerates spoils them for as long; nan where the stream has no acceleration. `would_be` is
    by the newest estimate, nan before it has converged.
    """
    block = seen.block
    raw, force = np.mean(block.raw_b_gauss, axis=0), np.mean(block.accel_b_m_s2, axis=0)
    in_force = seen.present.apply(raw)
    would_be = np.full(3, np.nan) if seen.proposed is None else seen.proposed.apply(raw)
    with np.errstate(invalid="ignore", divide="ignore"):  # a force of zero has no direction
        down = -force / np.linalg.norm(force)
        now_deg, new_deg = _heading_deg(in_force, force), _heading_deg(would_be, force)
    return {
        "time_s": float(block.time_s[-1]),
        "age_s": max(now_s - float(block.host_s[-1]), 0.0),
        "raw_b_gauss": raw,
        "corrected_b_gauss": in_force,
        "would_be_b_gauss": would_be,
        "gyro_b_rad_s": np.mean(block.gyro_b_rad_s, axis=0),
        "accel_b_m_s2": force,
        "heading_deg": now_deg,
        "heading_would_be_deg": new_deg,
        "roll_deg": float(np.degrees(np.arctan2(down[1], down[2]))),
        "pitch_deg": float(np.degrees(np.arcsin(np.clip(-down[0], -1.0, 1.0)))),
    }


def _heading_deg(field_b: Array, force_b: Array) -> float:
    heading_rad = tilt_compensated_heading(field_b[None, :], force_b[None, :])
    return float(np.degrees(heading_rad[0]) % 360.0)
