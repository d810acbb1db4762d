"""Makes `tracks` importable: with importlib mode a test folder is on no path by itself."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ahrsd.diagnosis.answer.diagnosis import Diagnosis
from ahrsd.diagnosis.engines import ENGINES, ONE_MODEL, diagnosed
from ahrsd.diagnosis.one_model import diagnose as one_model
from ahrsd.diagnosis.rules import engine
from ahrsd.diagnosis.track import Spec, Track

sys.path.insert(0, str(Path(__file__).parent))


#: the experimental engine has its own tests in `one_model/`; these are over both in the slow form
BOTH = [pytest.param(one, marks=pytest.mark.slow if one == ONE_MODEL else ()) for one in ENGINES]


@pytest.fixture(params=BOTH)
def ask(request: pytest.FixtureRequest) -> Callable[..., Diagnosis]:
    """Each engine: a track and what is known of the sensor."""
    return one_model.diagnose if request.param == ONE_MODEL else engine.diagnose


@pytest.fixture(params=BOTH)
def ask_logged(request: pytest.FixtureRequest) -> Callable[[Track], Diagnosis]:
    """Each engine with what badly logged columns can still say, as users have it."""
    rest = {"spec": Spec(), "recording": "", "simulated": False}
    return lambda track: diagnosed(request.param, track, **rest)
