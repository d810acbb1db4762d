"""`ahrsd calibrate --method NAME|all` on a simulated recording."""

import json
from datetime import date

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ahrsd.baselines import METHODS
from ahrsd.cli.recordings.calibrate import _METHODS
from ahrsd.config.config import Config
from ahrsd.config.sections import LocationSection
from ahrsd.offline.calibrate import calibrate
from ahrsd.offline.compare_methods import run_published


def test_command_offers_every_method():
    assert set(_METHODS) - {"magyc", "all"} == set(METHODS)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    from ahrsd.__main__ import main

    path = tmp_path_factory.mktemp("simulated") / "wam.csv"
    arguments = ["simulate", "wam", "-o", str(path), "--seed", "3", "--seconds", "200"]
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert not caught.value.code
    return path, json.loads(path.with_name("wam.csv.truth.json").read_text())


def test_all_methods_are_printed_in_one_table(simulated, run, capsys):
    path, truth = simulated
    target = path.with_name("all.json")
    picture = path.with_name("all.png")
    arguments = ("--method", "all", "--json", target, "--figure", picture)
    assert run("calibrate", path, *arguments) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if line.strip()][1:] == ["magyc", *METHODS]
    body = json.loads(target.read_text())["calibrations"]
    assert [entry["method"] for entry in body] == ["magyc", *METHODS]
    true = np.array(truth["hard_iron_gauss"])
    for entry in body:
        assert entry["duration_s"] == pytest.approx(199.96)
        if entry["method"] in ("magyc", "ellipsoid", "magyc-bfg"):
            assert entry["converged"], entry["warnings"]
            error = np.linalg.norm(np.array(entry["hard_iron_gauss"]) - true)
            assert error < (5e-4 if entry["method"] == "magyc" else 0.02)
            assert entry["field_spread"]["everything"] < 0.02
            assert entry["field_spread"]["held_out"] < 0.05
        if entry["method"] == "twostep":  # no position was given, so no field magnitude
            assert entry["hard_iron_gauss"] is None
            assert "magnitude" in entry["warnings"][-1]


def test_method_without_an_answer_exits_with_code_one(simulated, run, capsys):
    path, _ = simulated
    assert run("calibrate", path, "--method", "twostep") == 1
    assert "no answer" in capsys.readouterr().out


def test_figure_of_a_single_method_is_refused(simulated, run, capsys):
    path, _ = simulated
    assert run("calibrate", path, "--figure", path.with_name("one.png")) == 2
    assert "--figure compares the methods: give --method all" in capsys.readouterr().err


@pytest.mark.slow
def test_magfactor3_uses_the_device_attitude_when_place_and_attitude_are_known(simulated, tmp_path):
    """The device's yaw is magnetic. At the Black Sea the field has the dip of the simulated one."""
    path, truth = simulated
    names = path.read_text().split("\n", 1)[0].split(",")
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    q = rows[:, [names.index(f"ref_q{part}") for part in "xyzw"]]
    ypr = Rotation.from_quat(q).as_euler("ZYX", degrees=True)
    ypr[:, 0] -= np.degrees(np.arctan2(52.0, 227.0))  # the field m0 of the thesis
    header = ",".join([*names[:7], "vn_yaw_deg", "vn_pitch_deg", "vn_roll_deg"])
    table = tmp_path / "with_attitude.csv"
    np.savetxt(table, np.hstack([rows[:, :7], ypr]), "%.7g", ",", header=header, comments="")
    place = Config(
        location=LocationSection(latitude_deg=43.0, longitude_deg=34.0, date=date(2026, 7, 1))
    )
    found = run_published(calibrate(table, place), "magfactor3")
    assert found.converged, found.reason
    error = found.hard_iron_gauss - np.array(truth["hard_iron_gauss"])
    assert np.linalg.norm(error) < 0.04  # it has no soft iron: the published figure is 18 to 63 mG
    nowhere = run_published(calibrate(table, Config()), "magfactor3")
    assert "needs the attitude of every sample and the local field" in nowhere.reason


@pytest.mark.parametrize("method", [pytest.param("magyc", marks=pytest.mark.slow), "all"])
def test_clipped_readings_are_refused_in_one_line(simulated, tmp_path, run, capsys, method):
    """The project's own method would converge; its covariance does not show the clipped part."""
    path, _ = simulated
    names = path.read_text().split("\n", 1)[0]
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    rows[:, 1] = np.minimum(rows[:, 1], np.quantile(rows[:, 1], 0.8))
    table = tmp_path / "clipped.csv"
    np.savetxt(table, rows, "%.9g", ",", header=names, comments="")
    body = tmp_path / "c.json"
    assert run("calibrate", table, "--method", method, "--json", body) in (1, 2)
    said = capsys.readouterr()
    assert "readings of x stick at" in said.err + said.out or "not converged" in said.out
    if body.exists():
        ours = json.loads(body.read_text())
        ours = ours.get("calibrations", [ours])[0]
        assert ours["converged"] is False
