"""Monte Carlo: deterministic, resumable, failures counted; and a short form of the goals."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ahrsd.errors import AhrsdError
from ahrsd.montecarlo.accuracy import FIGURES, HEADINGS
from ahrsd.montecarlo.runs import (
    Plan,
    is_known,
    known_methods,
    lost_record,
    one_by_one,
    run_many,
    run_one,
)
from ahrsd.montecarlo.summary import (
    BOUNDED,
    PARAMETERS,
    accuracy_lines,
    bound_lines,
    heading_lines,
    parameter_lines,
    summarise,
)

SHORT = Plan("mam", "rov", at_s=(40.0, 80.0))


def without_time(records):
    text = json.dumps(
        [
            r | {"results": [{k: v for k, v in x.items() if k != "cpu_s"} for x in r["results"]]}
            for r in records
        ]
    )
    return json.loads(text)


@pytest.mark.slow
def test_run_has_all_results_and_is_determined_by_its_seed():
    one = run_one(SHORT, 3)
    assert [(r["method"], r["at_s"]) for r in one["results"]] == [
        ("magyc", 40.0),
        ("magyc", 80.0),
        ("magyc-stream", 40.0),
        ("magyc-stream", 80.0),
    ]
    assert all(r["failure"] is None for r in one["results"])
    first, last = one["bounds"]
    assert last["hard_iron_gauss"] < first["hard_iron_gauss"]
    assert without_time([run_one(SHORT, 3)]) == without_time([one])
    assert without_time([run_one(SHORT, 4)]) != without_time([one])


def test_results_do_not_depend_on_the_order():
    plan = Plan("mam", "rov", methods=("ellipsoid", "fnp"), at_s=(40.0,))
    here = run_many(plan, range(3))
    there = run_many(plan, range(3), runner=lambda p, seeds: one_by_one(p, [*seeds][::-1]))
    assert without_time(there) == without_time(here)


def test_lost_seed_is_a_failure_of_every_method_and_is_repeated(tmp_path):
    plan = Plan("mam", "rov", methods=("ellipsoid", "fnp"), at_s=(40.0, 60.0))

    def losing(p, seeds):
        yield from one_by_one(p, [seed for seed in seeds if seed != 1])
        yield lost_record(p, 1, "stopped after 9 s")

    records = run_many(plan, range(3), runner=losing, resume=tmp_path)
    rows = summarise(records)
    assert [(row.method, row.at_s, row.runs, row.answered) for row in rows] == [
        ("ellipsoid", 40.0, 3, 2), ("ellipsoid", 60.0, 3, 2), ("fnp", 40.0, 3, 2),
        ("fnp", 60.0, 3, 2),
    ]  # fmt: skip
    assert all(row.failures == {"stopped after 9 s": 1} for row in rows)
    kept = summarise([records[0], records[2]])
    assert [row.against_bound for row in rows] == [row.against_bound for row in kept]
    assert [row.cpu_s for row in rows] == [row.cpu_s for row in kept]
    told = []
    again = run_many(plan, range(3), resume=tmp_path, done=lambda n, of: told.append((n, of)))
    assert told == [(2, 3), (3, 3)]
    assert all(result["failure"] is None for result in again[1]["results"])


@pytest.mark.slow
def test_command_with_processes_gives_the_results_of_one_process(run, tmp_path):
    """All seeds by two processes; then a limit that none can meet."""
    path, words = tmp_path / "m.json", ("--motion", "rov", "--runs", 3, "--at", "40", "--jobs", 2)
    methods = ("--method", "ellipsoid", "--method", "fnp")
    assert run("montecarlo", "mam", *words, *methods, "--json", path) == 0
    rows = json.loads(path.read_text())["sets"][0]["rows"]
    plan = Plan("mam", "rov", methods=("ellipsoid", "fnp"), at_s=(40.0,))
    here = json.loads(json.dumps([row.json() for row in summarise(run_many(plan, range(3)))]))
    assert [row | {"cpu_s": 0} for row in rows] == [row | {"cpu_s": 0} for row in here]
    lost = ("--motion", "rov", "--runs", 1, "--at", "400", "--method", "magyc", "--limit", "0.001s")
    assert run("montecarlo", "mam", *lost, "--resume", tmp_path / "runs", "--json", path) == 1
    (row,) = json.loads(path.read_text())["sets"][0]["rows"]
    assert row["failures"] == {"stopped after 0.001 s": 1}
    assert not (tmp_path / "runs").exists()


def test_finished_seeds_are_not_repeated_except_torn_lines(tmp_path):
    plan = Plan("mam", "rov", methods=("ellipsoid",), at_s=(40.0,))
    run_many(plan, range(3), resume=tmp_path)
    (path,) = tmp_path.iterdir()
    lines = path.read_text().splitlines()
    marked = json.loads(lines[0]) | {"kept": True}
    path.write_text("\n".join([json.dumps(marked), lines[1], lines[2][:50]]))
    told = []
    records = run_many(
        plan, range(4), resume=tmp_path, done=lambda done, total: told.append((done, total))
    )
    assert told == [(2, 4), (3, 4), (4, 4)]
    assert [r["seed"] for r in records] == [0, 1, 2, 3]
    assert records[0]["kept"] is True
    assert without_time(records[1:]) == without_time(run_many(plan, [1, 2, 3]))
    kept = run_many(plan, range(4), resume=tmp_path)
    assert kept == records


def test_another_plan_has_another_file(tmp_path):
    for noise in (1e-3, 2e-3):
        plan = Plan("mam", methods=("ellipsoid",), at_s=(40.0,), noise_mag_gauss=noise)
        run_many(plan, [0], resume=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_failures_are_counted_by_reason_and_give_no_number():
    # 5 s of slow LAM: no ellipsoid is to be seen
    plan = Plan("lam", "slow", methods=("ellipsoid",), at_s=(5.0,))
    (row,) = summarise(run_many(plan, range(4)))
    assert row.answered < 4
    assert sum(row.failures.values()) == 4 - row.answered
    assert all(words for words in row.failures)
    text = "\n".join(accuracy_lines([row]))
    assert f"{row.answered}/4" in text
    assert next(iter(row.failures)) in text


def test_summary_in_a_small_example():
    def record(error, bound, nees):
        errors = dict.fromkeys(FIGURES)
        result = {
            "method": "m", "at_s": 9.0, "failure": None, "cpu_s": 2.0, "converged": error < 3e-3,
            "errors": errors | {"hard_iron_gauss": error, "nees": nees},
            "soft_iron": None, "hard_iron_gauss": [error, 0.0, 0.0], "gyro_bias_rad_s": None,
        }  # fmt: skip
        bounds = {"at_s": 9.0, "sigma": None} | dict.fromkeys((*BOUNDED, *HEADINGS, "ordinary"))
        return {"seed": 0, "bounds": [bounds | {"hard_iron_gauss": bound}], "results": [result]}

    (row,) = summarise([record(3e-3, 1e-3, 0.5), record(4e-3, 2e-3, 1.5), record(0.0, 2e-3, 1.0)])
    hard = row.against_bound["hard_iron_gauss"]
    assert hard.rmse == pytest.approx(np.sqrt(25 / 3) * 1e-3)
    assert hard.bound == pytest.approx(np.sqrt(3) * 1e-3)
    assert hard.over_bound == pytest.approx(5 / 3)
    assert hard.normalised == pytest.approx(np.sqrt((9 + 4 + 0) / 3))
    assert row.against_bound["soft_iron"].over_bound is None
    assert (row.nees, row.nees_spread) == pytest.approx((1.0, 0.5))
    assert row.unconverged == 2
    assert row.mean[PARAMETERS.index("b1")] == pytest.approx(7 / 3)
    assert row.mean[PARAMETERS.index("A11")] is None


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"at_s": (100.0, 50.0)}, "must be positive and increase"),
        ({"at_s": ()}, "must be positive and increase"),
        ({"methods": ("magic",)}, "no method 'magic'; there are magyc, magyc-stream"),
        ({"methods": ("fnp+savgol",)}, "no method"),
        ({"noise_gyro_rad_s": -1.0}, "noise_gyro_rad_s is -1"),
    ],
)
def test_wrong_plans_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        Plan("mam", **wrong)


def test_every_documented_method_id_is_known():
    contract = (
        "magyc magyc-ifg magyc-bfg magical-ifg magical-bfg magical-ls magical-nls twostep "
        "ellipsoid magfactor3 tls np fnp np-uncertain-field"
    )
    assert set(contract.split()) <= set(known_methods())
    assert is_known("magical-nls+savgol")


def test_the_command_writes_tables_json_and_figure(run, tmp_path, capsys):
    arguments = ("--motion", "rov", "--runs", 2, "--at", "30,60", "--jobs", 1)
    files = ("--json", tmp_path / "m.json", "--figure", tmp_path / "m.png")
    methods = ("--method", "magyc", "--method", "ellipsoid")
    assert run("montecarlo", "wam", *arguments, *files, *methods) == 0
    out = capsys.readouterr().out
    assert "WAM rov, 2 runs" in out
    assert out.count("\nbound ") == 4  # at both times, of the parameters, of the headings
    written = json.loads((tmp_path / "m.json").read_text())
    assert written["schema"] == "ahrsd.montecarlo/1"
    assert written["seeds"] == [0, 1]
    rows = written["sets"][0]["rows"]
    assert [(r["method"], r["at_s"]) for r in rows] == [
        ("magyc", 30.0), ("magyc", 60.0), ("ellipsoid", 30.0), ("ellipsoid", 60.0),
    ]  # fmt: skip
    hard = rows[1]["against_bound"]["hard_iron_gauss"]
    assert hard["over_bound"] == pytest.approx(hard["rmse"] / hard["bound"])
    assert rows[2]["nees"] is None
    assert (tmp_path / "m.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_the_tables_have_the_bound_of_every_parameter_and_of_the_heading():
    plan = Plan("mam", "rov", methods=("magyc", "ellipsoid"), at_s=(80.0,))
    records = run_many(plan, range(3))
    rows = summarise(records)
    sigma = dict(zip(PARAMETERS, rows[0].bound_sigma, strict=True))
    hard = np.linalg.norm([sigma["b1"], sigma["b2"], sigma["b3"]])
    assert hard == pytest.approx(1e3 * rows[0].against_bound["hard_iron_gauss"].bound)
    assert sigma["A21"] == sigma["A12"]
    soft = np.linalg.norm([sigma[f"A{i}{j}"] for i in "123" for j in "123"])
    assert soft == pytest.approx(rows[0].against_bound["soft_iron"].bound)
    heading, noisy = (rows[0].against_bound[name] for name in HEADINGS)
    assert 0.3 < heading.over_bound < 3.0
    assert noisy.over_bound == pytest.approx(1.0, abs=0.05)  # the readings' noise is the most of it
    table = parameter_lines(rows, np.arange(15.0))
    assert [line.split()[0] for line in table[1:]] == ["truth", "bound", "magyc", "ellipsoid"]
    assert f"+-{sigma['b3']:.4f}" in table[2]
    text = [line.split() for line in heading_lines([("a", rows), ("b", rows[:1])])]
    assert [line[0] for line in text] == ["method", "magyc", "ellipsoid", "bound"]
    assert text[2][3:] == ["-", "(-)"]  # no ellipsoid in b
    noisy_rms = f"{rows[1].rms['heading_10mg_deg']:#.4g}"
    assert text[2][1:3] == [noisy_rms, f"({rows[1].rms['heading_deg']:#.4g})"]
    assert text[3][1] == f"{noisy.bound:#.4g}"
    plain, wider = bound_lines(rows)
    assert plain.split()[0] == "bound" and wider.startswith("bound, ordinary")
    assert f"{heading.bound:#.4g}" in plain
    assert f"{rows[0].ordinary_bound['heading_deg']:#.4g}" in wider


def test_table_has_the_bound_of_an_ordinary_instrument_and_the_plain_one(run, tmp_path, capsys):
    path, words = tmp_path / "m.json", ("--motion", "rov", "--runs", 2, "--jobs", 1)
    methods = ("--method", "ellipsoid", "--at", "60,120")
    assert run("montecarlo", "wam", *words, *methods, "--json", path) == 0
    assert capsys.readouterr().out.count("\nbound, ordinary") == 2
    first, last = json.loads(path.read_text())["sets"][0]["rows"]
    for name in BOUNDED:
        plain, wider = last["against_bound"][name]["bound"], last["ordinary_bound"][name]
        assert plain < wider < first["ordinary_bound"][name]
    assert (
        last["ordinary_bound"]["hard_iron_gauss"] > 3 * last["against_bound"][BOUNDED[0]]["bound"]
    )


@pytest.mark.slow
def test_sweeps_over_noise_and_hard_iron(run, tmp_path):
    path = tmp_path / "m.json"
    arguments = ("--motion", "rov", "--runs", 3, "--at", "60", "--jobs", 1, "--method", "ellipsoid")
    assert run(
        "montecarlo", "wam", *arguments, "--noise-mag", "1,4", "--bias-scale", "1,3", "--json", path
    ) in (0, 1)
    sets = json.loads(path.read_text())["sets"]
    assert [(s["noise_mag_gauss"], s["hard_iron_scale"]) for s in sets] == [
        (1e-3, 1.0), (1e-3, 3.0), (4e-3, 1.0), (4e-3, 3.0),
    ]  # fmt: skip
    bounds = [s["rows"][0]["against_bound"]["hard_iron_gauss"]["bound"] for s in sets]
    assert bounds[1] == pytest.approx(bounds[0])  # hard iron does not matter to the bound
    assert 1.5 < bounds[2] / bounds[0] < 4.0  # the gyro's noise stays
    assert sets[1]["truth"]["hard_iron_gauss"] == pytest.approx([0.1128, 0.3282, 0.339])


def test_missing_estimate_at_the_end_exits_with_code_one(run, capsys):
    arguments = ("--runs", 2, "--at", "5", "--jobs", 1, "--method", "ellipsoid")
    assert run("montecarlo", "lam", *arguments) == 1
    assert "0/2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--at", "a"), "numbers separated by commas"),
        (("--method", "magic"), "no method 'magic'"),
        (("--noise-mag", "nan"), "noise_mag_gauss is nan"),
    ],
)
def test_bad_use_exits_with_code_two(run, capsys, arguments, said):
    assert run("montecarlo", "wam", *arguments) == 2
    assert said in capsys.readouterr().err


def test_unusable_folder_is_refused(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    plan = Plan("mam", methods=("ellipsoid",), at_s=(40.0,))
    with pytest.raises(AhrsdError, match="cannot be"):
        run_many(plan, [0], resume=blocked)


@pytest.mark.parametrize("runs", [8, pytest.param(16, marks=pytest.mark.slow)])
def test_short_form_of_the_goals(runs):
    """A few runs: within three standard errors of the bound, with a correct covariance.

    The full form is in docs/validation/montecarlo.md; 16 runs cannot distinguish 1.0 from 1.25.
    """
    plan = Plan("mam", "rov", at_s=(80.0,))
    batch, stream = summarise(run_many(plan, range(runs)))
    for row, goal in ((batch, 1.10), (stream, 1.25)):
        assert row.answered == row.runs == runs
        for ratio in row.against_bound.values():
            assert 0.6 < ratio.over_bound < goal + 3 * ratio.standard_error
        assert abs(row.nees - 1.0) < 0.2 + 3 * row.nees_standard_error
