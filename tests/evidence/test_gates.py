"""Gates: a good calibration passes all, each bad one is stopped, and nan never passes."""

import math
from dataclasses import fields, is_dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ahrsd.calibration import Affine, Observability
from ahrsd.evidence import BasisFacts
from ahrsd.evidence.values import Evidence, numbers
from ahrsd.gates import GATES, GateLimits, Level, for_level, holds, judge, limit_of
from ahrsd.world_field import WorldField

LIMITS = GateLimits()
DOC = Path(__file__).parents[2] / "docs" / "reference" / "gates.md"
DIP = np.radians(60.0)
MODEL = WorldField(
    0.5 * np.array([np.cos(DIP), 0, np.sin(DIP)]),
    0.0,
    float(DIP),
    0.5,
    "WMM2025",
    2030.0,
    np.full(3, 1e-3),
    1e-3,
    0.003,
    True,
)
ROWS = {gate.gate: gate for gate in GATES}


@pytest.fixture(scope="session")
def good(world) -> Evidence:
    return world.evidence(world.Scene(), world=MODEL, field_known=True)


def closed(evidence: Evidence) -> dict[str, str]:
    return {r.gate: r.advice for r in judge(evidence, LIMITS, 0.0) if not r.ok}


def put(value, path, new):
    """A copy of a tree of dataclasses with one leaf replaced."""
    first, _, rest = path.partition(".")
    return replace(value, **{first: put(getattr(value, first), rest, new) if rest else new})


# -- the good one ----------------------------------------------------------------------------------


def test_good_calibration_passes_every_gate(good) -> None:
    results = judge(good, LIMITS, 12.0)
    assert closed(good) == {}
    assert all(holds(results, level) for level in Level)
    assert {r.since_s for r in results} == {12.0}
    assert {r.advice for r in results} == {""}


def test_ram_may_be_written_without_a_position_and_flash_may_not(world) -> None:
    seen = world.evidence(world.Scene())
    assert list(closed(seen)) == ["field.position"]
    results = judge(seen, LIMITS, 0.0)
    assert holds(results, Level.RAM)
    assert holds(results, Level.UNATTENDED)
    assert not holds(results, Level.FLASH)
    assert "set the location" in closed(seen)["field.position"]


def test_level_vehicle_with_unchanged_vertical_passes_for_ram(world) -> None:
    seen = world.evidence(world.Scene(roll_deg=2.0, pitch_deg=2.0))
    assert seen.motion.regime == "2D"
    assert list(closed(seen)) == ["field.position"]


def test_vehicle_in_motion_disturbances_passes(world) -> None:
    """A boat in waves: tilts of 10 degrees, its own accelerations, more noise."""
    scene = world.Scene(roll_deg=10.0, pitch_deg=6.0, forward_m_s2=0.5, noise_gauss=0.002)
    assert list(closed(world.evidence(scene, noise_mag_gauss=0.002))) == ["field.position"]


# -- bad calibrations ------------------------------------------------------------------------------


def moved(world, x=0.0, y=0.0, z=0.0):
    return Affine(world.truth().matrix, world.HARD + np.array([x, y, z]))


def test_calibration_from_a_cap_of_the_sphere_never_passes(world) -> None:
    """80 degrees of heading, 10 of tilt, and a centre that is wrong along the axis of the cap."""
    scene = world.Scene(heading_span_deg=80.0, roll_deg=10.0, pitch_deg=10.0)
    for off in (0.0, 0.05, 0.15):
        stopped = closed(world.evidence(scene, moved(world, off, 0.0, off)))
        assert "motion.heading" in stopped
        assert "heldout_heading.coverage" in stopped
        assert "deg more" in stopped["motion.heading"]


def test_calibration_with_a_wrong_vertical_never_passes(world) -> None:
    """In the plane its heading is right and the field constant, so that no other gate notices
    it.
    """
    scene = world.Scene(roll_deg=1.0, pitch_deg=1.0)
    for off in (-0.2, 0.05, 0.3):
        stopped = closed(world.evidence(scene, moved(world, z=off)))
        assert "observability.held" in stopped
        assert "pitch and roll by 30 deg" in stopped["observability.held"]


@pytest.mark.parametrize("matrix", [np.diag([1.05, 0.95, 1.0]), np.diag([1.0, 1.0, 1.25])])
def test_wrong_matrix_never_passes(world, matrix) -> None:
    wrong = Affine(matrix @ world.truth().matrix, world.HARD)
    stopped = closed(world.evidence(world.Scene(), wrong))
    assert {"second_opinion.heading", "heldout_heading.max"} <= set(stopped)


