"""Short form of bench_seeds.py: the seeds' figures that come out, and its page."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import bench_seeds
from seed_figures import chapter5, dive, norms, page, printed, summary

from ahrsd.simulation import simulate

VALIDATION = Path(__file__).parents[3] / "docs" / "validation"


@pytest.fixture(scope="module")
def wam():
    experiment = simulate(chapter5.settings("wam", "slow", 0))
    judge = chapter5.Judge(chapter5.JUDGE.experiment(chapter5.JUDGE_SEED))

    def scored(method):
        known = chapter5.AS_PRINTED | chapter5.OTHERWISE | {"ours": chapter5.OURS}
        return chapter5.scored(known[method], experiment, judge)

    return scored, judge


def test_the_ellipsoid_row_is_a_root_with_transposed_eigenvectors():
    """[R] Table 5.1, WAM, all six entries; the judge's heading is about [R]'s 18 deg then."""
    truth = chapter5.SENSOR.truth(1e-3, 5e-3)
    found = chapter5.transposed_root(truth.soft_iron)[np.triu_indices(3)]
    words = printed.numbers(printed.TABLE_5_1["wam"]["Ellipsoid fit"])["a"]
    assert found == pytest.approx([float(word) for word in words], abs=5e-4)
    judge = chapter5.Judge(chapter5.JUDGE.experiment(chapter5.JUDGE_SEED))
    figures = judge.figures(chapter5.transposed_root(truth.soft_iron), truth.hard_iron_gauss)
    assert figures["heading_deg"] == pytest.approx(18.0, abs=4.0)
    assert judge.exact["heading_deg"] == pytest.approx(2.57, abs=0.1)
    assert judge.exact["field_std_mg"] == pytest.approx(9.5, abs=0.6)


def test_5_percent_of_the_field_do_not_show_in_twostep(wam):
    scored, judge = wam
    wrong, exact = scored("TWOSTEP"), scored("TWOSTEP, field exact")
    assert wrong["a"] == pytest.approx(exact["a"], abs=2e-5)
    assert wrong["m_b"] == pytest.approx([20.0, 120.0, 90.0], abs=0.15)
    assert wrong["ln_norm"] == pytest.approx(np.log(np.sqrt(3)), abs=1e-3)
    assert scored("ours")["heading_deg"] == pytest.approx(judge.exact["heading_deg"], abs=0.01)


def test_the_incremental_graph_finds_half_of_the_gyro_bias(wam):
    scored, _ = wam
    assert scored("IFG")["w_b"] == pytest.approx([1.775, -2.136, 0.852], abs=1.0)


def test_magfactor3_pays_for_the_uncalibrated_heading(wam):
    scored, _ = wam
    printed_y = 64.467
    assert scored("MagFactor3")["m_b"][1] == pytest.approx(printed_y, abs=20.0)
    assert scored("MagFactor3, all angles x 1.05")["m_b"][1] > 110.0


def test_a_refusal_is_a_failure_in_words(wam):
    flat = chapter5.FIGURE_4["mam"].experiment(0)
    found = chapter5.scored(chapter5.OF_FIGURE_4["Ellipsoid fit"], flat)
    assert found["failure"].startswith("the sensor turned about one axis only")


def test_the_dive_reckons_10_percent_raw_and_ours_is_at_the_floor():
    scale = dive.hard_iron_scale()
    assert dive.raw_error_deg(scale) == pytest.approx(6.33, abs=1e-6)
    assert np.linalg.norm(dive.field_n_gauss()) == pytest.approx(0.479)
    made = dive.Dive(0, scale, 200.0)
    way = np.trapezoid(dive.Survey.at(25.0).speed_m_s, dx=1 / 25.0)
    assert way == pytest.approx(1395.0, rel=1e-3)
    known = made.without_method
    assert known["raw"]["heading_deg"] == pytest.approx(6.33, abs=0.05)
    assert known["raw"]["worst_ins_percent"] == pytest.approx(10.4, abs=0.3)
    assert known["INS heading"]["worst_true_percent"] < 0.15
    ours = dive.scored(dive.METHODS["ours"], made.exp1, made)
    assert ours["worst_true_percent"] < 0.15
    assert ours["m_b"] == pytest.approx((scale * dive.HARD_IRON_MG).tolist(), abs=1.0)
    graph = dive.scored(dive.METHODS["BFG"], made.exp1, made)
    assert ours["worst_ins_percent"] < graph["worst_ins_percent"] < 3.0


def test_l_constraints_variance_and_bias():
    found = norms.mean_errors(20, 2)
    assert found["tls"]["constraint"] == pytest.approx(0.026, abs=0.003)
    assert found["fnp"]["constraint"] < 1e-12
    assert found["np"]["mean"] == pytest.approx(found["fnp"]["mean"], abs=1e-5)
    stage = norms.Stage(norms.EVEN)
    noisy = norms.pair(stage, 150, 50.0)
    assert np.var(noisy["fnp"], axis=0).sum() < 0.97 * np.var(noisy["tls"], axis=0).sum()
    small, large = (norms.pair(stage, 3, 5.0, np.full(3, bias)) for bias in (5.0, 314.0))
    for name in norms.COSTS:
        assert large[name] == pytest.approx(small[name], abs=1e-5)
        assert norms.other_minima(stage, name, np.full(3, 314.0))["elsewhere"] == 0
    given = norms.varying_field(2)
    assert given["fnp, measured"]["mean"] == pytest.approx(
        given["np-uncertain-field, measured"]["mean"], abs=1e-4
    )
    assert given["np-uncertain-field, constant"]["mean_square"][2] > 100.0


def test_verdicts():
    assert printed.verdict("1.045", 1.0453, 0.0, 10) == "same"  # half of the last digit
    assert printed.verdict("4.0", 4.9, 1.0, 100) == "near"
    assert printed.verdict("4.0", 4.4, 1.0, 100) == "same"  # 3 sqrt(2 / 100)
    assert printed.verdict("4.0", 5.2, 1.0, 100) == "other"
    assert printed.marked("4.00", {"mean": [1, 4.004], "std": [0, 0], "of": 3}, 1) == (
        "**4.00** ± 0.00",
        "same",
    )


def test_failures_are_counted_and_runs_are_kept(tmp_path):
    answers = [{"failure": None, "x": 1.0}, {"failure": "flat"}, {"failure": None, "x": 3.0}]
    said = summary.one(answers)
    assert (said["runs"], said["answers"], said["failures"]) == (3, 2, {"flat": 1})
    assert said["x"] == {"mean": 2.0, "std": pytest.approx(np.sqrt(2), rel=1e-5), "of": 2}
    asked = []

    def square(number):
        asked.append(number)
        return {"square": number * number}

    each = bench_seeds.Runs(1, tmp_path).each
    assert each("squares", square, [(2,), (3,)]) == [{"square": 4}, {"square": 9}]
    kept = tmp_path / "square.jsonl"
    kept.write_text(kept.read_text()[:-4])  # cut by a kill
    assert each("squares", square, [(2,), (3,), (4,)])[2] == {"square": 16}
    assert asked == [2, 3, 3, 4]


def test_the_page_is_what_the_figures_say():
    figures = json.loads((VALIDATION / "seeds" / "figures.json").read_text(encoding="utf-8"))
    assert page.page(figures) == (VALIDATION / "seeds.md").read_text(encoding="utf-8")
    assert figures["dive"]["exp1"]["ours"]["worst_true_percent"]["mean"] <= 0.3
