"""Every benchmark can be started as the docs say, by its path: it finds what it imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PARTS = ("__init__.py", "peer_process.py")
LOOK = """
import runpy, sys
kept, paths = set(sys.modules), list(sys.path)
for script in sys.argv[1:]:
    sys.path[:] = [script.rpartition("/")[0], *paths]
    try:
        runpy.run_path(script, run_name="looked_at")
    except ModuleNotFoundError as error:
        print(script, error)
    for name in set(sys.modules) - kept:
        if "/tests/" in (getattr(sys.modules[name], "__file__", None) or ""):
            del sys.modules[name]
"""


def test_each_finds_what_it_imports():
    scripts = [
        str(path)
        for path in sorted(HERE.glob("*/*.py"))
        if not path.name.startswith("test_") and path.name not in PARTS
    ]
    assert len(scripts) > 20
    done = subprocess.run(
        [sys.executable, "-c", LOOK, *scripts], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-2000:]
