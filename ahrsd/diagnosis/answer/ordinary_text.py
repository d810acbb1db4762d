"""What is left, in words: how large, where, and what real recordings ordinarily leave."""

from __future__ import annotations

from ahrsd.diagnosis.answer.diagnosis import Component, Diagnosis, Ordinary

#: said of a simulation that leaves what a real recording may
SIMULATED = "a simulated recording, its truth is beside it: nothing that is left there is ordinary"


def told_size(size: float, unit: str) -> str:
    """`9.1 mG`, `620 mrad/s`: two digits."""
    return f"{float(f'{1e3 * size:.2g}'):g} {'mG' if unit == 'gauss' else 'mrad/s'}"


def limit_text(one: Component) -> str:
    """`up to 72 mG`, or that none is."""
    return f"up to {told_size(one.up_to, one.unit)}" if one.up_to > 0.0 else "none"


def ordinary_left(found: Diagnosis) -> Ordinary | None:
    """What is left and is ordinary; None where nothing is, or where it is unknown."""
    left = found.unexplained
    return left.ordinary if left.ordinary is not None and not left.detected else None


def in_one_sentence(one: Ordinary) -> str:
    """`ordinary for a real recording: 9.1 mG, 1.3 deg of heading (...)`."""
    gyro = any(part.there and part.unit == "rad/s" for part in one.components)
    more = f" and {told_size(one.gyro_rad_s, 'rad/s')} of the gyro" if gyro else ""
    return (
        f"ordinary for a real recording: {told_size(one.field_gauss, 'gauss')}, "
        f"{one.heading_deg:.2g} deg of heading{more} (95 % of such recordings leave up to "
        f"{told_size(one.field_up_to_gauss, 'gauss')}, {one.heading_up_to_deg:.2g} deg; "
        f"{one.recordings} were measured)"
    )


def component_text(one: Component) -> str:
    """`a field by attitude: 8.5 mG, 1.3 deg of heading, 130 nats (ordinary: up to 72 mG)`."""
    heading = "" if one.heading_deg is None else f", {one.heading_deg:.2g} deg of heading"
    return (
        f"{one.words}: {told_size(one.size, one.unit)}{heading}, {one.evidence_nats:.0f} nats "
        f"(ordinary: {limit_text(one)})"
    )


def size_lines(one: Ordinary) -> list[str]:
    """The components that are there, the surest first; what all are together where none stands."""
    there = [part for part in one.components if part.there]
    if not there:
        return [
            f"{told_size(one.field_gauss, 'gauss')}, {one.heading_deg:.2g} deg of heading, of no "
            "one component"
        ]
    return [component_text(part) for part in sorted(there, key=lambda part: -part.evidence_nats)]
