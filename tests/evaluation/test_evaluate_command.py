"""`ahrsd evaluate` from the shell: figures, files, and one-line refusals."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest
from vehicle import HARD_IRON, SOFT_IRON

from ahrsd.calibration_json import CalibrationFileError, parse_calibration

GOOD = {
    "schema": "ahrsd.calibration/1", "method": "magyc", "recording": "circles.csv",
    "converged": True, "correction_matrix": np.linalg.inv(SOFT_IRON).tolist(),
    "soft_iron": SOFT_IRON.tolist(), "hard_iron_gauss": HARD_IRON.tolist(),
    "gyro_bias_rad_s": [1e-3, 0.0, 0.0], "field_gauss": 0.49, "field_known": False, "warnings": [],
}  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A recording of the vehicle as a table, its GPS fixes, and its true calibration."""
    from vehicle import drive

    vehicle = drive()
    folder = tmp_path_factory.mktemp("drive")
    track = vehicle.track
    columns = [track.time_s, *track.raw_b_gauss.T, *track.gyro_b_rad_s.T, *track.accel_b_m_s2.T]
    axes = ("mag_{}_gauss", "gyro_{}_rad_s", "accel_{}_m_s2")
    names = ["time_s", *(name.format(a) for name in axes for a in "xyz")]
    table = np.column_stack([*columns, *track.covariates.values()])
    header = ",".join([*names, *track.covariates])
    np.savetxt(folder / "drive.csv", table, "%.7g", ",", header=header, comments="")
    lat = 47.6 + np.degrees(vehicle.fixes.north_m / 6_371_000)
    lon = -122.3 + np.degrees(vehicle.fixes.east_m / 6_371_000 / np.cos(np.radians(47.6)))
    gps = "t_s,utc_tod_s,lat_deg,lon_deg,alt_m\n" + "".join(
        f"{t:.3f},nan,{a:.8f},{o:.8f},12.0\n"
        for t, a, o in zip(vehicle.fixes.time_s, lat, lon, strict=True)
    )
    (folder / "drive.gps.csv.gz").write_bytes(gzip.compress(gps.encode()))
    (folder / "c.json").write_text(json.dumps(GOOD))
    return folder


def test_command_writes_figures_table_and_json(files, run, capsys, tmp_path):
    code = run(
        "evaluate", files / "drive.csv", "--calibration", files / "c.json", "--report",
        tmp_path / "out", "--date", "2026-07-01",
    )  # fmt: skip
    out = capsys.readouterr().out
    assert code == 0
    body = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert (tmp_path / "out" / "evaluation.png").read_bytes().startswith(b"\x89PNG")
    assert body["schema"] == "ahrsd.evaluation/1"
    assert body["held_out"] is True
    assert body["better"] is True
    (heading,) = body["heading"]
    assert heading["reference"] == "GPS course"
    assert heading["after"]["rms_deg"] < 0.1 < 5.0 < heading["before"]["rms_deg"]
    assert body["dead_reckoning"]["after"]["rms_percent"] < 0.1
    assert body["field"]["after"]["spread"] < 1e-3
    assert body["world_field"]["model"] == "WMM2025"
    assert any("middle GPS fix: 47." in text for text in body["warnings"])
    assert "RMS error [deg]" in out
    assert "dead reckoning by Doppler velocity" in out


def test_world_field_is_from_the_igrf_or_given(files, run, capsys):
    arguments = ("--position", "47.6,-122.3,10", "--date", "2026-07-01", "--model", "igrf")
    base = ("evaluate", files / "drive.csv", "--calibration", files / "c.json", "--json", "-")
    assert run(*base, *arguments) == 0
    assert json.loads(capsys.readouterr().out)["world_field"]["model"] == "IGRF-14"


def test_worse_calibration_exits_with_code_one(files, run, capsys, tmp_path):
    bad = {**GOOD, "hard_iron_gauss": [0.3, 0.0, 0.0], "converged": False}
    (tmp_path / "bad.json").write_text(json.dumps(bad))
    assert run("evaluate", files / "drive.csv", "--calibration", tmp_path / "bad.json") == 1
    assert "has not converged" in capsys.readouterr().out


