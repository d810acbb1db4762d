"""What every test may rely on: the real recordings, where they are, and a small disk."""

from __future__ import annotations

import gc
import logging
import os
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

pytest_plugins = ["cpu_by_test"]  # --cpu-by-test FILE, in tests/support/runs

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

PROJECT = Path(__file__).parent.parent
SHARED = PROJECT.parent / "shared"
RECORDINGS = SHARED / "recordings"

#: what a clone does not have: marker, or fixture, of the tests that read it; folder; what it holds
ABSENT = {
    "recordings": (RECORDINGS, "the real recordings"),
    "field_cases": (SHARED / "field-cases", "the field cases"),
}

#: what a test module has, or a test asks for, that opens ports, sockets and processes
REAL = {"subprocess", "socket", "pty", "serial", "threading", "EmulatorProcess", "PtyEmulator"}
REAL_FIXTURES = {"live", "emulated", "small_disk"}


def _needs(item: pytest.Item, kind: str) -> bool:
    marked = item.get_closest_marker(kind) is not None
    return marked or kind in getattr(item, "fixturenames", ())


def _one_skip_a_file(items: list[pytest.Item]) -> list[pytest.Item]:
    """Where what lies beside the project is absent: one skip for all tests of a file that need it.

    A clone has none of it; a skip for each of a hundred parameters would hide any other skip.
    """
    by_file: dict[tuple[str, Path], list[pytest.Item]] = {}
    for item in items:
        for kind, (folder, _) in ABSENT.items():
            if not folder.is_dir() and _needs(item, kind):
                by_file.setdefault((kind, item.path), []).append(item)
    for (kind, _), (first, *others) in by_file.items():
        folder, what = ABSENT[kind]
        why = f"{what} (../shared/{folder.name}) are not here: {1 + len(others)} of this file need"
        first.add_marker(pytest.mark.skip(reason=f"{why} them"))
    return [other for _, *others in by_file.values() for other in others]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests without their files are told file by file; real ports get a second try."""
    if left_out := _one_skip_a_file(items):
        config.hook.pytest_deselected(items=left_out)
        out = set(left_out)
        items[:] = [item for item in items if item not in out]
    _second_try(items)


def _second_try(items: list[pytest.Item]) -> None:
    """A second try, printed as RERUN, where a test runs on real ports, sockets and processes.

    Their names and numbers belong to the machine: another worker may get the one that was let go.
    What is computed has no second try.
    """
    for item in items:
        module = vars(item.module) if isinstance(item, pytest.Function) else {}
        if REAL & module.keys() or REAL_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.flaky(reruns=1))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays: it is never searched for garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What a failed first try left open is let go, so that it does not fail the second as well."""
    if getattr(item, "execution_count", 1) > 1:
        for name in ("last_type", "last_value", "last_traceback", "last_exc"):
            vars(sys).pop(name, None)  # they hold the frames of the first try
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            gc.collect()


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


@pytest.fixture(autouse=True)
def plain_logging() -> None:
    """Levels as in a new process: a command that ran in this one may have set its own."""
    for name in ("ahrsd", "drivers"):
        logging.getLogger(name).setLevel(logging.NOTSET)


@pytest.fixture
def run() -> Iterator[Callable[..., int]]:
    """`run(*arguments)`: the exit code of `ahrsd ARGUMENTS`, in this process."""
    from ahrsd.__main__ import main

    def call(*arguments: object) -> int:
        with pytest.raises(SystemExit) as caught:
            main([str(argument) for argument in arguments])
        code = caught.value.code
        return code if isinstance(code, int) else 0

    root = logging.getLogger()
    handlers = root.handlers[:]
    yield call
    root.handlers[:] = handlers  # the command's own writes to a stderr that ends with the test


@pytest.fixture
def emulated() -> Callable[..., AbstractContextManager[tuple[object, str]]]:
    """`with emulated(faults=...) as (emulator, path)`: an emulated VN-100 on a pty."""
    from drivers.vn100.emulator.pty import PtyEmulator
    from drivers.vn100.emulator.scenarios import Setup, build

    @contextmanager
    def serve(**setup: object) -> Iterator[tuple[object, str]]:
        emulator = build(Setup(**setup))
        with PtyEmulator(emulator) as server:
            yield emulator, server.path

    return serve