@pytest.mark.parametrize("off", [(0.02, 0, 0), (0, -0.02, 0), (0, 0, 0.03), (0.3, 0, 0)])
def test_wrong_hard_iron_never_passes(world, off) -> None:
    stopped = closed(world.evidence(world.Scene(), moved(world, *off)))
    assert "second_opinion.heading" in stopped
    assert "better.percent" in stopped


def test_calibration_at_rest_never_passes(world) -> None:
    stopped = closed(world.evidence(world.Scene(heading_span_deg=0.0, roll_deg=0.0, pitch_deg=0.0)))
    assert {"motion.regime", "motion.heading", "heldout_heading.windows"} <= set(stopped)
    assert "turn" in stopped["motion.heading"]


@pytest.mark.parametrize("middle_s", [60.0, 105.0, 200.0])
def test_calibration_with_a_passing_magnet_never_passes(world, middle_s) -> None:
    def near(t):
        return 0.2 * np.exp(-(((t - middle_s) / 6.0) ** 2))[:, None] * np.array([1.0, 0.5, 0.2])

    stopped = closed(world.evidence(world.Scene(magnet=near)))
    assert {"second_opinion.heading", "repeatable.heading"} & set(stopped)
    if middle_s == 105.0:  # in a held-out segment
        assert "a magnet or steel came near" in stopped["heldout_heading.max"]


def test_calibration_with_iron_added_during_the_turn_never_passes(world) -> None:
    def loaded(t):
        return 0.05 * (t > 200.0)[:, None] * np.array([1.0, 0.0, 0.0])

    stopped = closed(world.evidence(world.Scene(magnet=loaded)))
    assert {"repeatable.heading", "repeatable.hard_iron"} <= set(stopped)
    assert "iron changed" in stopped["repeatable.hard_iron"]


def test_wrong_gyro_bias_never_passes(world) -> None:
    off = world.BIAS + np.array([0.0, 0.0, 0.003])
    stopped = closed(world.evidence(world.Scene(), gyro_bias_rad_s=off))
    assert "gyro_bias.agreement" in stopped
    assert "stand still" in stopped["gyro_bias.agreement"]


def test_undetermined_gyro_bias_never_passes_and_is_not_called_wrong(world) -> None:
    covariance = np.diag(np.r_[np.full(9, 1e-3), 1e-4, 1e-4, 8e-3]) ** 2
    off = world.BIAS + np.array([0.0, 0.0, 0.0072])
    stopped = closed(world.evidence(world.Scene(), gyro_bias_rad_s=off, covariance=covariance))
    assert "gyro_bias.agreement" not in stopped
    assert (
        "7.2 mrad/s off what rest shows (limit 1.2), and known to +-8.0: turn"
        in (stopped["gyro_bias.apart"])
    )


def test_field_that_varies_between_places_is_never_saved(good) -> None:
    for weak_deg in (0.043, 0.067):  # rooms of .8 to 1.8 mG that a limit of 0.1 let through
        assert set(closed(put(good, "estimate.place_deg", weak_deg))) == {"field.place"}
    told = closed(put(good, "estimate.place_deg", 0.3))
    assert set(told) == {"field.place"}
    assert (
        "what the model does not explain may cause 0.30 deg of heading error (limit 0.03)"
        in (told["field.place"])
    )
    assert "gravity is needed" in closed(put(good, "estimate.place_deg", math.nan))["field.place"]


LEVEL_TOO_FEW = "the motion so far does not determine enough: turn through all headings"


@pytest.mark.parametrize("gate", ["observability.converged", "observability.heading_sigma"])
def test_advice_concerns_the_largest_uncertainty(good, gate) -> None:
    doubtful = put(put(good, "estimate.converged", False), "estimate.heading_sigma_deg", 1.4)
    told = closed(put(doubtful, "estimate.widened_by", LEVEL_TOO_FEW))[gate]
    assert told.endswith(f": {LEVEL_TOO_FEW}")
    assert "two full circles" in closed(doubtful)[gate]


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "asked"),
    [
        (3.0, 4.0, "pitch and roll by 30 deg if the vehicle can (so far roll +-3, pitch +-4 deg)"),
        (3.0, 41.0, "roll by 30 deg if the vehicle can (so far roll +-3, pitch +-41 deg)"),
        (31.0, 4.0, "pitch by 30 deg if the vehicle can (so far roll +-31, pitch +-4 deg)"),
        (
            31.0,
            41.0,
            "repeat this tilt on other headings, slowly and fast (so far roll +-31, pitch +-41 "
            "deg)",
        ),
        (math.nan, math.nan, "pitch and roll by 30 deg if the vehicle can (tilt not known yet)"),
    ],
)
def test_tilt_already_driven_is_not_advised_again(good, roll_deg, pitch_deg, asked) -> None:
    seen = put(put(good, "motion.roll_deg", roll_deg), "motion.pitch_deg", pitch_deg)
    stopped = closed(put(put(seen, "estimate.score", 0.1), "world.inclination_error_deg", 9.0))
    for gate in ("observability.score", "field.inclination"):
        assert stopped[gate].endswith(asked)
    assert ("if the vehicle can" in stopped["observability.score"]) == ("repeat" not in asked)