def test_reference_table_may_have_attitude_or_heading(files, run, capsys, tmp_path):
    from vehicle import drive

    vehicle = drive()
    rows = np.column_stack([vehicle.track.time_s[::5], np.degrees(vehicle.heading_rad[::5])])
    path = tmp_path / "compass.csv"
    np.savetxt(path, rows, "%.6f", ",", header="time_s,compass_deg", comments="")
    base = ("evaluate", files / "drive.csv", "--calibration", files / "c.json", "--json", "-")
    assert run(*base, "--reference", path, "--heading-column", "compass_deg") == 0
    (heading,) = json.loads(capsys.readouterr().out)["heading"]
    assert heading["reference"] == "column compass_deg"
    assert heading["after"]["rms_deg"] < 0.3
    path.write_text("time_s,compass_deg\n2.0,1\n1.0,2\n")
    assert run(*base, "--reference", path) == 2
    assert "time_s does not go forward" in capsys.readouterr().err
    path.write_text("seconds,compass\n1,2\n2,3\n")
    assert run(*base, "--reference", path) == 2
    assert "is no reference: it needs time_s" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--position", "47.6,-122.3"), "--position without --date"),
        (("--position", "north", "--date", "2026-01-01"), "LAT,LON[,ALT] in deg and m"),
        (("--position", "95,0", "--date", "2026-01-01"), "latitude 95.0 deg is not within"),
        (("--position", "1,2", "--date", "2031-01-01"), "no world magnetic model for the year 20"),
        (("--position", "1,2", "--date", "1999-01-01"), "or take --model igrf, which has older"),
        (("--date", "yesterday"), "YYYY-MM-DD is needed"),
        (("--heading-column", "nose_deg"), "no column nose_deg"),
        (("--tilt", "device"), "nothing says which way is up"),
        (("--method", "fnp"), "is of magyc, not of fnp"),
        (("--reference", "missing.csv"), "missing.csv: cannot be read: No such file"),
        (("--json", "no/where.json"), "is no folder"),
    ],
)  # fmt: skip
def test_unusable_input_is_refused_in_one_line(files, run, capsys, arguments, words):
    code = run("evaluate", files / "drive.csv", "--calibration", files / "c.json", *arguments)
    said = capsys.readouterr().err
    assert code == 2
    assert words in said
    assert said.count("\n") == 1


def test_bad_gps_file_is_refused(files, run, capsys, tmp_path):
    base = ("evaluate", files / "drive.csv", "--calibration", files / "c.json")
    for text, words in (
        ("t_s,lat_deg\n1,2\n", "has no column lon_deg; a GPS file needs t_s, lat_deg, lon_deg"),
        ("lat_deg,lon_deg\n1,2\n", "has no column t_s"),
        ("t_s,lat_deg,lon_deg\n1,2,3\n", "1 fixes with time and position; 10 are needed"),
    ):
        path = tmp_path / "g.csv"
        path.write_text(text)
        assert run(*base, "--reference", path) == 2
        assert words in capsys.readouterr().err
    (tmp_path / "g.csv.gz").write_bytes(b"\x1f\x8b no gzip")
    assert run(*base, "--reference", tmp_path / "g.csv.gz") == 2
    assert "the gzip file is damaged" in capsys.readouterr().err


