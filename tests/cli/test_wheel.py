"""The wheel holds the two packages and the unit, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=PROJECT,
        env={**os.environ, "SOURCE_DATE_EPOCH": "1577836800"},
        check=True,
        capture_output=True,
    )
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_it_holds_every_module_and_nothing_else(wheel):
    expected = {
        str(path.relative_to(PROJECT))
        for package in ("ahrsd", "drivers")
        for path in (PROJECT / package).rglob("*")
        if path.suffix in (".py", ".html", ".css", ".js", ".svg") or path.name == "py.typed"
    }
    found = {name for name in wheel.namelist() if not name.startswith("ahrsd-0.1.0.")}
    assert found - expected == set()
    assert expected - found == set()


def test_the_unit_and_the_rules_are_data(wheel):
    data = {name for name in wheel.namelist() if ".data/" in name}
    assert data == {
        "ahrsd-0.1.0.data/data/lib/systemd/system/ahrsd.service",
        "ahrsd-0.1.0.data/data/lib/systemd/system/ahrsd-page.service",
        "ahrsd-0.1.0.data/data/lib/systemd/system/ahrsd@.service",
        "ahrsd-0.1.0.data/data/lib/udev/rules.d/60-ahrsd.rules",
    }


def test_the_command_is_there(wheel):
    entry = wheel.read("ahrsd-0.1.0.dist-info/entry_points.txt").decode()
    assert "ahrsd = ahrsd.__main__:main" in entry


def test_the_licence_is_in_it_and_named(wheel):
    metadata = wheel.read("ahrsd-0.1.0.dist-info/METADATA").decode()
    assert "\nLicense-Expression: MIT\n" in metadata
    licence = wheel.read("ahrsd-0.1.0.dist-info/licenses/LICENSE").decode()
    assert licence == (PROJECT / "LICENSE").read_text()
    assert "the ahrsd developers" in licence


def test_the_unit_starts_the_command_and_knows_its_exit_codes():
    unit = (PROJECT / "systemd" / "ahrsd.service").read_text()
    assert "ExecStart=/opt/ahrsd/bin/ahrsd -v run --wait --config /etc/ahrsd.toml" in unit
    assert "RestartPreventExitStatus=2" in unit
    assert "Environment=OPENBLAS_NUM_THREADS=1" in unit
