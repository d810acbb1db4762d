"""What every test may rely on: the real recordings, where they are, and a small disk."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

PROJECT = Path(__file__).parent.parent
RECORDINGS = PROJECT.parent / "shared" / "recordings"


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which is not part of the project."""
    if not RECORDINGS.is_dir():
        pytest.skip("the real recordings (../shared/recordings) are not here")
    return RECORDINGS


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB; only root can mount one."""
    if os.geteuid() != 0:
        pytest.skip("only root can mount a small file system")
    mount = tmp_path / "small"
    mount.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(mount)]
    if subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        yield mount
    finally:
        subprocess.run(["umount", str(mount)], check=True)


@pytest.fixture
def run() -> Callable[..., int]:
    """`run(*arguments)`: the exit code of `ahrsd ARGUMENTS`, in this process."""
    from ahrsd.__main__ import main

    def call(*arguments: object) -> int:
        with pytest.raises(SystemExit) as caught:
            main([str(argument) for argument in arguments])
        code = caught.value.code
        return code if isinstance(code, int) else 0

    return call


@pytest.fixture
def emulated() -> Callable[..., AbstractContextManager[tuple[object, str]]]:
    """`with emulated(faults=...) as (emulator, path)`: an emulated VN-100 on a pty."""
    from drivers.vn100.emulator_pty import PtyEmulator
    from drivers.vn100.emulator_scenarios import Setup, build

    @contextmanager
    def serve(**setup: object) -> Iterator[tuple[object, str]]:
        emulator = build(Setup(**setup))
        with PtyEmulator(emulator) as server:
            yield emulator, server.path

    return serve
