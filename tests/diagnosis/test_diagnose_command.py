"""`ahrsd diagnose` from the command line: answers, files and bad input."""

import json
import math
from html.parser import HTMLParser

import numpy as np
import pytest

from ahrsd.diagnosis.calibration_fit.noise_fit import check_spec_noise
from ahrsd.diagnosis.external_simulation import align
from ahrsd.diagnosis.track import Spec
from ahrsd.errors import AhrsdError, RecordingError
from ahrsd.offline.diagnose import load_spec, load_track
from ahrsd.recording.table import write_table
from ahrsd.simulation import ScenarioSettings, simulate


def _settings(scenario, seed):
    return ScenarioSettings(scenario, "rov", seed, samples=3000, noise_gyro_rad_s=5e-4)


@pytest.fixture(scope="module")
def clean():
    """Columns of a recording without faults in all attitudes."""
    made = simulate(_settings("wam", 5)).samples
    columns = {"time_s": made.time_s}
    for k, axis in enumerate("xyz"):
        columns[f"mag_{axis}_gauss"] = made.raw_b_gauss[:, k]
        columns[f"gyro_{axis}_rad_s"] = made.gyro_b_rad_s[:, k]
    return columns


@pytest.fixture
def saved(tmp_path):
    """A function that writes columns and returns the file."""

    def write(columns, name="recording.csv"):
        path = tmp_path / name
        write_table(path, columns)
        return path

    return write


PER_AMPERE = np.array([2e-3, -1e-3, 1.5e-3])


def with_a_current(clean):
    """The first 1800 rows with a motor's current and its field."""
    changed = {name: values[:1800] for name, values in clean.items()}
    time_s = changed["time_s"]
    current = 5.0 + 4.0 * np.sign(np.sin(time_s / 3.0)) + np.sin(time_s * 0.7)
    for number, axis in enumerate("xyz"):
        changed[f"mag_{axis}_gauss"] = changed[f"mag_{axis}_gauss"] + PER_AMPERE[number] * current
    return changed | {"motor_current_a": current}


def test_current_is_found_and_all_files_are_written(run, saved, clean, tmp_path, capsys):
    folder = tmp_path / "report"
    answer = tmp_path / "answer.json"
    path = saved(with_a_current(clean))
    assert run("diagnose", str(path), "--json", str(answer), "--report", str(folder)) == 0
    body = json.loads(answer.read_text())
    assert body["schema"] == "ahrsd.diagnosis/1"
    assert [finding["effect"] for finding in body["findings"]] == ["motor_current_field"]
    for parameter, truth in zip(body["findings"][0]["parameters"], PER_AMPERE, strict=True):
        assert parameter["value"] == pytest.approx(truth, abs=max(4 * parameter["std"], 5e-5))
    text = (folder / "report.html").read_text()
    pictures = Pictures()
    pictures.feed(text)
    assert len(pictures.sources) >= 4
    assert all(source.startswith("data:image/svg+xml;base64,") for source in pictures.sources)
    assert "http" not in text.replace("http://www.w3.org", "")
    assert (folder / "diagnosis.rrd").stat().st_size > 10_000
    assert json.loads((folder / "diagnosis.json").read_text())["findings"] == body["findings"]
    assert "motor_current_field" in capsys.readouterr().out
    again = tmp_path / "again.csv"
    model = ("--model", str(folder / "model.json"), "--along", str(path))
    assert run("simulate", *model, "-o", str(again)) == 0


def test_report_of_wrong_axes_leaves_no_model_of_another_recording(run, saved, clean, tmp_path):
    folder, spec = tmp_path / "report", tmp_path / "my spec.json"
    folder.mkdir()
    (folder / "model.json").write_text("of another recording")
    spec.write_text('{"rate_hz": 25}')
    wrong = saved({**clean, "gyro_x_rad_s": -clean["gyro_x_rad_s"]}, "wrong.csv")
    options = ("--spec", str(spec), "--columns", "time=time_s:s")
    assert run("diagnose", str(wrong), *options, "--report", str(folder)) == 0
    assert json.loads((folder / "diagnosis.json").read_text())["findings"][0]["effect"] == (
        "frame_error"
    )
    assert not (folder / "model.json").exists()
    made_by = (
        "diagnose wrong.csv --spec &#39;my spec.json&#39; --columns time=time_s:s --report report"
    )
    assert made_by in (folder / "report.html").read_text()


@pytest.mark.slow
def test_simulation_of_the_repaired_model_contains_the_current(run, saved, clean, tmp_path):
    folder, again, found = tmp_path / "report", tmp_path / "again.csv", tmp_path / "found.json"
    path = saved(with_a_current(clean))
    assert run("diagnose", str(path), "--report", str(folder)) == 0
    model = ("--model", str(folder / "model.json"), "--along", str(path))
    assert run("simulate", *model, "-o", str(again)) == 0
    assert run("diagnose", str(again), "--json", str(found)) == 0
    effects = [finding["effect"] for finding in json.loads(found.read_text())["findings"]]
    assert effects == ["motor_current_field"]


