"""`ahrsd run` on a pty: the cable is moved to another unit before and after an approval."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import pytest
from cabled_run import FIRST, SPARE, two_units
from patience import PATIENCE_S

CONFIG = """state_directory = "{folder}"
mode = "commit"
[device]
baud = 115200
serial_number = {serial}
[write_back]
recheck_s = 5.0
"""


class Served:
    """A cable on a pty, in real time."""

    def __init__(self) -> None:
        self.cable = two_units()
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self.lock = threading.Lock()

    def __enter__(self) -> Served:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)
        os.close(self._master)
        os.close(self._slave)

    def _serve(self) -> None:
        next_s = time.monotonic()
        while not self._stop.is_set():
            ready, _, _ = select.select([self._master], [], [], 0.005)
            if ready:
                with self.lock:
                    self.cable.receive(os.read(self._master, 4096))
            if time.monotonic() >= next_s:
                next_s += self.cable.step_s
                with self.lock:
                    data = self.cable.advance()
                if data:
                    os.write(self._master, data)


def until(log: Path, words: str, process: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while words not in log.read_text(encoding="utf-8"):
        assert process.poll() is None, log.read_text(encoding="utf-8")
        assert time.monotonic() < end_s, log.read_text(encoding="utf-8")
        time.sleep(0.1)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("bound", [FIRST])
def test_program_notices_another_unit_and_writes_nothing_to_it(tmp_path, bound):
    """A text stream without device time; the configuration binds the serial number."""
    config, log = tmp_path / "ahrsd.toml", tmp_path / "log"
    config.write_text(CONFIG.format(folder=tmp_path, serial=bound))
    with Served() as served, log.open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "ahrsd", "-v", "run", "--config", str(config), "--port",
             served.port], stdout=out, stderr=out,
        )  # fmt: skip
        try:
            until(log, "OBSERVING", process)
            with served.lock:
                served.cable.swap(SPARE, 2.0)
            until(log, f"another device, VN-100T-CR serial {SPARE}", process)
            assert str(FIRST) in log.read_text(encoding="utf-8")
            time.sleep(1.0)
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
            process.wait()
        spare = served.cable.units[SPARE]
    assert spare.writes == []
    assert spare.saves == []
    assert {line.split(",")[0] for line in spare.log} <= {"VNRRG", "VNASY"}
