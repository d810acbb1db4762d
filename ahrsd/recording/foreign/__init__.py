"""Recordings of other programs: what they are by content, and their sensors on one clock.

`formats` is the registry; `recognised` names what is not read, and what to do about it.
"""
