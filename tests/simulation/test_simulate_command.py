"""`ahrsd simulate`: files that the other commands read, with the truth beside them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ahrsd.recording.table import read_table
from ahrsd.simulation import ScenarioSettings, simulate
from ahrsd.simulation.scenarios import quaternion
from drivers.vn100.decode import Measurement, decode
from drivers.vn100.deframer import Deframer


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet"])
def test_tables_keep_every_digit_and_say_the_truth(run, tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    arguments = ("--motion", "rov", "--seed", 5, "--seconds", 8, "--rate", 50)
    assert run("simulate", "mam", "-o", path, *arguments) == 0
    expected = simulate(ScenarioSettings("mam", "rov", seed=5, samples=400, rate_hz=50.0))
    table = read_table(path)
    assert np.array_equal(table.rows.raw_b_gauss, expected.samples.raw_b_gauss)
    assert np.array_equal(table.rows.gyro_b_rad_s, expected.samples.gyro_b_rad_s)
    assert np.array_equal(table.rows.accel_b_m_s2, expected.samples.accel_b_m_s2)
    assert table.starts == (0,)
    q = np.column_stack([table.rows.covariates[f"ref_q{part}"] for part in "wxyz"])
    assert Rotation.from_quat(q, scalar_first=True).as_matrix() == pytest.approx(
        expected.R_nb, abs=1e-12
    )
    truth = json.loads((tmp_path / f"x{suffix}.truth.json").read_text())
    assert np.array(truth["soft_iron"]) == pytest.approx(expected.truth.soft_iron)
    assert truth["hard_iron_gauss"] == pytest.approx([0.0376, 0.1094, 0.113])
    assert truth["made_from"]["seed"] == 5
    assert truth["made_from"]["hard_iron_is"] == "A m_b"


def test_the_byte_stream_is_what_a_device_prints(run, tmp_path):
    path = tmp_path / "x.vnraw"
    assert run("simulate", "lam", "-o", path, "--seconds", 4, "--noise-mag", 0) == 0
    frames = Deframer().feed(path.read_bytes())
    rows = [decode(frame) for frame in frames]
    assert all(isinstance(row, Measurement) for row in rows)
    assert {row.layout.name for row in rows} == {"VNYMR"}
    expected = simulate(ScenarioSettings("lam", samples=100, noise_mag_gauss=0.0))
    values = np.array([row.values for row in rows])
    assert values[:, 3:6] == pytest.approx(expected.samples.raw_b_gauss, abs=0.51e-4)
    assert values[:, 9:12] == pytest.approx(expected.samples.gyro_b_rad_s, abs=0.51e-6)
    heading = np.arctan2(expected.R_nb[:, 1, 0], expected.R_nb[:, 0, 0])
    assert values[:, 0] == pytest.approx(heading, abs=1e-5)


def test_the_same_command_gives_the_same_bytes(run, tmp_path):
    for name in ("a.csv.gz", "b.csv.gz"):
        assert run("simulate", "wam", "-o", tmp_path / name, "--seconds", 2) == 0
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


def test_disturbances_reach_the_file(run, tmp_path):
    path = tmp_path / "x.csv"
    assert run("simulate", "mam", "-o", path, "--seconds", 20, "--gap", 5, "--step", 10) == 0
    table = read_table(path)
    assert len(table.starts) == 2
    truth = json.loads((tmp_path / "x.csv.truth.json").read_text())
    assert truth["hard_iron_gauss"] != pytest.approx([0.0376, 0.1094, 0.113])
    assert truth["made_from"]["disturbances"]["gap_at_s"] == 5.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("wam", "-o", "x.txt"), "x.txt: unknown kind of file"),
        (("wam", "-o", "no/such/folder/x.csv"), "is no folder; make it first"),
        (("wam", "-o", "x.csv", "--seconds", "0"), "--seconds times --rate must be positive"),
        (("wam", "-o", "x.csv", "--noise-mag", "-1"), "noise_mag_gauss is -0.001"),
        (("wam", "-o", "x.csv", "--outliers", "2"), "outlier_fraction is 2"),
        (("wam", "-o", "x.csv", "--gyro", "y.csv"), "need each other"),
        (("recorded", "-o", "x.csv"), "need each other"),
        (("recorded", "-o", "x.csv", "--gyro", "y.csv"), "y.csv: cannot be read"),
        (("swim", "-o", "x.csv"), "'swim' is not one of"),
    ],
)
def test_bad_use_is_refused_in_one_line(run, tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert run("simulate", *arguments) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_field_on_the_motion_of_a_recording(run, tmp_path):
    source, path = tmp_path / "s.csv", tmp_path / "x.csv"
    assert run("simulate", "mam", "-o", source, "--seconds", 40, "--gap", 10) == 0
    assert run("simulate", "recorded", "--gyro", source, "-o", path, "--seconds", 20) == 0
    table = read_table(path)
    assert table.rows.time_s[[0, -1]] == pytest.approx([12.04, 32.04])
    made, moved = table.rows, read_table(source).rows
    rows = np.isin(moved.time_s, made.time_s)
    assert made.gyro_b_rad_s[1:] == pytest.approx(moved.gyro_b_rad_s[rows][1:], abs=1e-4)
    truth = json.loads((tmp_path / "x.csv.truth.json").read_text())
    assert truth["soft_iron"] == np.eye(3).tolist()
    assert truth["made_from"] == {"gyro": "s.csv", "seed": 0}


def test_quaternions_do_not_jump():
    made = simulate(ScenarioSettings("wam", "rov", samples=3000))
    q = quaternion(made.R_nb)
    assert np.linalg.norm(q, axis=1) == pytest.approx(np.ones(3000))
    assert np.linalg.norm(np.diff(q, axis=0), axis=1).max() < 0.02
