"""The slow part of the core, in pieces that may be done beside it.

The calibrator takes samples and judges; now and then that takes a good part of a second, in which
the port, the vehicle's word and an operator would wait. So the core makes a piece of work of each
block and takes its finding later: in a run another thread does the pieces in their order
(`worker`), and the input `Examined` says how many are done. A replay does them when it comes to
that input, and so takes the same decisions from the same findings at the same place.

A calibrator belongs to its pieces: only they may change it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from ahrsd.calibration import Affine, Estimate
from ahrsd.calibrator import Calibrator
from ahrsd.events import GateResult, Noted
from ahrsd.evidence.values import BasisFacts, HealthFacts
from ahrsd.samples import Array, SampleBlock


@dataclass(frozen=True, slots=True)
class Circumstances:
    """How things stood when the block came.

    at_s, host_s: time of the device and of the host
    era: two blocks of one era were taken with the same registers in force, over one link
    """

    at_s: float
    host_s: float
    health: HealthFacts
    basis: BasisFacts
    margin: float
    era: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """What a block brought. `estimate` is None where there is nothing new to judge.

    void: why a calibration from before this block holds no more, empty where it may hold
    """

    calibrator: Calibrator
    when: Circumstances
    proposed: Affine | None
    notes: tuple[Noted, ...]
    estimate: Estimate | None = None
    gates: tuple[GateResult, ...] = ()
    void: str = ""


class Piece:
    """Work that is done once, by whoever comes first."""

    def __init__(self, make: Callable[[], Finding | None]) -> None:
        self._make = make
        self._begun = self._done = False
        self._finding: Finding | None = None

    def work(self) -> None:
        """Do it."""
        self._begun = True
        self._finding = self._make()
        self._done = True

    def finding(self) -> Finding | None:
        """What it brought. Raises RuntimeError where it was begun and broke off."""
        if not self._begun:
            self.work()
        if not self._done:
            raise RuntimeError("the estimate broke off, see above")
        return self._finding


class Desk:
    """The pieces that nobody has taken the finding of yet, oldest first."""

    def __init__(self) -> None:
        self._pieces: deque[Piece] = deque()

    def examine(
        self, calibrator: Calibrator, block: SampleBlock, circumstances: Circumstances
    ) -> Piece:
        """Let the calibrator take the block and judge."""
        return self._put(partial(_examined, calibrator, block, circumstances))

    def compare(self, calibrator: Calibrator, present: Affine, bias_b_rad_s: Array) -> Piece:
        """Tell the calibrator what a candidate must be better than."""
        return self._put(partial(calibrator.compare_with, present, bias_b_rad_s))

    def _put(self, make: Callable[[], Finding | None]) -> Piece:
        piece = Piece(make)
        self._pieces.append(piece)
        return piece

    def take(self, pieces: int) -> list[Finding]:
        """The findings of the oldest pieces; a record that lost some of them may ask for more."""
        taken = [self._pieces.popleft() for _ in range(min(pieces, len(self._pieces)))]
        return [found for piece in taken if (found := piece.finding()) is not None]


def _examined(calibrator: Calibrator, block: SampleBlock, now: Circumstances) -> Finding:
    new = calibrator.take(block)
    proposed, notes = calibrator.proposed, tuple(calibrator.take_notes(now.host_s))
    void = calibrator.take_void()
    if not new:
        return Finding(calibrator, now, proposed, notes, void=void)
    gates = calibrator.judged(now.at_s, now.health, now.basis, now.margin)
    return Finding(calibrator, now, proposed, notes, calibrator.estimate, gates, void)
