"""The forward model: consistent truth, noise as requested, equal readings for equal seeds."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from effect_motion import HARD_IRON, SOFT_IRON, moving

from ahrsd import so3
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.innovation_filter.innovation import run_filter
from ahrsd.diagnosis.model import Noise, Term
from ahrsd.diagnosis.repaired_model import forward
from ahrsd.diagnosis.repaired_model.model_file import RepairedModel, from_text, to_text


def terms(readings, *names):
    found = []
    for name in names:
        value, setting = EFFECTS[name].example(readings, 1.0)
        found.append(Term(name, value, 0.1 * np.abs(value), setting))
    return tuple(found)


def test_noise_free_field_turns_exactly_by_its_rates():
    context, readings = moving(1, rows=900, gap_at=400)
    rng = np.random.default_rng(0)
    drift = so3.exp(2e-3 * (readings.time_s - readings.time_s[0])[:, None] * np.ones(3))
    shaken = replace(
        context,
        field_b=context.field_b + 2e-3 * rng.standard_normal((900, 3)),
        R_nb=drift @ context.R_nb,
    )
    truth = forward.noise_free_readings(shaken)
    within = np.isfinite(truth.dt_s)
    turn = so3.exp(-truth.rate_b_rad_s[within] * truth.dt_s[within][:, None])
    before = truth.field_b[np.flatnonzero(within) - 1]
    assert np.einsum("nij,nj->ni", turn, before) == pytest.approx(truth.field_b[within], abs=1e-12)
    size = np.linalg.norm(truth.field_b, axis=1)
    assert size == pytest.approx(np.full(900, size[0]))
    # the attitude drifts by 0.17 rad in total; the field fixes it but for the turn about itself
    assert np.abs(truth.field_b - readings.field_b).max() < 0.02
    assert truth.R_nb @ np.swapaxes(truth.R_nb, 1, 2) == pytest.approx(
        np.tile(np.eye(3), (900, 1, 1))
    )
    angle = so3.log(np.swapaxes(truth.R_nb, 1, 2) @ readings.R_nb)
    assert np.linalg.norm(angle, axis=1).max() < 0.2


def test_perfect_context_is_returned_unchanged():
    context, readings = moving(2)
    truth = forward.noise_free_readings(context)
    assert truth.field_b == pytest.approx(readings.field_b, abs=1e-10)
    assert truth.rate_b_rad_s[1:] == pytest.approx(readings.rate_b_rad_s[1:], abs=1e-9)
    assert truth.R_nb == pytest.approx(readings.R_nb, abs=1e-9)


def test_simulated_noise_has_the_level_that_the_filter_expects():
    context, _ = moving(3, rows=4000)
    truth = forward.noise_free_readings(context)
    noise = forward.model_noise(context.model)
    made = forward.simulate_readings(truth, noise=noise, seed=7)
    track = forward.track_from_readings(made, context.track)
    filtered = run_filter(track, context.model)
    assert filtered.normalised_innovation == pytest.approx(1.0, abs=0.04)
    assert forward.model_noise(context.model, filtered) == noise
    again = forward.simulate_readings(truth, noise=noise, seed=7)
    assert np.array_equal(again.mag_b_gauss, made.mag_b_gauss)
    other = forward.simulate_readings(truth, noise=noise, seed=8)
    assert not np.array_equal(other.mag_b_gauss, made.mag_b_gauss)


def test_simulated_coloured_noise_is_recovered_by_the_filter():
    context, _ = moving(4, rows=6000)
    model = context.model
    noise = Noise(model.sigma_mag_gauss, model.sigma_gyro_rad_s, 0.0, (0.5, 0.2))
    made = forward.simulate_readings(forward.noise_free_readings(context), noise=noise, seed=1)
    left = made.mag_b_gauss - context.field_b @ SOFT_IRON.T - HARD_IRON
    assert left.std() == pytest.approx(noise.mag_gauss, rel=0.05)
    found = forward.model_noise(model, run_filter(forward.track_from_readings(made), model)).colour
    assert len(found) >= 2
    assert np.sum(found) == pytest.approx(0.7, abs=0.1)


@pytest.mark.parametrize(
    ("values", "message"),
    [((-1e-3, 1e-3), "negative"), ((1e-3, 1e-3, 0.0, (1.0,)), "not stable")],
)
def test_invalid_noise_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Noise(*values)


def test_terms_are_added_before_the_noise_and_clipping_after_it():
    context, _ = moving(5)
    truth = forward.noise_free_readings(context)
    noise = Noise(1e-3, 1e-3)
    wanted = terms(truth, "mag_saturation", "motor_current_field")
    made = forward.simulate_readings(truth, wanted, noise, seed=2)
    assert np.abs(made.mag_b_gauss).max() == 0.4
    free = forward.simulate_readings(truth, wanted[1:], noise, seed=2)
    plain = forward.simulate_readings(truth, (), noise, seed=2)
    inside = np.abs(free.mag_b_gauss) < 0.4
    assert made.mag_b_gauss[inside] == pytest.approx(free.mag_b_gauss[inside])
    current = truth.covariates["motor_current_a"][:, None]
    assert free.mag_b_gauss - plain.mag_b_gauss == pytest.approx(current * wanted[1].value)


def test_model_file_round_trip():
    context, readings = moving(6)
    named = terms(readings, *(name for name, e in EFFECTS.items() if e.kind == "mean"))
    noise = Noise(1e-3, 5e-4, 1e-6, (0.3, -0.1), 3.5)
    model = RepairedModel(context.model, noise, named, "x.csv")
    back = from_text(to_text(model))
    assert back.recording == "x.csv"
    assert back.noise == model.noise
    assert np.array_equal(back.calibration.soft_iron, context.model.soft_iron)
    assert back.calibration.sigma_gyro_rad_s == 5e-4
    for old, new in zip(named, back.terms, strict=True):
        assert (old.identifier, old.setting) == (new.identifier, new.setting)
        assert np.array_equal(old.value, new.value)
        assert np.array_equal(old.deviation, new.deviation)
    truth = forward.noise_free_readings(context)
    first, second = (forward.simulate_readings(truth, m.terms, m.noise, 3) for m in (model, back))
    assert np.array_equal(first.mag_b_gauss, second.mag_b_gauss)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda body: body.update(schema="ahrsd.calibration/1"), "schema must be 'ahrsd.model/1'"),
        (lambda body: body.pop("noise"), "noise is missing"),
        (lambda body: body["noise"].update(mag_gauss="loud"), "noise.mag_gauss: 'loud' is no"),
        (lambda body: body["noise"].update(mag_gauss=-1), "noise: a deviation is negative"),
        (lambda body: body["noise"].update(colour=[2.0]), "autoregression is not stable"),
        (lambda body: body["noise"].update(colour=["red"]), "noise.colour.0: 'red' is no finite"),
        (lambda body: body["noise"].pop("colour"), "noise.colour must be a list"),
        (lambda body: body["noise"].update(freedom=1.0), "noise.freedom: more than 2"),
        (lambda body: body["calibration"].update(soft_iron=[[1, 2], [3]]), "calibration.soft_iron"),
        (lambda body: body["terms"][0].update(effect="magic"), "terms[0]: no effect 'magic'"),
        (lambda body: body["terms"][0].update(parameters=[]), "terms[0]: the parameters of"),
        (
            lambda body: body["terms"][0]["parameters"][0].pop("value"),
            "terms[0].field_per_ampere_x",
        ),
        (lambda body: body.update(terms=None), "terms must be a list"),
    ],
)
def test_bad_model_file_is_refused_in_one_line(change, message):
    context, readings = moving(6)
    named = terms(readings, "motor_current_field")
    body = json.loads(to_text(RepairedModel(context.model, Noise(1e-3, 5e-4), named)))
    change(body)
    with pytest.raises(ValueError) as caught:
        from_text(json.dumps(body))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_text_that_is_not_json_is_refused():
    with pytest.raises(ValueError, match="is no JSON"):
        from_text("{")
