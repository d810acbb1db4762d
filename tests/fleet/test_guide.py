"""The worked example of docs/guide/fleet.md is run as written."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path

import pytest
from fleet_kills import PYTHON, rows_of, write_archive
from free_port import free_port

pytest.importorskip("distributed", reason="distributed (the extra cluster) is not installed")

GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "fleet.md"


def example() -> str:
    (found,) = re.findall(r"^```sh\n(.*?)^```", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    return found


@pytest.fixture
def commands(tmp_path):
    """`ahrsd` and `dask` of this environment, found first."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("ahrsd", "dask"):
        path = folder / name
        path.write_text(f'#!/bin/sh\nexec "{PYTHON}" -m {name} "$@"\n')
        path.chmod(0o755)
    return folder


@pytest.mark.slow
def test_example_of_a_cluster_runs(tmp_path, commands):
    port = str(free_port())
    write_archive(tmp_path / "ARCHIVE", 4)
    script = example().replace("8786", port)
    assert script.count("&\n") == 3
    environment = {**os.environ, "PATH": f"{commands}:{os.environ['PATH']}"}
    # the scheduler takes a moment; a person types the last line when it is there
    *servers, run = script.strip().splitlines()
    with (tmp_path / "log").open("w") as log:
        group = subprocess.Popen(
            ["bash", "-c", "\n".join([*servers, "wait"])], cwd=tmp_path, env=environment,
            stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip
        try:
            wait_for_workers(f"tcp://127.0.0.1:{port}")
            done = subprocess.run(
                ["bash", "-c", run], cwd=tmp_path, env=environment, check=False,
                capture_output=True, text=True, timeout=200,
            )  # fmt: skip
        finally:
            os.killpg(group.pid, signal.SIGKILL)
            group.wait()
    assert done.returncode == 0, done.stderr + (tmp_path / "log").read_text()[-2000:]
    assert done.stdout.startswith("OUT: 4 recordings: 4 done")
    assert len(rows_of(tmp_path / "OUT")) == 4


def wait_for_workers(address: str) -> None:
    from distributed import Client

    with Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
