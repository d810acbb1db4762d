"""Makes `tracks` importable: with importlib mode a test folder is on no path by itself."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
