"""Short forms of the comparisons with the peers and with the thesis: no network, seconds long.

The peers' package is replaced by a fake of the same signature; where its environment and the tool
are at hand (AHRSD_PEERS names the benchmark's cache folder), the real one answers too.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from ahrsd.montecarlo.runs import OURS, STREAM, Plan

BENCHMARKS = Path(__file__).parent
FAKE = '''
"""A peer that knows the answer, one that is off, and one that fails."""
import numpy as np

B = np.array([37.6, 109.4, 113.0])
A = np.array([[1.10, 0.10, 0.04], [0.10, 0.88, 0.02], [0.04, 0.02, 1.22]])
W = np.array([4e-3, -5e-3, 2e-3])

def sg(x):
    return x[25:-25]

def make(mag, gyro, t, rph, m0):
    assert mag.shape[1] == gyro.shape[1] == 3 and abs(np.linalg.norm(m0) - 498) < 1.0
    def broken():
        raise RuntimeError("singular\\nand more")
    known = {name: lambda: (B + [0.0, 3.0, 4.0], A + 0.01 * np.eye(3), W) for name in NAMES}
    known["MAGYC-NLS"] = lambda: (B + [0.0, 0.3, 0.4], A + 0.001 * np.eye(3), W + [0.0, 0.0, 1e-3])
    known["MAGYC-IFG"] = broken
    known["MAGYC-IFG +sg"] = lambda: (B * np.nan, A, W)
    known["ellipsoid_fit_fang"] = lambda: (B + 1e3 * (len(mag) < 1500), -A, None)
    return known
'''


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))

    def load(name):
        spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def peers(benchmark, tmp_path, monkeypatch):
    """The benchmark with the fake tool, this interpreter, and 60 s a run."""
    bench = benchmark("bench_peers")
    tool = tmp_path / "fake.py"
    tool.write_text(FAKE + f"NAMES = {bench.PEERS!r}\n")
    monkeypatch.setattr(bench, "TOOL", tool)
    monkeypatch.setattr(bench, "AT_S", 60.0)
    monkeypatch.setattr(bench, "environment", lambda _cache: Path(sys.executable))
    return bench


@pytest.mark.slow
def test_the_comparison_from_end_to_end(peers, tmp_path, capsys):
    arguments = ["--cache", tmp_path / "c", "--runs", "2,1", "--sets", "mam", "--motions", "rov"]
    peers.main([str(a) for a in (*arguments, "--output", tmp_path / "out")])
    written = json.loads((tmp_path / "out" / "peers.json").read_text())
    assert written["package"] == "magyc==1.0.0"
    (only,) = written["sets"]
    rows = {row["method"]: row for row in only["rows"]}
    assert list(rows)[:2] == [OURS, STREAM]
    assert set(rows) == {OURS, STREAM, *peers.PEERS}
    nls = rows["MAGYC-NLS"]
    assert (nls["answered"], nls["runs"]) == (1, 1)
    assert rows["MAGYC-NLS +sg"]["answered"] == 2
    assert nls["against_bound"]["hard_iron_gauss"]["rmse"] == pytest.approx(0.5e-3)
    assert nls["against_bound"]["gyro_bias_rad_s"]["rmse"] == pytest.approx(1e-3)
    failed = rows["MAGYC-IFG"]
    assert (failed["answered"], failed["runs"]) == (0, 1)
    assert failed["failures"] == {"singular": 1}
    assert rows["MAGYC-IFG +sg"]["failures"] == {"the answer is not finite": 1}
    fang = rows["ellipsoid_fit_fang mended"]["against_bound"]
    assert fang["hard_iron_gauss"]["rmse"] == pytest.approx(0.0, abs=1e-12)
    assert fang["soft_iron"]["rmse"] == pytest.approx(0.0, abs=1e-12)
    smoothed = rows["ellipsoid_fit_fang mended +sg"]["against_bound"]["hard_iron_gauss"]
    assert smoothed["rmse"] > 1.0  # the fake saw 50 readings fewer
    best = only["best_peers"][OURS]
    assert best["hard_iron_gauss"]["peer"] == "ellipsoid_fit_fang mended"
    assert best["gyro_bias_rad_s"]["peer"] == "MAGYC-NLS +sg"
    text = (tmp_path / "out" / "table.md").read_text()
    assert "| `MAGYC-NLS` | 1/1 | 0.500 |" in text
    assert (tmp_path / "out" / "peers.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert "peers: seed 1" in capsys.readouterr().err


def test_existing_answers_are_not_computed_again(peers, tmp_path, monkeypatch):
    arguments = ["--cache", str(tmp_path), "--runs", "1", "--sets", "wam", "--motions", "rov"]
    peers.main([*arguments, "--only-peers"])
    kept = tmp_path / "peers" / "wam-rov" / "0.jsonl"
    lines = kept.read_text().splitlines()
    assert len(lines) == len(peers.PEERS)
    kept.write_text("\n".join([*lines[:-1], lines[-1][:20]]))  # the last one was cut by a kill
    peers.main([*arguments, "--only-peers"])
    assert set(peers.answers(kept)) == set(peers.PEERS)

    def never(*_arguments, **_options):
        raise AssertionError("asked again")

    monkeypatch.setattr(peers.subprocess, "run", never)
    peers.main([*arguments, "--only-peers"])


def test_without_the_tool_it_says_so_in_one_line(peers, tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "TOOL", tmp_path / "nothing.py")
    with pytest.raises(SystemExit, match=r"^the peers' module .* is not here$"):
        peers.main(["--cache", str(tmp_path)])


def test_dead_process_of_a_peer_is_reported(peers, tmp_path):
    peers.TOOL.write_text("raise SystemExit('no numpy here')")
    with pytest.raises(SystemExit, match=r"ended before MAGYC-NLS \+sg: no numpy here"):
        peers.main(["--cache", str(tmp_path), "--runs", "1", "--sets", "wam", "--motions", "rov"])


@pytest.mark.parametrize("runs", ["0", "1,2", "a", "4,3,2,1"])
def test_bad_numbers_of_runs_are_refused(peers, tmp_path, runs, capsys):
    with pytest.raises(SystemExit):
        peers.main(["--cache", str(tmp_path), "--runs", runs])
    assert "--runs" in capsys.readouterr().err


@pytest.mark.slow
def test_time_is_compared_on_the_same_samples(peers, tmp_path):
    peers.TOOL.write_text(peers.TOOL.read_text().replace('known["MAGYC-IFG"] = broken', ""))
    rows = peers.times(tmp_path, Path(sys.executable), peers.TOOL, (600,))
    assert [(row["motion"], row["samples"]) for row in rows] == [("slow", 600), ("rov", 600)]
    for row in rows:
        assert row[f"ratio {OURS}"] == pytest.approx(row["MAGYC-IFG"] / row[OURS])


def test_the_real_peers_answer(benchmark, tmp_path):
    """One strong peer of the real package on 400 s: within the figures that were measured once."""
    bench = benchmark("bench_peers")
    python = Path(os.environ.get("AHRSD_PEERS", "")) / "env" / "bin" / "python"
    if "AHRSD_PEERS" not in os.environ or not python.exists():
        pytest.skip("AHRSD_PEERS does not name a cache folder of bench_peers.py")
    if not bench.TOOL.is_file():
        pytest.skip("the peers' module ../shared/tools/magyc_peers.py is not here")
    plan = Plan("wam", "slow", at_s=(bench.AT_S,))
    names = ("MAGYC-NLS +sg", "ellipsoid_fit_fang mended")
    case = bench.Case(plan.settings(0), tmp_path / "0.jsonl", names)
    bench.ask_peers(python, bench.TOOL, [case])
    found = bench.peers_results(case)
    assert [r["failure"] for r in found] == [None, None]
    assert all(r["errors"]["hard_iron_gauss"] < 1.5e-3 for r in found)


def test_the_thesis_figures(benchmark, tmp_path, capsys):
    thesis = benchmark("bench_thesis")
    plan = Plan("wam", "slow", at_s=(400.0,), methods=thesis.PUBLISHED_METHODS)
    assert plan.settings(0).truth.hard_iron_gauss == pytest.approx([0.0376, 0.1094, 0.113])
    row = thesis.line("x", 2.0, "m", plan, np.array([1.0, 2.0, 3.0, 4.0]))
    assert (row.mean, row.runs, row.reproduced) == (2.5, 4, True)
    assert not thesis.line("x", 2.0, "m", plan, np.array([2.4, 2.5, 2.6])).reproduced
    thesis.SETS, thesis.MOTIONS = ("wam",), ("rov",)
    thesis.AT_S = 120.0
    thesis.main(["--cache", str(tmp_path), "--runs", "2", "--ours", "1", "--output", str(tmp_path)])
    body = json.loads((tmp_path / "thesis.json").read_text())
    names = {(r["figure"], r["method"]) for r in body["figures"]}
    assert ("heading RMSE, deg, 10 mG", "magical-bfg") in names
    assert ("soft iron 12", thesis.INVERTED) in names
    exact = [r for r in body["figures"] if r["figure"] == "soft iron 12"]
    assert exact[0]["mean"] == pytest.approx(-0.109, abs=0.01)  # of A^-1 with det 1
    assert "Table" not in capsys.readouterr().err
    text = (tmp_path / "tables.md").read_text()
    assert "WAM rov, 1 runs" in text
    assert "\nbound " in text
