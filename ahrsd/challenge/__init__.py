"""Sealed blind trials of `diagnose`: cases made by somebody else, a key nobody sees, one scoring.

The cases come from a generator that is no part of this package and shares no code with it. Its key
is sealed by a salted hash before anything is answered; answers are hashed before the key is
opened; see docs/validation/blind-trials.md.
"""
