"""`ahrsd calibrate`: everything that was recorded, un-mapped through the registers of its time."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from contract import CALIBRATION, faults
from streams import binary_device, content, emitted

from ahrsd.config.config import CONFIG_KEY, Config, core_settings, print_config
from ahrsd.core.core import Core
from ahrsd.daemon.core_runner import JournalKeeper, Shell, journal_in
from ahrsd.events import Event, SamplesSeen
from ahrsd.inputs import LinkOpened, Received, RegistersKnown, Stop, Tick
from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.replay import replay
from ahrsd.recording.capture import CaptureReader, CaptureWriter
from drivers.vn100.emulator.emulator import Emulator
from drivers.vn100.emulator.physics import EmulatedTruth
from drivers.vn100.emulator.pty import PtyEmulator
from drivers.vn100.emulator.scenarios import Setup, build

FOLDER = Path(__file__).parents[2] / "fixtures" / "replays"
# A user's own registers: a wrong soft iron, a quarter turn about z and a tilt of 180 deg about x.
C23 = np.array([[1.10, 0.05, -0.02], [0.03, 0.93, 0.04], [-0.01, 0.02, 1.02]])
B23 = np.array([0.05, -0.12, 0.08])
R26 = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
C84 = np.array([[1.01, 0.0, 0.0], [0.0, 0.99, 0.002], [0.0, -0.002, 1.0]])
B84 = np.array([0.002, -0.003, 0.004])
REGISTERS = {
    23: (*C23.ravel().tolist(), *B23.tolist()),
    26: tuple(R26.ravel().tolist()),
    84: (*C84.ravel().tolist(), *B84.tolist()),
}


def corrected(register: list[float], truth: EmulatedTruth, h: np.ndarray) -> np.ndarray:
    """(N, 3) what a device with this register 23 puts out in true fields h, by the manual."""
    C, B = np.reshape(register[:9], (3, 3)), np.array(register[9:])
    m = h @ truth.soft_iron.T + truth.hard_iron_gauss
    return (m - B) @ C.T @ R26.T


def worst_angle_deg(one: np.ndarray, other: np.ndarray) -> float:
    one, other = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (one, other))
    return float(np.degrees(np.arccos(np.clip(np.sum(one * other, axis=1), -1.0, 1.0))).max())


@pytest.fixture(scope="module")
def true_fields() -> np.ndarray:
    """(500, 3) fields of 0.49 G from everywhere."""
    directions = np.random.default_rng(1).normal(size=(500, 3))
    return 0.49 * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def check_registers(found: dict[str, object], truth: EmulatedTruth, h: np.ndarray) -> None:
    """What would be written is right on the device, by arithmetic that shares nothing with ours."""
    written = found["registers"]
    assert set(written) == {"23", "84"}
    before = worst_angle_deg(corrected(list(REGISTERS[23]), truth, h), h @ R26.T)
    after = corrected(written["23"], truth, h)
    assert before > 10.0
    assert worst_angle_deg(after, h @ R26.T) < 0.3
    norms = np.linalg.norm(after, axis=1)
    assert norms.std() / norms.mean() < 0.003
    # the field's magnitude is not known, so the determinant stays as the user had it
    assert np.linalg.det(np.reshape(written["23"][:9], (3, 3))) == pytest.approx(
        np.linalg.det(C23), rel=1e-4
    )
    assert written["84"][:9] == pytest.approx(C84.ravel().tolist())
    sigma = np.array(found["standard_deviation"]["gyro_bias_rad_s"])
    assert np.abs((np.array(written["84"][9:]) - truth.gyro_bias_rad_s) / sigma).max() < 4.0
    assert np.abs(np.array(written["84"][9:]) - truth.gyro_bias_rad_s).max() < 5e-4


def test_a_capture_with_registers_in_force(run, tmp_path, capsys, true_fields):
    """`ahrsd capture` reads 23, 26 and 84; `ahrsd calibrate` undoes and composes them."""
    device = binary_device(8, REGISTERS)
    with PtyEmulator(device, speed=12.0, lossless=True) as server:
        assert run("capture", server.path, "-o", tmp_path / "a.mcap", "--seconds", 6,
                   "--baud", "115200") == 0  # fmt: skip
    capsys.readouterr()
    code = run("calibrate", tmp_path / "a.mcap", "--json", "-")
    found = json.loads(capsys.readouterr().out)
    assert code == 0, found["warnings"]
    assert faults(found, CALIBRATION) == []
    assert not any("not known" in text for text in found["warnings"])
    check_registers(found, device.truth, true_fields)


def test_registers_apply_to_samples_received_while_they_were_read(tmp_path, true_fields):
    """The first second of a capture arrives before the registers are known; it is not raw."""
    device = binary_device(9, REGISTERS)
    path = tmp_path / "a.mcap"
    with CaptureWriter(path, {}) as writer:
        for step in range(1200):
            if step == 100:  # 5 s of stream are there already
                values = {n: tuple(v) for n, v in REGISTERS.items()}
                writer.write(RegistersKnown(step * 50_000_000, values, "read before"))
            writer.write(Received((step + 1) * 50_000_000, device.advance((step + 1) / 20)))
        writer.write(Stop(1201 * 50_000_000, "end"))
    result = calibrate(path, Config())
    assert result.converged, result.reasons()
    assert result.samples > 2300
    check_registers(result.json("magyc"), device.truth, true_fields)


def record_daemon(path: Path, device: Emulator, seconds: float) -> Core:
    """What `ahrsd run` in mode observe records of this device, without a port and a clock."""
    config = Config()
    core = Core(core_settings(config))
    with CaptureWriter(path, {CONFIG_KEY: print_config(config)}) as writer:
        now_s = 0.0
        keeper = JournalKeeper(journal_in(path.parent), lambda: round(now_s * 1e9))
        shell = Shell(core, writer, keeper)
        device.receive(shell.feed(LinkOpened(1, "port", 115200)), 0.0)
        for step in range(round(seconds * 50)):
            now_s = (step + 1) / 50
            host_ns = round(now_s * 1e9)
            if data := device.advance(now_s):
                device.receive(shell.feed(Received(host_ns, data)), now_s)
            if core.deadline_ns is not None and core.deadline_ns <= host_ns:
                device.receive(shell.feed(Tick(host_ns)), now_s)
        shell.feed(Stop(round(seconds * 1e9) + 1, "end"))
    return core


def rows_of(event: Event) -> int:
    return len(event.block) if isinstance(event, SamplesSeen) else 0


def test_a_capture_of_the_daemon_replays_as_it_ran_and_calibrates_from_all_of_it(
    tmp_path, true_fields
):
    device = binary_device(10, REGISTERS)
    path = tmp_path / "run.mcap"
    live = record_daemon(path, device, 90.0)  # the newest ten wait for the device's answer
    assert live.registers[23] == pytest.approx(REGISTERS[23])
    assert CaptureReader(path).header[CONFIG_KEY]
    rows: list[int] = []
    replayed = replay(path, Config(), listeners=[lambda e: rows.append(rows_of(e))]).core
    assert replayed.decisions.entries == live.decisions.entries
    assert replayed.decisions.sha256 == live.decisions.sha256
    result = calibrate(path, Config())
    assert result.core.decisions.sha256 == live.decisions.sha256
    assert result.estimate is not None
    assert live.calibrator.estimate is not None
    assert result.estimate.samples > live.calibrator.estimate.samples + 200  # nothing is held out
    assert 3500 < sum(rows) == result.estimate.samples
    check_registers(result.json("magyc"), device.truth, true_fields)


def test_other_configuration_does_not_change_the_result_of_a_capture(tmp_path):
    path = tmp_path / "run.mcap"
    record_daemon(path, binary_device(10, {}), 10.0)
    done = replay(path, Config(mode="passive"))
    assert "the configuration in the capture was used, not the given one" in done.warnings


def test_every_sample_counts_and_the_answer_is_zero(run, tmp_path, capsys):
    path = FOLDER / "tumble_binary_restart.vnbin.gz"
    written = ("--json", tmp_path / "c.json", "--report", tmp_path / "r")
    assert run("calibrate", path, *written) == 0
    out = capsys.readouterr().out
    found = json.loads((tmp_path / "c.json").read_text())
    assert faults(found, CALIBRATION) == []
    assert found["samples"] == 1720
    assert found["converged"] is True
    assert found["method"] == "magyc"
    assert any("registers are not known" in text for text in found["warnings"])
    assert f"{path.name}: 1720 samples, method magyc" in out
    page = (tmp_path / "r" / "report.html").read_text()
    assert "Calibration of tumble_binary_restart" in page
    assert "registers are not known" in page
    assert json.loads((tmp_path / "r" / "calibration.json").read_text()) == found


def test_a_report_is_a_folder_as_with_every_command(run, tmp_path, capsys):
    path = FOLDER / "tumble_binary_restart.vnbin.gz"
    assert run("calibrate", path, "--report", tmp_path / "r.html") == 2
    assert "give a folder; the page is report.html in it" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_replaced_files_are_reported_before(run, tmp_path, capsys):
    path, target = FOLDER / "tumble_binary_restart.vnbin.gz", tmp_path / "c.json"
    assert run("calibrate", path, "--json", target) == 0
    assert "replaced" not in capsys.readouterr().err
    assert run("calibrate", path, "--json", target) == 0
    assert f"{target}: exists and will be replaced\n" in capsys.readouterr().err


@pytest.mark.parametrize("command", [("calibrate",), ("replay",), ("diagnose",)])
def test_json_to_a_forbidden_path_is_one_line(run, tmp_path, capsys, command):
    path = FOLDER / "tumble_binary_restart.vnbin.gz"
    for target in (tmp_path / "none" / "c.json", tmp_path):
        assert run(*command, path, "--json", target) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"ahrsd: {target}: ")
        assert error.count("\n") == 1


@pytest.mark.parametrize("command", [("replay", "--rerun"), ("montecarlo", "wam", "--json")])
def test_unwritable_folder_is_reported_before_any_work(run, capsys, command):
    """Root may write everywhere, says the system; /proc takes no file all the same."""
    first, *options = command
    path = [FOLDER / "tumble_binary_restart.vnbin.gz"] if first == "replay" else []
    assert run(first, *path, *options, "/proc/of_nobody.out") == 2
    said = capsys.readouterr()
    assert said.err.startswith("ahrsd: /proc/of_nobody.out: cannot be written: ")
    assert said.out == "" and said.err.count("\n") == 1


def test_unwritable_viewer_file_is_reported(run, tmp_path, capsys, monkeypatch):
    path = FOLDER / "tumble_binary_restart.vnbin.gz"
    monkeypatch.setattr("ahrsd.cli.recordings.replay.refuse_unwritable", lambda *_: None)
    assert run("replay", path, "--rerun", tmp_path / "none" / "run.rrd") == 2
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .startswith(f"ahrsd: {tmp_path / 'none' / 'run.rrd'}: is not whole: ")
    )


def test_position_and_date_give_the_field_of_the_world_model(run, tmp_path):
    """On the Black Sea at the beginning of 2026: 0.490 G (WMM2025), which is then no unknown."""
    path = FOLDER / "tumble_binary_restart.vnbin.gz"
    place = ("--position", "42.0,34.2", "--date", "2026-01-01")
    assert run("calibrate", path, "--json", tmp_path / "a.json") == 0
    assert run("calibrate", path, *place, "--json", tmp_path / "b.json") == 0
    plain, placed = (json.loads((tmp_path / f"{n}.json").read_text()) for n in "ab")
    assert placed["field_gauss"] == pytest.approx(0.490, abs=0.002)
    assert placed["field_known"] is True
    assert plain["field_known"] is False


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--position", "42"), "LAT,LON[,ALT] in deg and m is needed"),
        (("--position", "142,10"), "--position 142,10: "),
        (("--position", "x,y"), "--position x,y: "),
        (("--date", "2026-01-01"), "--date without --position"),
        (("--position", "42,10", "--date", "yesterday"), "--date yesterday: "),
    ],
)
def test_a_bad_place_or_day_is_one_line(run, capsys, options, words):
    path = FOLDER / "tumble_binary_restart.vnbin.gz"
    assert run("calibrate", path, *options) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory) -> Path:
    """20 s of VNYMR of a sensor at rest."""
    path = tmp_path_factory.mktemp("rest") / "rest.vnraw"
    path.write_bytes(emitted(build(Setup("static", seed=3)), 20.0))
    return path


def test_undetermined_calibration_is_refused_with_a_reason(run, at_rest, tmp_path, capsys):
    assert run("calibrate", at_rest, "--json", "-", "--report", tmp_path / "r") == 1
    found = json.loads(capsys.readouterr().out)
    assert faults(found, CALIBRATION) == []
    assert found["converged"] is False
    assert found["registers"] == {}
    (reason,) = [t for t in found["warnings"] if t.startswith("this motion does not determine: ")]
    assert "hard iron x" in reason
    page = (tmp_path / "r" / "report.html").read_text()
    assert "This motion does not determine: " in page


def test_text_output_lists_undetermined_directions(run, at_rest, capsys):
    assert run("calibrate", at_rest) == 1
    out = capsys.readouterr().out
    assert "hard iron  not determined, not determined, not determined mG" in out
    assert "carries the compensated field" in out
    assert "carries the compensated rate" in out
    assert "40 Hz (assumed: the factory's rate)" in out
    assert "registers are not known" in out


def test_a_compensated_rate_is_never_to_be_written(run, capsys):
    assert run("calibrate", FOLDER / "tumble_vnymr_damaged.vnraw.gz", "--json", "-") == 0
    assert set(json.loads(capsys.readouterr().out)["registers"]) == {"23"}


def test_a_recording_of_too_little_has_every_key(run, tmp_path, capsys):
    path = tmp_path / "tiny.vnraw"
    path.write_bytes(content(FOLDER / "tumble_vnymr_damaged.vnraw.gz")[:3_000])
    assert run("calibrate", path, "--json", "-") == 1
    found = json.loads(capsys.readouterr().out)
    assert set(CALIBRATION) <= set(found)
    assert found["soft_iron"] is None
    assert found["standard_deviation"] == {
        "soft_iron": None, "hard_iron_gauss": None, "gyro_bias_rad_s": None,
    }  # fmt: skip
    assert found["warnings"][-1] == "too few samples for an estimate"
