"""What must hold before a calibration is written: a table of gates and its judge.

Guards (`Level`): CANDIDATE - it may be shown; RAM - an operator may approve it; FLASH - it may be
saved; UNATTENDED - RAM without an operator. For a field engineer: docs/reference/gates.md.
"""

from ahrsd.gates.judging import for_level, guards_a_write, holds, judge, limit_of
from ahrsd.gates.limits import GateLimits
from ahrsd.gates.table import GATES, Gate, Level

__all__ = [
    "GATES",
    "Gate",
    "GateLimits",
    "Level",
    "for_level",
    "guards_a_write",
    "holds",
    "judge",
    "limit_of",
]
