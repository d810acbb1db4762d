"""A fixed piece of work, like an update of the estimator, to measure the machine by.

Other programs on the same cores take caches and clock rate away, and the processor time of the same
work grows by half. A figure that is to say something about the program is a ratio against this.
"""

from __future__ import annotations

import time

import numpy as np
from scipy.linalg.lapack import dpbsv

STEPS = 256  # of an epoch
COLUMNS = 17


class ReferenceWork:
    """`slice()` is some 1.5 ms of work: always the same numbers, and nothing is kept."""

    def __init__(self) -> None:
        dice = np.random.default_rng(1)
        self._jacobian = dice.normal(size=(STEPS, 2, 3))
        self._right = dice.normal(size=(STEPS * 2, COLUMNS))
        self._band = np.zeros((4, 2 * STEPS))
        self._band[0] = 8.0
        self._band[1:] = dice.uniform(-1.0, 1.0, (3, 2 * STEPS))
        self._tokens = [f"{value:.6f}" for value in dice.normal(size=64)]

    def slice(self) -> float:
        """Do it once; a checksum that is the same every time."""
        own = np.swapaxes(self._jacobian, 1, 2)
        normal = self._jacobian @ own
        solved = self._right
        for _ in range(3):
            right = np.asfortranarray(solved)
            _, solved, _ = dpbsv(self._band, right, lower=1)
            solved = solved - (normal @ solved.reshape(STEPS, 2, COLUMNS)).reshape(-1, COLUMNS)
            solved = solved / np.maximum(np.linalg.norm(solved, axis=1, keepdims=True), 1e-12)
            shared = solved.T @ solved
        total = float(np.linalg.eigvalsh(shared)[-1])
        table: dict[str, float] = {}
        for _ in range(6):
            for token in self._tokens:
                table[token] = table.get(token, 0.0) + float(token)
        return total + sum(table.values())

    def timed(self) -> float:
        """Processor time of one slice on this thread, s."""
        before = time.thread_time()
        self.slice()
        return time.thread_time() - before
