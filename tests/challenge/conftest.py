"""The generator is a package of its own beside the tests; only here may it be imported."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))