class Pictures(HTMLParser):
    """Collects the sources that a page loads."""

    def __init__(self):
        super().__init__()
        self.sources = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag in ("img", "script", "link", "iframe"):
            self.sources.append(values.get("src") or values.get("href") or "")


def test_clean_recording_agrees_and_its_sensitivity_is_printed(run, saved, clean, capsys):
    assert run("diagnose", str(saved(clean))) == 0
    said = capsys.readouterr().out
    assert "recording and model agree" in said
    assert "this recording would have shown" in said


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: {k: v[:200] for k, v in c.items()}, "is too short to diagnose (samples: 200,"),
        (lambda c: {k: v for k, v in c.items() if k != "mag_z_gauss"}, "has no column mag_z_gauss"),
        (lambda c: {**c, "time_s": c["time_s"][::-1]}, "time goes back"),
        (lambda c: {**c, "mag_x_gauss": np.full(len(c["time_s"]), math.nan)}, "mag_x_gauss"),
    ],
)
def test_recording_that_cannot_be_diagnosed_is_refused_in_one_line(
    run, saved, clean, capsys, change, words
):
    code = run("diagnose", str(saved(change(clean))))
    err = capsys.readouterr().err
    assert code == 2
    assert words in err
    assert err.count("\n") == 1


def test_diverging_fit_is_reported_in_one_line(run, saved, clean, capsys, monkeypatch):
    def diverging(*_, **__):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr("ahrsd.diagnosis.inference.diagnose.diagnose", diverging)
    assert run("diagnose", str(saved(clean))) == 2
    told = capsys.readouterr().err
    assert "Eigenvalues" not in told
    assert "no calibration comes near these readings" in told
    assert told.count("\n") == 1


def test_unusable_column_is_noted_and_the_diagnosis_continues(run, saved, clean, capsys):
    rows = len(clean["time_s"])
    broken = np.full(rows, math.nan)
    broken[:10] = 3.0
    changed = {**clean, "motor_current_a": broken, "temperature_c": np.full(rows, 20.0)}
    assert run("diagnose", str(saved(changed))) == 0
    output = capsys.readouterr().out
    assert "recording.csv: recording and model agree" in output
    assert "note: column motor_current_a was left out" in output
    assert "note: column temperature_c was left out: it is 20 throughout" in output


@pytest.mark.slow
def test_recording_at_rest_has_no_finding(run, saved, clean, capsys):
    rng = np.random.default_rng(3)
    rows = len(clean["time_s"])
    still = {"time_s": clean["time_s"]}
    for axis, value in zip("xyz", (0.2, -0.1, 0.4), strict=True):
        still[f"mag_{axis}_gauss"] = value + 1e-3 * rng.standard_normal(rows)
        still[f"gyro_{axis}_rad_s"] = 5e-3 * rng.standard_normal(rows)
    assert run("diagnose", str(saved(still)), "--json", "-") == 0
    body = json.loads(capsys.readouterr().out)
    assert body["findings"] == []
    assert not body["unexplained"]["detected"]


def test_simulation_with_a_shifted_clock_is_aligned(saved, clean):
    real, _ = load_track(saved(clean))
    shifted = {**clean, "time_s": clean["time_s"] + 1.2}
    simulated, _ = load_track(saved(shifted, "simulation.csv"))
    overlap = align(real, simulated)
    assert len(overlap.real) == pytest.approx(len(real), abs=2)
    assert overlap.real.time_s[0] == pytest.approx(overlap.simulated.time_s[0], abs=0.05)
    assert any("shifted by +1.2" in note for note in overlap.notes)


@pytest.mark.parametrize("shift_s", [0.0, 1.2])
def test_simulation_of_a_part_is_aligned_with_that_part(saved, clean, shift_s):
    """The mean rate of a part differs from that of the whole; this must not shift it."""
    real, _ = load_track(saved(clean))
    part = {name: values[400:1150] for name, values in clean.items()}
    part["time_s"] = part["time_s"] + shift_s
    part["gyro_x_rad_s"] = part["gyro_x_rad_s"] + 0.02
    simulated, _ = load_track(saved(part, "part.csv"))
    overlap = align(real, simulated)
    first, last = clean["time_s"][[400, 1149]]
    assert overlap.simulated.time_s[[0, -1]] == pytest.approx([first, last], abs=0.021)
    assert any("was shifted" in note for note in overlap.notes) == (shift_s > 0)


def test_simulation_in_other_axes_is_aligned_by_the_magnitude_of_its_rate(saved, clean):
    real, _ = load_track(saved(clean))
    turned = {**clean, "time_s": clean["time_s"] + 0.8}
    turned["gyro_x_rad_s"], turned["gyro_y_rad_s"] = clean["gyro_y_rad_s"], -clean["gyro_x_rad_s"]
    simulated, _ = load_track(saved(turned, "turned.csv"))
    overlap = align(real, simulated)
    assert overlap.simulated.time_s[0] == pytest.approx(clean["time_s"][0], abs=0.021)


