"""A scripted VN-100 that shares nothing with the project: the second opinion of the tests.

Written from the protocol reference and its vectors alone. Nothing here imports `drivers` or
`ahrsd`, so a mistake that the driver and the emulator share does not pass unseen.

| module | one idea |
|---|---|
| `wire` | checksums, sentences, binary packets, lines of commands |
| `physics` | motion, field, iron that changes, gyro bias, noise |
| `memory` | registers in RAM and flash, as the device prints them |
| `unit` | one device: commands, replies, outputs, lies |
| `cable` | a port with one unit at its end: exchange, faults of the line, the second master |
| `served` | a cable on a pty in real time |
"""

from scripted_vn100.cable import Cable, Faults
from scripted_vn100.physics import Iron, Motion, Vehicle
from scripted_vn100.served import Served
from scripted_vn100.unit import Change, Lies, Unit

__all__ = ["Cable", "Change", "Faults", "Iron", "Lies", "Motion", "Served", "Unit", "Vehicle"]
