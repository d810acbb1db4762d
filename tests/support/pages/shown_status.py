"""Parts of a status that tell of directions, for whatever reads one."""

import numpy as np

from ahrsd.evidence.coverage import cell_centres, cells_of, visited_cells

DIP_DEG = 60.0


def cells(chosen) -> str:
    """`motion.directions` where `chosen(from_down_deg, azimuth_deg)` says which cells were seen."""
    middle = cell_centres()
    from_down = np.degrees(np.arccos(middle[:, 2]))
    azimuth = np.degrees(np.arctan2(middle[:, 1], middle[:, 0])) % 360.0
    return "".join("1" if chosen(f, a) else "0" for f, a in zip(from_down, azimuth, strict=True))


def level_ring(from_down, azimuth) -> bool:
    """The cells of a full circle without tilt, at the dip above."""
    return abs(from_down - (90.0 - DIP_DEG)) <= 7.5


def cell_of(heading_deg, roll_deg=0.0, pitch_deg=0.0, dip_deg=DIP_DEG) -> int:
    """The cell in which the field is seen at an attitude."""
    h, r, p = np.radians([heading_deg, roll_deg, pitch_deg])
    dip = np.radians(dip_deg)
    field_n = np.array([np.cos(dip), 0.0, np.sin(dip)])
    yaw = np.array([[np.cos(h), -np.sin(h), 0], [np.sin(h), np.cos(h), 0], [0, 0, 1]])
    pitch = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    roll = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    field_b = (yaw @ pitch @ roll).T @ field_n
    assert visited_cells(field_b[None]).sum() == 1
    return int(cells_of(field_b[None])[0])


def motion(directions, next_="", **changes):
    """`motion` of a status."""
    body = {
        "regime": "2D", "heading_deg": 360.0, "roll_deg": 2.0, "pitch_deg": 1.0, "next": next_,
        "directions": directions, "down_b": [0.0, 0.0, 1.0], "dip_deg": DIP_DEG,
    }  # fmt: skip
    return body | changes


def gate(name, value=2.0, limit=1.0, ok=False):
    """One gate of a status."""
    return {
        "gate": name, "value": value, "limit": limit, "unit": "deg", "ok": ok, "since_s": 0.0,
        "for_s": 60.0, "advice": f"turn for {name}",
    }  # fmt: skip
