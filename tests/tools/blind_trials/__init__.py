"""Sealed blind trials of `diagnose`: cases made by somebody else, a key nobody sees, one scoring.

A tool for testing, not for the vehicle: it is here in the source tree and in no wheel, and an
editable install finds it. `commands` is `ahrsd challenge`. The cases come from `world`, which
shares no code with the rest and is started as a program. Its key is sealed by a salted hash before
anything is answered; answers are hashed before the key is opened; see
docs/validation/blind-trials.md.
"""

#: what brings the packages of the rivals
INSTALL = "pip install -e '.[trials]'"
