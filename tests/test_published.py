"""`ahrsd calibrate --method NAME|all` on a recording that was simulated."""

import json

import numpy as np
import pytest

from ahrsd.commands.calibrate import _METHODS
from ahrsd.methods import METHODS


def test_the_command_knows_every_method():
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


def test_all_methods_in_one_table(simulated, run, capsys):
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
        if entry["method"] in ("magyc", "ellipsoid", "magyc-bfg"):
            assert entry["converged"], entry["warnings"]
            error = np.linalg.norm(np.array(entry["hard_iron_gauss"]) - true)
            assert error < (5e-4 if entry["method"] == "magyc" else 0.02)
            assert entry["field_spread"]["everything"] < 0.02
            assert entry["field_spread"]["held_out"] < 0.05
        if entry["method"] == "twostep":  # no position was given, so no field magnitude
            assert entry["hard_iron_gauss"] is None
            assert "magnitude" in entry["warnings"][-1]


def test_one_method_says_no_with_exit_code_one(simulated, run, capsys):
    path, _ = simulated
    assert run("calibrate", path, "--method", "twostep") == 1
    assert "no answer" in capsys.readouterr().out


def test_a_figure_of_one_method_is_refused(simulated, run, capsys):
    path, _ = simulated
    assert run("calibrate", path, "--figure", path.with_name("one.png")) == 2
    assert "--figure compares the methods: give --method all" in capsys.readouterr().err