class LiveDaemon:
    """An emulated VN-100 and the daemon, both in threads of this process, in real time.

    `heard` is what the device was sent, `events` what the core answered.
    """

    def __init__(self, folder: Path, setup: dict[str, object], tables: dict[str, object]) -> None:
        from ahrsd.config.config import check_config
        from ahrsd.daemon.core_runner import open_shell
        from ahrsd.daemon.daemon import Daemon
        from ahrsd.daemon.host_clock import HostClock
        from ahrsd.daemon.vehicle_files import VehicleFiles
        from drivers.vn100.emulator.pty import PtyEmulator
        from drivers.vn100.emulator.scenarios import Setup, build

        self.port = folder / "vn100"
        device = {"baud": 115200, "port": str(self.port), **tables.pop("device", {})}
        back = {"recheck_s": 5.0, **tables.pop("write_back", {})}  # samples count the sooner
        body = {"state_directory": str(folder), **tables, "device": device, "write_back": back}
        self.emulator = build(Setup(**setup))
        self.before = dict(self.emulator.memory.ram)
        self.heard = bytearray()
        self.served = PtyEmulator(self.emulator, link=self.port)
        receive = self.emulator.receive

        def listen(data: bytes, now_s: float) -> object:
            self.heard.extend(data)
            return receive(data, now_s)

        self.emulator.receive = listen
        config, clock = check_config(body, "test"), HostClock()
        self.capture = (config.capture.directory or folder) / "capture.mcap"
        self.shell = open_shell(config, clock, self.capture)
        self.core = self.shell.core
        self.events: list[object] = []
        self.shell.listeners.append(self.events.append)
        self.files = VehicleFiles(self, max_age_s=config.interlock.max_age_s)
        self.daemon = Daemon(config, self.shell, self.port, clock, self.files)
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="live-daemon")

    def safe(self) -> bool:
        """The vehicle's word."""
        return True

    def _run(self) -> None:
        try:
            self.daemon.run()
        except Exception as error:  # noqa: BLE001 - handed to the test
            self.error = error

    def __enter__(self) -> LiveDaemon:
        self.served.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        from ahrsd.daemon.core_runner import close_shell

        self.stop()
        close_shell(self.shell)
        self.served.stop()

    def stop(self) -> float:
        """Seconds that it took the daemon to end."""
        asked = time.monotonic()
        self.daemon.stop("test")
        return self.ended() - asked

    def ended(self) -> float:
        """When the daemon ended."""
        self._thread.join(30.0)
        assert not self._thread.is_alive()
        return time.monotonic()

    def until(self, condition: Callable[[], object], seconds: float = 15.0) -> None:
        """Wait for it, while the daemon runs."""
        end = time.monotonic() + seconds
        while not condition():
            assert self._thread.is_alive(), self.error
            assert time.monotonic() < end, "it did not happen in time"
            time.sleep(0.005)

    @property
    def samples(self) -> int:
        """How many the core has taken."""
        return int(self.core.stream.facts.samples)

    def flowing(self, seconds: float = 15.0) -> None:
        """Wait until further samples come."""
        count = self.samples
        self.until(lambda: self.samples > count, seconds)

    def noted(self, text: str) -> bool:
        """Whether the core noted something with this text."""
        return text in self.notes

    @property
    def notes(self) -> str:
        """All that the core noted."""
        return "\n".join(str(getattr(event, "text", "")) for event in list(self.events))

    @property
    def states(self) -> list[str]:
        """The write-back's states, as they came."""
        return [e.new for e in list(self.events) if type(e).__name__ == "StateChanged"]


@pytest.fixture
def live(tmp_path: Path) -> Callable[..., LiveDaemon]:
    """`with live({"rate_hz": 40}, mode="observe") as daemon`: see LiveDaemon."""

    def make(setup: dict[str, object] | None = None, **tables: object) -> LiveDaemon:
        return LiveDaemon(tmp_path, setup or {}, tables)

    return make
