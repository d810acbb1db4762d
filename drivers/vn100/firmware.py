"""What differs between the firmware generations of a VN-100, chosen by register 4.

| | 2.x (2.0, 2.1) | 3.x (3.0.0.0, 3.1.0.0) |
|---|---|---|
| on-board hard/soft iron, register 44 | ``1,3,5``: running and applied | ``0,1,5``: off |
| gyro bias at start-up, what VNSGB fills | register 74 | register 43 |
| VNTAR | yes | no (error 04) |
| register numbers in replies | 8 or 08 | 08 |

Any other firmware is unknown, and so is any other model: `Profile.writable` is false,
`observed_for` says why, and nothing may be changed on the device. The same holds for a device that
lacks a register which a VN-100 of its firmware has.

**The gyro bias goes to register 84, on both generations, and to no other.** Register 84 is
``out = C (in - B)`` at the sensor, acts at once, on every output, and can be read back and taken
back. Registers 43 and 74 only hold where the attitude filter starts its own bias estimate after a
power-up; writing the same bias there too would have it corrected twice until the filter notices.
VNSGB copies the filter's estimate, not ours.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from drivers.vn100.registers import REGISTERS, Values

_VN100 = re.compile(r"VN-?100(?![0-9])", re.IGNORECASE)
_VERSION = re.compile(r"([0-9]{1,3})(?:\.([0-9]{1,5}))?(?:\.([0-9]{1,5}))?(?:\.([0-9]{1,5}))?")


@dataclass(frozen=True, slots=True)
class Profile:
    """One firmware generation.

    generation:     2 or 3; 0 where the firmware is unknown
    version:        as register 4 says it
    writable:       false for unknown firmware and other models: observe only
    startup_bias:   register that VNSGB fills, None where unknown
    tare:           whether VNTAR exists
    observed_for:   why nothing may be changed, for a person; empty where it may
    """

    generation: int
    version: str
    writable: bool
    startup_bias: int | None
    tare: bool
    observed_for: str = ""

    def observed(self, why: str) -> Profile:
        """The same where nothing may be changed, for one reason more."""
        reasons = f"{self.observed_for}; {why}" if self.observed_for else why
        return replace(self, writable=False, observed_for=reasons)

    def has(self, register_id: int) -> bool:
        """Whether this firmware has the register; for unknown firmware, whether any has it."""
        row = REGISTERS.get(register_id)
        if row is None:
            return False
        return self.generation == 0 or self.generation in row.generations

    @property
    def registers(self) -> tuple[int, ...]:
        """Numbers of all registers of this firmware, ascending."""
        return tuple(number for number in REGISTERS if self.has(number))

    def default(self, register_id: int) -> Values | None:
        """The factory value, None where each unit has its own or it is not documented."""
        return REGISTERS[register_id].defaults.get(self.generation)


def profile_of(version: str, model: str = "VN-100") -> Profile:
    """The profile of a device from what registers 4 and 1 say: ``3.1.0.0``, ``VN-100S-CR``."""
    match = _VERSION.fullmatch(version.strip())
    generation = int(match[1]) if match else 0
    if generation == 2:
        profile = Profile(2, version, True, 74, True)
    elif generation == 3:
        profile = Profile(3, version, True, 43, False)
    else:
        why = f"firmware {version} is unknown (known are 2.x and 3.x)"
        profile = Profile(0, version, False, None, False, why)
    if _VN100.match(model.strip()):
        return profile
    return profile.observed(f"the model is {model or 'not said'}, and only a VN-100 is written")
