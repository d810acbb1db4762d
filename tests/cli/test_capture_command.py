"""`ahrsd capture` against the emulated device."""

from __future__ import annotations

import json
import os
import signal
import threading
import time

import pytest

from ahrsd.inputs import LinkLost, LinkOpened, Received, RegistersKnown, Stop
from ahrsd.recording.capture import CaptureReader, Sent

BAUD = ("--baud", "115200")


def test_identity_and_registers_come_first_then_the_stream(run, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):
        assert run("capture", path, "-o", tmp_path / "a.mcap", "--seconds", 1.5, *BAUD) == 0
        assert emulator.counters["saves"] == 0
    reader = CaptureReader(tmp_path / "a.mcap")
    items = list(reader)
    assert reader.notes == []
    assert reader.header["serial"] == "100130608"
    assert abs(items[0].wall_s - time.time()) < 60.0
    assert isinstance(items[1], LinkOpened)
    assert (items[1].port, items[1].baud) == (path, 115200)
    known = next(item for item in items if isinstance(item, RegistersKnown))
    assert known.values[23] == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    sent = b"".join(item.data for item in items if isinstance(item, Sent))
    assert sent.startswith(b"$VNRRG,01")
    assert all(line.startswith(b"$VNRRG,") for line in sent.splitlines())
    received = b"".join(item.data for item in items if isinstance(item, Received))
    assert received.count(b"$VNYMR,") >= 40
    assert isinstance(items[-1], Stop)
    stamps = [item.host_ns for item in items]
    assert stamps == sorted(stamps)
    (host_ns, snapshot), *_ = reader.facts("registers")
    assert snapshot["23"][0] == 1.0
    assert host_ns == known.host_ns
    assert "ended by --seconds 1.5" in capsys.readouterr().out


def test_a_device_with_unknown_firmware_can_be_recorded(run, emulated, tmp_path):
    with emulated(scenario="unknown-firmware") as (_, path):
        assert run("capture", path, "-o", tmp_path / "a.mcap", "--seconds", 0.5, *BAUD) == 0
    assert CaptureReader(tmp_path / "a.mcap").header["firmware"] == "7.0.0.0"


def test_passive_sends_no_byte(run, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):
        assert run("capture", path, "-o", tmp_path / "a.mcap", "--seconds", 1, "--passive") == 0
        assert emulator.counters["commands"] == 0
    items = list(CaptureReader(tmp_path / "a.mcap"))
    assert not [item for item in items if isinstance(item, Sent | RegistersKnown)]
    assert sum(item.data.count(b"$VNYMR") for item in items if isinstance(item, Received)) >= 20


def test_ctrl_c_ends_in_order(run, emulated, tmp_path, capsys):
    timer = threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT))
    with emulated() as (_, path):
        timer.start()
        assert run("capture", path, "-o", tmp_path / "a.mcap", "--passive", "--json", "-",
                   *BAUD) == 0  # fmt: skip
    timer.join()
    reader = CaptureReader(tmp_path / "a.mcap")
    items = list(reader)
    assert items[-1].reason == "SIGINT"
    assert reader.notes == []
    summary = json.loads(capsys.readouterr().out)
    assert summary["stopped_by"] == "SIGINT"
    assert summary["bytes"] == sum(len(i.data) for i in items if isinstance(i, Received))
    assert summary["lost_bytes"] == 0


def test_unplugging_keeps_the_received_data_and_is_code_75(run, emulated, tmp_path, capsys):
    with emulated() as (emulator, path):

        def unplug() -> None:
            time.sleep(1.0)
            emulator.plugged = False

        thread = threading.Thread(target=unplug)
        thread.start()
        assert run("capture", path, "-o", tmp_path / "a.mcap", "--passive", *BAUD) == 75
        thread.join()
    items = list(CaptureReader(tmp_path / "a.mcap"))
    assert isinstance(items[-2], LinkLost)
    assert sum(len(item.data) for item in items if isinstance(item, Received)) > 1000
    error = capsys.readouterr().err
    assert "is gone" in error
    assert "what came before is in" in error


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.vnraw", "ends in .mcap"),
        ("there.mcap", "exists already"),
        ("no/folder/a.mcap", "is no folder"),
    ],
)
def test_wrong_output_is_refused_before_the_port_is_opened(run, tmp_path, capsys, name, words):
    (tmp_path / "there.mcap").write_bytes(b"precious")
    assert run("capture", "/dev/does-not-exist", "-o", tmp_path / name) == 2
    assert words in capsys.readouterr().err
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"


def test_missing_port_leaves_no_file(run, tmp_path, capsys):
    assert run("capture", "/dev/does-not-exist", "-o", tmp_path / "a.mcap", *BAUD) == 75
    assert list(tmp_path.iterdir()) == []


def test_a_silent_device_is_75(run, emulated, tmp_path, capsys):
    with emulated(faults=("mute",)) as (_, path):
        assert run("capture", path, "-o", tmp_path / "a.mcap", "--passive", "--seconds", 1,
                   *BAUD) == 75  # fmt: skip
    assert "nothing was received" in capsys.readouterr().err
