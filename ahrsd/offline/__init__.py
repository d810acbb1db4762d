"""Recordings as a whole: calibrate, diagnose, compare methods, replay."""
