"""NMEA 0183 sentences: magnetic heading (HDM), and pitch, roll and temperature (XDR).

$HCHDM,093.8,M*2B             degrees from magnetic north to the vehicle's x axis, to the east
$HCHDM,,M*07                  the heading is not known: an empty field, as the standard has it
$YXXDR,A,1.4,D,PITCH,A,-0.3,D,ROLL,C,24.6,C,TEMP*2D

Talkers: HC, a magnetic compass; YX, a transducer. Transducer types A (angle, units D: degrees) and
C (temperature, units C). PITCH is positive with the bow up, ROLL with the right side down; the
names are those of the standard's list of 2019 (Pitch, Roll), in capitals, as older programs compare
them.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.vn100.messages import encode


@dataclass(frozen=True, slots=True)
class Transducer:
    """One measurement of an XDR sentence; `value` None: not known, an empty field."""

    type: str
    value: float | None
    units: str
    name: str


def hdm(heading_deg: float | None) -> bytes:
    """The magnetic heading; None: not known."""
    if heading_deg is None:
        return encode("HCHDM,,M")
    return encode(f"HCHDM,{round(heading_deg % 360.0, 1) % 360.0:05.1f},M")


def xdr(transducers: list[Transducer]) -> bytes:
    """Measurements of transducers; at most four fit into the 82 characters of a sentence."""
    fields = [f"{t.type},{_number(t.value)},{t.units},{t.name}" for t in transducers]
    return encode("YXXDR," + ",".join(fields))


def attitude(
    pitch_deg: float | None, roll_deg: float | None, temperature_c: float | None
) -> list[Transducer]:
    """Pitch and roll, and the sensor's temperature where there is one."""
    found = [Transducer("A", pitch_deg, "D", "PITCH"), Transducer("A", roll_deg, "D", "ROLL")]
    if temperature_c is not None:
        found.append(Transducer("C", temperature_c, "C", "TEMP"))
    return found


def _number(value: float | None) -> str:
    return "" if value is None else f"{round(value, 1) + 0.0:.1f}"  # no -0.0
