"""The rival tools get a fair problem, and use it as their packages do."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from blind_trials import INSTALL, rivals
from blind_trials.rival_columns import Regression, regression
from blind_trials.world.__main__ import csv_bytes
from blind_trials.world.cases import Order, make_case

from ahrsd.errors import AhrsdError
from ahrsd.estimator.online import Estimator
from ahrsd.recording.table import read_table

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def strong(tmp_path_factory):
    """A recording whose main motor's current makes a field that nobody can overlook."""
    order = Order("single", (("motor_current_field", 60.0),), motion="wam")
    path = tmp_path_factory.mktemp("case") / "case.csv.gz"
    path.write_bytes(csv_bytes(make_case(order, [3]).rows))
    return path


def problem(coefficients, noise=1.0, seed=0):
    """300 seconds at 10 Hz with unit columns and these coefficients, in standard deviations."""
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(9000, len(coefficients)))
    matrix /= np.linalg.norm(matrix, axis=0)
    residual = matrix @ coefficients + noise * rng.normal(size=9000)
    unit, root = np.linalg.qr(matrix)
    names = tuple(f"effect_{n}" for n in range(len(coefficients)))
    return Regression(
        residual, root, unit.T @ residual / np.std(residual), names, np.arange(3000) / 10
    )


@pytest.mark.slow
def test_the_true_column_is_among_the_first(strong, tmp_path):
    table = read_table(strong)
    order = Order("single", (("motor_current_field", 1.0),), motion="wam")
    weak = tmp_path / "weak.csv.gz"  # the same sensor and motion, calibrated next to undisturbed
    weak.write_bytes(csv_bytes(make_case(order, [3]).rows))
    estimator = Estimator()
    for block in read_table(weak).blocks():
        estimator.add(block)
    regressed = regression(table, estimator.finish())
    assert len(regressed.residual) == 3 * (len(table.rows) - 1)
    assert np.allclose(np.linalg.norm(regressed.root, axis=0), 1.0)
    correlation = (regressed.root.T @ regressed.target) ** 2
    assert regressed.names[int(np.argmax(correlation))] == "motor_current_field"
    # one-step residuals hold little of a slow field, but their noise is that of two readings
    sigma_gauss = np.std(regressed.residual)
    assert 1.2e-3 < sigma_gauss < 1.5e-3  # sqrt(2) 0.95 mG; calibration takes none of it
    assert {"gyro_scale", "field_gradient", "mag_time_lag", "moving_iron"} <= set(regressed.names)


def test_sensor_at_rest_has_no_finding(tmp_path):
    pytest.importorskip("pysindy", reason=INSTALL)
    rng = np.random.default_rng(0)
    rest = np.column_stack(
        [np.arange(200) / 25, [0.2, 0, 0.4] + 1e-3 * rng.normal(size=(200, 3)),
         1e-3 * rng.normal(size=(200, 3))]
    )  # fmt: skip
    path = tmp_path / "rest.csv"
    header = "time_s,mag_x_gauss,mag_y_gauss,mag_z_gauss,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s"
    np.savetxt(path, rest, delimiter=",", header=header, comments="")
    said = rivals.answer("stlsq", path)
    assert (said["mismatch"], said["findings"]) == (False, [])


@pytest.mark.slow
def test_a_package_that_is_missing_is_one_line(strong, monkeypatch):
    monkeypatch.setitem(sys.modules, "pysindy", None)
    monkeypatch.setitem(sys.modules, "pysindy.optimizers", None)
    with pytest.raises(AhrsdError, match=r"pip install -e '\.\[trials\]'"):
        rivals.answer("stlsq", strong)


def test_the_programs_errors_are_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        rivals.main(["stlsq", str(tmp_path / "none.csv"), "--json", str(tmp_path / "o.json")])
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.filterwarnings("ignore")
def test_stlsq_keeps_what_is_above_its_threshold():
    pytest.importorskip("pysindy", reason=INSTALL)
    found = rivals.coefficients_stlsq(problem([20.0, 0.0, -12.0, 2.0]))
    assert np.flatnonzero(found).tolist() == [0, 2]
    assert found[0] == pytest.approx(20, abs=3)


@pytest.mark.filterwarnings("ignore")
def test_lasso_with_bic_keeps_the_strong_ones():
    pytest.importorskip("sklearn", reason=INSTALL)
    found = rivals.coefficients_lasso(problem([20.0, 0.0, -12.0, 0.0, 0.0]))
    assert {0, 2} <= set(np.flatnonzero(found).tolist())
    assert np.count_nonzero(rivals.coefficients_lasso(problem([0.0] * 5))) == 0


@pytest.mark.filterwarnings("ignore")
def test_change_points_are_those_of_the_residual():
    pytest.importorskip("ruptures", reason=INSTALL)
    steady = problem([0.0])
    assert rivals.change_points_s(steady) == []
    residual = steady.residual + 0.8 * np.repeat(steady.time_s > 120, 3)
    stepped = Regression(residual, steady.root, steady.target, steady.names, steady.time_s)
    assert rivals.change_points_s(stepped) == pytest.approx([120], abs=2)


@pytest.mark.slow
def test_answer_has_the_documented_form(tmp_path, strong, monkeypatch):
    monkeypatch.setattr(
        rivals, "_TOOLS", {"stlsq": lambda p: rivals._answer([("gyro_scale", 0.5, [1.0, 9.0])])}
    )
    out = tmp_path / "o.json"
    rivals.main(["stlsq", str(strong), "--spec", "unused", "--json", str(out)])
    said = json.loads(Path(out).read_text())
    assert said["schema"] == "ahrsd.diagnosis/1"
    assert said["findings"][0]["where"]["intervals_s"] == [[1.0, 9.0]]
