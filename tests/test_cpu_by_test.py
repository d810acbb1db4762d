"""The table of what tests cost: `pytest --cpu-by-test FILE`."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent

THREE_TESTS = """
import subprocess, sys, time
import pytest

def busy(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass

@pytest.fixture(scope="module")
def dear():
    busy(0.3)

def test_itself(dear):
    busy(0.2)

def test_later(dear):
    pass

def test_by_a_child():
    code = "import time\\nwhile time.process_time() < 0.4: pass"
    subprocess.run([sys.executable, "-c", code], check=True)
"""


@pytest.mark.parametrize("workers", [(), ("-n", "1")], ids=["alone", "worker"])
def test_seconds_are_reported_by_test_and_phase(tmp_path, workers):
    (tmp_path / "test_three.py").write_text(THREE_TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    command = [sys.executable, "-m", "pytest", "-p", "cpu_by_test", "--cpu-by-test", "cpu.csv"]
    support = str(HERE / "support" / "runs")
    done = subprocess.run(
        [*command, *workers, "test_three.py"], cwd=tmp_path, env={"PYTHONPATH": support},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    with (tmp_path / "cpu.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["cpu_s"]) for row in rows] == sorted(
        (float(row["cpu_s"]) for row in rows), reverse=True
    )
    by_test = {row["test"].split("::")[1]: row for row in rows}
    assert float(by_test["test_itself"]["setup_s"]) >= 0.3
    assert 0.2 <= float(by_test["test_itself"]["call_s"]) < 0.3
    assert float(by_test["test_later"]["cpu_s"]) < 0.1
    assert float(by_test["test_by_a_child"]["call_s"]) >= 0.4
    assert "in all; by test in cpu.csv" in done.stdout
