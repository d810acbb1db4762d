"""Recordings after public reports, each with its right value, by the command line.

The files lie beside the project (README there); without them the tests skip. What they have in
common with many others is tested in `test_foreign_tables.py` by a generator of our own.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.field_cases

FOLDER = Path(__file__).parents[3] / "shared" / "field-cases"
HARD_IRON_MG = np.array([120.0, -80.0, 60.0])
GYRO_BIAS_MRAD_S = np.array([3.5, -4.2, 2.1])


@dataclass(frozen=True)
class Case:
    """A command on a file, and what must be true of its answer.

    iron_mg, bias_mrad_s: how near the answer must be to the truth, None: not asked
    sigma_mg: what must be announced of the hard iron at most
    named, beside: what `diagnose` must name, and what it may name besides
    size: of what it names first, in SI and gauss, to 1 %
    has, has_not: words of the output
    """

    file: str
    command: str
    code: int = 0
    samples: int | None = None
    iron_mg: float | None = None
    bias_mrad_s: float | None = None
    sigma_mg: float | None = None
    named: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    size: Mapping[str, float] = field(default_factory=dict)
    has: tuple[str, ...] = ()
    has_not: tuple[str, ...] = ()


CASES = (
    Case("f19_mag_y_mirrored.csv.gz", "calibrate", 1,
         has=("not converged: the magnetometer is left-handed: negate its y",),
         has_not=("the rate in Hz",)),
    Case("f19_mag_y_mirrored.csv.gz", "diagnose", 0, has=("the magnetometer is left-handed",)),
    Case("f11_sdk_export_FA_06_0001_003E.csv.gz", "calibrate", 0, 1600, 1.0,
         has=("VectorNav's SDK",)),
    Case("f14_imu_mag.bag", "calibrate", 0, 80, has=("a ROS 1 bag: field of /imu/mag",)),
    Case("f15_ros2_imu_mag.mcap", "calibrate", 0, 80, has=("a ROS 2 recording (MCAP): field",)),
    Case("f17_tesla.csv.gz", "calibrate", 2, has=("it looks like T;", "mag_x=mag_x_gauss:T")),
    Case("f20_bunched_200hz.csv.gz", "calibrate", 0, 15000, 0.5, 0.3,
         has=("they scatter by 4.5 ms about a regular clock of 200 Hz",), has_not=("0.029 ms",)),
    Case("f20_bunched_200hz.csv.gz", "diagnose", 0,
         has=("scatter by 4.5 ms",), has_not=("timestamp_jitter", "0.029 ms")),
    Case("f21_pairs_with_one_stamp.csv.gz", "calibrate", 0, 800, 1.0, 0.5,
         has=("a host's", "regular clock of 20 Hz"), has_not=("double rows",)),
    Case("f23_1970_then_2025.csv.gz", "calibrate", 0, 1600, 1.0, 0.5,
         has=("the clock was set once, at row 603",)),
    Case("f23_1970_then_2025.csv.gz", "diagnose", 0, has=("the clock was set once",)),
    Case("f25_crcrlf.txt", "calibrate", 0, 400, 1.0, has=("CR CR LF",)),
    Case("f28_lfs_pointer.bin", "calibrate", 2, has=("is a Git LFS pointer", "git lfs pull")),
    Case("f29_truncated.csv.gz", "calibrate", 0, 794, 1.0,
         has=("truncated after 70004 unpacked bytes", "the last row is cut off")),
    Case("f30_last_row_cut.csv.gz", "calibrate", 0, 1199, 1.0, has=("the last row is cut off",)),
    Case("f32_nan_accel.csv.gz", "replay", 0, None, 1.0, 0.3,
         has=("no acceleration in 20 rows",),
         has_not=("add acceleration", "do not form an ellipsoid")),
    Case("f34_motor_current.csv.gz", "diagnose", 0,
         named=("motor_current_field",), beside=("gyro_integration", "mag_time_lag"),
         size={"field_per_ampere_x": 7.5e-3, "field_per_ampere_y": -3.75e-3,
               "field_per_ampere_z": 7.5e-3}),
    Case("f36_held_10hz_in_100hz.csv.gz", "calibrate", 0, 12000, 0.7, 0.3,
         has=("a new reading only every 10 samples",), has_not=("a magnet came near",)),
    Case("f37_circles_then_roll.csv.gz", "calibrate", 0, 3200, 0.5, 0.2, sigma_mg=1.0),
    Case("f37_circles_then_roll.csv.gz", "replay", 0, None, 0.5, 0.2, sigma_mg=1.0,
         has_not=("observability.",)),
)  # fmt: skip


#: cases that are tried in other files
ELSEWHERE = {
    "cli/test_field_cases_live.py": ["f01", "f02", "f03", "f04", "f06", "f07", "f09", "f25", "f38"],
    "recording/test_ros_recordings.py": ["f14", "f15"],
}


def test_every_case_of_the_folder_is_tested():
    table = (FOLDER / "README.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| (f\d+) ", table, re.MULTILINE))
    assert len(listed) >= 24
    tests = Path(__file__).parents[1]
    for file, names in ELSEWHERE.items():
        text = (tests / file).read_text(encoding="utf-8")
        assert [name for name in names if name not in text] == []
    here = {case.file.partition("_")[0] for case in CASES}
    assert listed - here - {name for names in ELSEWHERE.values() for name in names} == set()


def of_case(case: Case) -> object:
    """A diagnosis takes up to half a minute; shorter ones: diagnosis/test_diagnose_command.py."""
    name = f"{case.file.split('_')[0]}-{case.command}"
    is_long = case.command == "diagnose" and case.code != 2
    return pytest.param(case, id=name, marks=pytest.mark.slow if is_long else ())


@pytest.mark.parametrize("case", [of_case(case) for case in CASES])
def test_command_line_gives_the_correct_values(tmp_path, run, capsys, case):
    written = tmp_path / "answer.json"
    code = run(case.command, FOLDER / case.file, "--json", written)
    shown = "".join(capsys.readouterr())
    assert code == case.code, shown
    assert all(line.isprintable() for line in shown.splitlines())
    for words in case.has:
        assert words in shown
    for words in case.has_not:
        assert words not in shown
    if case.code == 2:
        assert len(shown.splitlines()) == 1
        return
    body = json.loads(written.read_text())
    if case.named:
        names = [one["effect"] for one in body["findings"]]
        assert set(case.named) <= set(names) <= set(case.named) | set(case.beside)
        sizes = {one["name"]: one["value"] for one in body["findings"][0]["parameters"]}
        assert {name: sizes[name] for name in case.size} == pytest.approx(case.size, rel=0.01)
    found = body.get("calibration", body)
    if case.samples is not None:
        assert found["samples"] == case.samples
    if case.iron_mg is not None:
        assert found["converged"]
        off = 1e3 * np.array(found["hard_iron_gauss"]) - HARD_IRON_MG
        assert np.max(np.abs(off)) < case.iron_mg
    if case.sigma_mg is not None:
        assert max(found["standard_deviation"]["hard_iron_gauss"]) < case.sigma_mg / 1e3
    if case.bias_mrad_s is not None:
        off = 1e3 * np.array(found["gyro_bias_rad_s"]) - GYRO_BIAS_MRAD_S
        assert np.max(np.abs(off)) < case.bias_mrad_s
