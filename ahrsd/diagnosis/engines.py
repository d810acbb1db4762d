"""The engines that answer in the contract's form, by name."""

from __future__ import annotations

from functools import partial

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.columns.logged import with_holes
from ahrsd.diagnosis.rules.logged import diagnose_logged
from ahrsd.diagnosis.track import Spec, Track

#: by rules; by one generative model, experimental (docs/design/engine.md)
RULES, ONE_MODEL = ENGINES = ("rules", "one-model")


def diagnosed(
    engine: str, track: Track, spec: Spec, *, recording: str, simulated: bool
) -> Diagnosis:
    """The answer of one of ENGINES.  ValueError, one line, where nothing can be fitted."""
    if engine == ONE_MODEL:
        from ahrsd.diagnosis.one_model.diagnose import diagnose  # whom it serves waits for it

        ask = partial(diagnose, recording=recording, simulated=simulated)
        return with_holes(track, spec, ask)
    return diagnose_logged(track, spec, recording=recording, simulated=simulated)
