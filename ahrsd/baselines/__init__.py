"""Every published method beside ours, faithful to its source, each with its failure said.

`run(method, data)` for arrays, `calibrate_with(method, blocks)` for a recording; METHODS lists the
methods, what they need and what they estimate. Sources and figures: docs/reference/methods.md.

[R] Rodriguez-Martinez, thesis, PUC Chile 2023 (MAGICAL). [M] Rodriguez-Martinez & Troni (MAGYC).
[L] Lichlyter, thesis, Mississippi State 2022. The theses write m = A (m_t + m_b): b = A m_b.
"""

from ahrsd.baselines.data import MethodData, MethodError, MethodResult, MethodSettings
from ahrsd.baselines.registry import METHODS, Method, calibrate_with, joined, run

__all__ = [
    "METHODS",
    "Method",
    "MethodData",
    "MethodError",
    "MethodResult",
    "MethodSettings",
    "calibrate_with",
    "joined",
    "run",
]
