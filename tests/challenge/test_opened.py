"""Cases of opened rings that were wrong once, made again by their seeds and answered.

No proof, since they were looked at; they hold what was mended.
"""

from __future__ import annotations

import pytest
from blindworld.__main__ import case_ids, make_one
from blindworld.rings import orders

from ahrsd.diagnosing import diagnose_recording

#: ring -> cases, seed
RINGS = {
    "ring120b": (120, 3171823325885559521),
    "ring300b": (300, 7839750651448068454),
}


def answered(ring, case, folder):
    """The diagnosis of a case, and its truth."""
    cases, seed = RINGS[ring]
    number = case_ids(cases, seed).index(case)
    order = orders("full", cases, seed)[number]
    truth = make_one("full", order, [seed, number], folder / case, None)
    made = folder / case
    return diagnose_recording(made / "case.csv.gz", spec=made / "spec.json"), truth


@pytest.mark.parametrize(
    ("case", "frame"),
    [
        ("66152208", "world"),  # a gradient without a position was a step at the first row
        ("d1e56b7a", "sensor"),  # iron with two states had an object passed by beside it
    ],
)
def test_what_nobody_logged_is_an_unknown_without_a_name(case, frame, tmp_path):
    found, truth = answered("ring120b", case, tmp_path)
    assert truth["kind"] in ("withheld", "outside")
    assert found.findings == ()
    assert found.unexplained.detected
    assert found.unexplained.where.frame == frame


def test_coarse_steps_are_named_and_nothing_rings_beside_them(tmp_path):
    found, truth = answered("ring300b", "196ca98c", tmp_path)
    (named,) = found.findings
    assert [named.effect] == truth["effects"][0]["right"]
    step = truth["effects"][0]["parameters"][0]["value"]
    assert named.parameters[0].value == pytest.approx(step, rel=1e-3)
    assert not found.unexplained.detected
