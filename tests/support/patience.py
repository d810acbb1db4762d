"""How long a test waits for what another process or thread does.

A bound for what hangs, not a figure: on a quiet machine the longest takes some seconds. A machine
with other work to do takes ten times as long, and a test that gives up then tells nothing.
"""

from __future__ import annotations

PATIENCE_S = 240.0