def test_good_calibration_in_force_is_not_replaced(world) -> None:
    stopped = closed(world.evidence(world.Scene(), present=world.truth()))
    assert {"better.percent", "better.degrees", "better.certain"} <= set(stopped)


def test_large_step_needs_a_person_and_a_larger_one_is_refused(world) -> None:
    first = world.evidence(world.Scene(), present=Affine.identity())
    results = judge(first, LIMITS, 0.0)
    assert holds(results, Level.RAM)
    assert not holds(results, Level.UNATTENDED)
    assert "a person must approve" in closed(first)["step.auto"]
    again = world.evidence(world.Scene(), present=moved(world, 0.15, 0.0, 0.0))
    assert not holds(judge(again, LIMITS, 0.0), Level.CANDIDATE)
    assert "something else is wrong" in closed(again)["step.operator"]


def test_stream_without_gravity_never_passes(world) -> None:
    stopped = closed(world.evidence(world.Scene(accel=False)))
    assert "add acceleration" in stopped["motion.regime"]
    assert "add acceleration" in stopped["motion.heading"]


@pytest.mark.parametrize(
    ("field", "value", "gate", "words"),
    [
        ("registers_read", False, "input_basis.registers_read", "registers are not known"),
        ("changed", True, "input_basis.changed", "was changed during this run"),
        ("hsi_applied", True, "input_basis.hsi_applied", "set register 44 to 0,1,5"),
        ("compensated_only", True, "input_basis.compensated_only", "use VNIMU"),
        ("firmware_known", False, "input_basis.firmware_known", "firmware is unknown"),
        ("stepped", True, "stationarity.step", "the iron changed on the vehicle"),
    ],
)
def test_unsound_data_never_pass(good, field, value, gate, words) -> None:
    unsound: BasisFacts = replace(good.basis, **{field: value})
    stopped = closed(replace(good, basis=unsound))
    assert list(stopped) == [gate]
    assert words in stopped[gate]
    assert not holds(judge(replace(good, basis=unsound), LIMITS, 0.0), Level.CANDIDATE)


def test_uncertain_estimate_never_passes(world) -> None:
    doubt = {
        "converged": False,
        "heading_sigma_deg": 1.4,
        "observability": Observability(np.ones(12), ("hard iron z",), 0.3),
    }
    stopped = closed(world.evidence(world.Scene(), **doubt))
    assert {"observability.converged", "observability.score", "observability.heading_sigma"} <= set(
        stopped
    )
    assert "not known well enough (limit 1.0 deg)" in stopped["observability.heading_sigma"]


def test_every_gate_reports_what_is_missing_before_data(world) -> None:
    empty = world.EvidenceCollector().evaluate(
        world.estimate(), world.old(), np.zeros(3), None, world.HEALTHY, world.SOUND
    )
    stopped = closed(empty)
    assert len(stopped) > 20
    assert all(words and "nan" not in words for words in stopped.values())


# -- each row by itself ----------------------------------------------------------------------------

_LEAVES = {
    "proof_coverage_deg": ("proof.sectors", np.zeros(36, dtype=bool)),
    "motion_known": ("motion.regime", "none"),
    "position_known": ("world", None),
    "spread_percent": ("field.spread", 0.5),
    "model_error_percent": ("world.magnitude_error", 0.5),
    "gain_percent": ("proof.rms_before_deg", 0.0),
    "gain_deg": ("proof.rms_before_deg", 0.0),
    "scale_change_percent": ("change.scale_change", 0.5),
    "gyro_bias_deg_s": ("gyro.bias_rad_s", 1.0),
    "unmeasured_count": ("motion.roll_deg", math.nan),
}


@pytest.mark.parametrize("gate", GATES, ids=lambda gate: gate.gate)
def test_every_gate_can_close_with_a_reason(good, gate) -> None:
    limit = limit_of(gate, LIMITS)
    worse = limit + abs(limit) + 1.0 if gate.at_most else limit - abs(limit) - 1.0
    path, value = _LEAVES.get(gate.value, (gate.value, worse))
    if isinstance(attrgetter(path)(good), bool):
        value = gate.at_most
    bad = put(good, path, value)
    if gate.applies == "planar":
        bad = put(bad, "motion.regime", "2D")
    words = closed(bad)[gate.gate]
    assert len(words) > 15
    assert "{" not in words
    assert not holds(judge(bad, LIMITS, 0.0), gate.level)