BAD = [
    ({"schema": "ahrsd.replay/1"}, "its schema is 'ahrsd.replay/1', not 'ahrsd.calibration/1'"),
    ({"schema": None}, "its schema is None"),
    ({"hard_iron_gauss": None, "warnings": ["too few samples"]}, "no answer of magyc: too few"),
    ({"hard_iron_gauss": [133.0, 328.0, 60.0]}, r"size 359, more than 10; it must be in gauss"),
    ({"hard_iron_gauss": [0.1, 0.2]}, "hard_iron_gauss is not 3 finite numbers"),
    ({"hard_iron_gauss": [0.1, 0.2, float("nan")]}, "hard_iron_gauss is not 3 finite numbers"),
    ({"hard_iron_gauss": "much"}, "hard_iron_gauss is not 3 finite numbers"),
    ({"gyro_bias_rad_s": [3.0, 0, 0]}, "it must be in rad/s"),
    ({"field_gauss": 49_000.0}, "field_gauss has size 4.9e\\+04, more than 10"),
    ({"correction_matrix": [[1, 0, 0], [0, 1, 0]]}, "correction_matrix is not 3 x 3 finite"),
    ({"correction_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "singular, or it mirrors"),
    ({"correction_matrix": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "singular, or it mirrors"),
    ({"soft_iron": np.eye(3).tolist()}, "is not the inverse of soft_iron"),
    ({"converged": "yes"}, "converged is not true or false"),
]


@pytest.mark.parametrize(("change", "words"), BAD)
def test_wrong_calibration_json_is_refused_in_one_line(change, words):
    with pytest.raises(CalibrationFileError, match=words) as caught:
        parse_calibration({**GOOD, **change}, "c.json")
    assert str(caught.value).startswith("c.json: ")
    assert "\n" not in str(caught.value)


def test_calibration_json_without_soft_iron_corrects_only_hard_iron():
    found = parse_calibration({**GOOD, "correction_matrix": None, "soft_iron": None}, "c.json")
    assert np.array_equal(found.correction.matrix, np.eye(3))
    assert any("only the hard iron" in text for text in found.remarks)
    for junk in ([], 3, None, "text"):
        with pytest.raises(CalibrationFileError, match="no JSON object"):
            parse_calibration(junk, "c.json")


def test_one_of_several_calibrations_can_be_chosen():
    many = {"schema": "ahrsd.calibrations/1", "calibrations": [GOOD, {**GOOD, "method": "fnp"}]}
    assert parse_calibration(many, "c.json", "fnp").method == "fnp"
    with pytest.raises(CalibrationFileError, match="choose one with --method: magyc, fnp"):
        parse_calibration(many, "c.json")
    with pytest.raises(CalibrationFileError, match="holds none of np"):
        parse_calibration(many, "c.json", "np")


def test_file_that_is_not_json_is_refused(files, run, capsys, tmp_path):
    (tmp_path / "x.json").write_text("{")
    assert run("evaluate", files / "drive.csv", "--calibration", tmp_path / "x.json") == 2
    assert "is no JSON" in capsys.readouterr().err
    assert run("evaluate", files / "drive.csv", "--calibration", tmp_path / "none.json") == 2
    assert "none.json: cannot be read: No such file" in capsys.readouterr().err


def test_all_calibrations_of_a_file_are_in_one_table(files, run, capsys, tmp_path):
    worse = {**GOOD, "method": "ellipsoid", "converged": False,
             "hard_iron_gauss": (HARD_IRON + 0.03).tolist()}  # fmt: skip
    none = {"method": "tls", "hard_iron_gauss": None, "warnings": ["needs the field's magnitude"]}
    many = {"schema": "ahrsd.calibrations/1", "calibrations": [GOOD, worse, none]}
    (tmp_path / "all.json").write_text(json.dumps(many))
    code = run(
        "evaluate", files / "drive.csv", "--calibration", tmp_path / "all.json",
        "--method", "all", "--json", tmp_path / "e.json",
    )  # fmt: skip
    lines = capsys.readouterr().out.splitlines()
    assert code == 0
    first = next(k for k, line in enumerate(lines) if line.startswith("(before)"))
    assert [line.split()[0] for line in lines[first : first + 4]] == [
        "(before)", "magyc", "ellipsoid", "tls",
    ]  # fmt: skip
    assert lines[first + 2].endswith("not converged")
    assert "no answer" in lines[first + 3] and "needs the field's magnitude" in lines[first + 3]
    body = json.loads((tmp_path / "e.json").read_text())
    assert body["schema"] == "ahrsd.evaluations/1"
    rms = [one["heading"][0]["after"]["rms_deg"] for one in body["evaluations"]]
    printed = [float(line.split()[1]) for line in lines[first + 1 : first + 3]]
    assert printed == pytest.approx(rms, abs=0.006)
    assert rms[0] < 1.0 < rms[1]
    assert set(body["without"]) == {"tls"}
    low, high = body["heading_rms_difference_deg"]["ellipsoid"]
    assert low < rms[1] - rms[0] < high
    assert f"{low:+.2f} to {high:+.2f}" in lines[first + 2]


def test_table_needs_several_calibrations(files, run, capsys):
    code = run(
        "evaluate", files / "drive.csv", "--calibration", files / "c.json", "--method", "all"
    )
    assert code == 2
    assert "leave `--method all` out" in capsys.readouterr().err
