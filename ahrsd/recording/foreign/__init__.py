"""Recordings of other programs: what they are by content, and their sensors on one clock.

`formats` is the registry; it also names what is not read, and what to do about it.
"""