def leaves(value, path=""):
    if is_dataclass(value):
        for f in fields(value):
            yield from leaves(getattr(value, f.name), f"{path}.{f.name}".lstrip("."))
    elif isinstance(value, float):
        yield path


@given(data=st.data(), bad=st.sampled_from([math.nan, math.inf, -math.inf]))
def test_non_finite_number_never_passes(good, data, bad) -> None:
    paths = data.draw(st.sets(st.sampled_from(sorted(leaves(good))), min_size=1))
    evidence = good
    for path in paths:
        evidence = put(evidence, path, bad)
    assert not all(r.ok for r in judge(evidence, LIMITS, 0.0))
    assert not holds(judge(evidence, LIMITS, 0.0), Level.RAM)
    assert set(paths) == {path for path, v in numbers(evidence) if not math.isfinite(v)}


# -- the judge -------------------------------------------------------------------------------------


def test_since_is_the_time_of_the_last_change(good) -> None:
    bad = put(good, "field.spread", 0.5)
    first = judge(good, LIMITS, 10.0)
    second = judge(bad, LIMITS, 20.0, first)
    third = judge(bad, LIMITS, 30.0, second)
    last = judge(good, LIMITS, 40.0, third)
    since = [
        [next(r.since_s for r in results if r.gate == name) for results in (first, second, third)]
        for name in ("field.spread_ram", "field.weakest")
    ]
    assert since == [[10.0, 20.0, 20.0], [10.0, 10.0, 10.0]]
    assert {r.gate: r.since_s for r in last}["field.spread_ram"] == 40.0


def test_levels_include_lower_levels_and_missing_gates_are_closed(good) -> None:
    results = judge(good, LIMITS, 0.0)
    sizes = [len(for_level(results, level)) for level in (Level.CANDIDATE, Level.RAM, Level.FLASH)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[2] < len(results)
    unattended = {r.gate for r in for_level(results, Level.UNATTENDED)}
    assert {"step.auto", "bounds.offset_auto", "field.spread_ram"} <= unattended
    assert "field.spread_flash" not in unattended
    assert not holds(results[1:], Level.CANDIDATE)
    assert not holds((), Level.CANDIDATE)


def test_limits_are_defined_in_one_place(good) -> None:
    strict = replace(LIMITS, holdout_rms_deg=1e-3)
    assert [r.gate for r in judge(good, strict, 0.0) if not r.ok] == ["heldout_heading.rms"]
    names = {f.name for f in fields(GateLimits)}
    used = {gate.limit for gate in GATES if isinstance(gate.limit, str)}
    assert names == used
    assert len(ROWS) == len(GATES)


def test_limits_tolerate_only_rounding(good) -> None:
    def ok(rate_hz: float) -> bool:
        return "stream_health.rate" not in closed(put(good, "health.rate_hz", rate_hz))

    assert ok(9.99999999)
    assert not ok(9.999)


def test_margin_after_a_rollback_raises_the_required_improvement() -> None:
    twice = LIMITS.with_margin(2.0)
    assert (twice.min_improvement_percent, twice.min_improvement_deg) == (40.0, 0.6)
    assert twice.holdout_rms_deg == LIMITS.holdout_rms_deg


# -- the documentation -----------------------------------------------------------------------------


def doc_rows() -> dict[str, list[str]]:
    rows = [
        line.strip("| \n").split(" | ") for line in DOC.read_text().splitlines() if "| `" in line
    ]
    return {row[0].strip("`"): row for row in rows if len(row) == 6}


def limit_text(gate) -> str:
    sign = "<=" if gate.at_most else ">="
    if gate.limit in {0.0, 1.0}:
        return (
            "no"
            if gate.limit == 0.0 and not gate.unit and "basis" in gate.gate
            else ("yes" if gate.limit == 1.0 else "0")
        )
    return f"{sign} {limit_of(gate, LIMITS):.4g} {gate.unit}".strip()


@pytest.mark.parametrize("gate", GATES, ids=lambda gate: gate.gate)
def test_documentation_has_every_gate(gate) -> None:
    name, code, limit, guards, meaning, todo = doc_rows()[gate.gate]
    assert name == f"`{gate.gate}`"
    assert (code, limit, guards) == (gate.code, limit_text(gate), gate.level.name.lower())
    assert meaning == gate.meaning
    assert len(todo) > 10


def test_documentation_has_no_further_gate_and_names_every_limit() -> None:
    assert list(doc_rows()) == [gate.gate for gate in GATES]
    text = DOC.read_text()
    assert [f.name for f in fields(GateLimits) if f"`{f.name}`" not in text] == []