def test_simulation_of_another_time_or_motion_is_refused(run, saved, clean, capsys):
    real = saved(clean)
    far = saved({**clean, "time_s": clean["time_s"] + 1000.0}, "far.csv")
    assert run("diagnose", str(real), "--simulation", str(far)) == 2
    assert "overlaps the recording by 0.0 s only" in capsys.readouterr().err
    other = simulate(_settings("mam", 9)).samples
    moved = {"time_s": other.time_s}
    for k, axis in enumerate("xyz"):
        moved[f"mag_{axis}_gauss"] = other.raw_b_gauss[:, k]
        moved[f"gyro_{axis}_rad_s"] = other.gyro_b_rad_s[:, k]
    assert run("diagnose", str(real), "--simulation", str(saved(moved, "other.csv"))) == 2
    assert "is of another motion" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "must be an object"),
        ("{", "is not JSON"),
        ('{"sigma_mag_gauss": 0}', "sigma_mag_gauss = 0: must be a positive number"),
        ('{"rate_hz": "fast"}', "rate_hz = 'fast': must be a positive number"),
        ('{"field_gauss": true}', "must be a positive number"),
    ],
)
def test_wrong_spec_is_refused(tmp_path, text, words):
    path = tmp_path / "spec.json"
    path.write_text(text)
    with pytest.raises(AhrsdError, match=words):
        load_spec(path)


@pytest.mark.parametrize(("ratio", "lines"), [(1.03, 0), (0.98, 0), (1.2, 1), (0.04, 1)])
def test_spec_rate_that_differs_from_the_time_stamps_is_noted(saved, clean, ratio, lines):
    rate_hz = 1.0 / float(np.median(np.diff(clean["time_s"])))
    _, notes = load_track(saved(clean), spec=Spec(rate_hz=ratio * rate_hz))
    assert len([note for note in notes if "the stamps are used" in note]) == lines
    assert not any("--rate" in note for note in notes)


@pytest.mark.parametrize(
    ("spec", "used", "words"),
    [
        (Spec(sigma_mag_gauss=1e-3, sigma_gyro_rad_s=1e-5), True, None),
        (Spec(sigma_mag_gauss=0.05), True, "check its unit; only noise that is slow"),
        (Spec(sigma_mag_gauss=1e-4), True, "what the spec does not explain is a mismatch"),
        (Spec(sigma_mag_gauss=1e-5), False, "it was left out; check its unit, or the sensor"),
        (Spec(field_gauss=0.5), True, "the spec's field_gauss changes nothing"),
        (Spec(sigma_gyro_rad_s=0.05), True, "the spec says sigma_gyro_rad_s = 0.05, but"),
    ],
)
def test_spec_noise_that_the_readings_contradict_is_noted(saved, clean, spec, used, words):
    track, _ = load_track(saved(clean))
    left, notes = check_spec_noise(track, spec)
    assert left == (spec if used else Spec())
    assert len(notes) == (words is not None)
    assert all(words in note for note in notes)


def test_missing_recording_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="does not exist"):
        load_track(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            '{"rate": 40}',
            "spec.json: rate is no entry of a spec and was left out; is rate_hz meant",
        ),
        ('{"sigma_mag_gaus": 0.01}', "is sigma_mag_gauss meant?"),
        ('{"zzz": 1}', "it may have sigma_mag_gauss, sigma_gyro_rad_s, rate_hz, field_gauss"),
        ('{"sigma_mag_gauss": 10}', "sigma_mag_gauss = 10 was left out: a sensor has 1e-07 to 0.3"),
        ('{"field_gauss": 48000}', "field_gauss = 48000 was left out"),
    ],
)
def test_unused_entry_of_a_spec_is_noted(tmp_path, text, words):
    path = tmp_path / "spec.json"
    path.write_text(text)
    spec, (note,) = load_spec(path)
    assert spec == Spec()
    assert words in note


@pytest.mark.parametrize(
    ("factor", "words"),
    [(0.0, "it is 0 throughout, not even gravity"), (1 / 9.80665, "the acceleration was in g")],
)
def test_acceleration_of_zero_or_in_g_is_noted(saved, clean, factor, words):
    made = simulate(_settings("wam", 5)).samples
    more = {f"accel_{a}_m_s2": factor * v for a, v in zip("xyz", made.accel_b_m_s2.T, strict=True)}
    track, notes = load_track(saved({**clean, **more}))
    assert any(words in note for note in notes)
    if factor:
        assert track.accel_b_m_s2 == pytest.approx(made.accel_b_m_s2)
    else:
        assert track.accel_b_m_s2 is None


def test_row_without_acceleration_is_interpolated(saved, clean):
    made = simulate(_settings("wam", 5)).samples
    accel = made.accel_b_m_s2.copy()
    accel[100] = math.nan
    more = {f"accel_{a}_m_s2": v for a, v in zip("xyz", accel.T, strict=True)}
    track, notes = load_track(saved({**clean, **more}))
    assert "no acceleration in 1 row: filled from the rows next to it, turned by the gyro" in notes
    assert track.accel_b_m_s2 is not None
