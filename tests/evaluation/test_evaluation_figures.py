"""Heading, field and dead reckoning of a vehicle with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vehicle import DECLINATION_DEG, FIELD_N, HARD_IRON, SOFT_IRON

from ahrsd.evaluation import EvaluationError, judge
from ahrsd.evaluation.heading import (
    HeadingFigures,
    column_reference,
    course_reference,
    device_heading,
    fixes_from_degrees,
    fixes_of_track,
    heading_figures,
    optical_reference,
    rms_difference,
)
from ahrsd.evaluation.judging import evaluation_json, evaluation_lines, field_figures
from ahrsd.evaluation.track import up_directions
from ahrsd.heading import wrapped
from ahrsd.world_field import world_field


def with_columns(vehicle, **columns):
    covariates = {**vehicle.track.covariates, **columns}
    return replace(vehicle.track, covariates=covariates)


def with_optics(vehicle, world=None):
    """The true attitude from an optical system with its own world frame."""
    world = Rotation.identity() if world is None else world
    q = (world * Rotation.from_matrix(vehicle.R_nb)).as_quat()
    names = ("ref_qx", "ref_qy", "ref_qz", "ref_qw")
    return with_columns(vehicle, **dict(zip(names, q.T, strict=True)))


def test_offset_of_true_heading_to_gps_course_is_slip_and_declination(vehicle, perfect):
    found = judge(
        "r", vehicle.track, perfect, [course_reference(vehicle.fixes, 4.0)], fixes=vehicle.fixes
    )
    (judged,) = found.headings
    after = judged.figures.after
    assert judged.truth
    assert len(after.error_deg) == 198
    assert after.rms_deg < 0.05
    assert after.worst_deg < 0.2
    # magnetic heading minus course: 5 deg of slip to the left, and the declination
    assert after.offset_deg == pytest.approx(-5.0 - DECLINATION_DEG, abs=0.02)
    assert max(after.fold_rms_deg) < 0.1
    assert len(after.fold_rms_deg) == 5
    assert judged.figures.before.rms_deg > 5.0
    assert judged.figures.before.fold_spread_deg > 0.1
    assert found.better


def test_fixes_at_0_0_are_none():
    """As receivers write them that have no fix."""
    time_s = np.arange(40.0)
    lat = np.where(time_s < 5.0, 0.0, 50.0 + 1e-4 * time_s)
    lon = np.where(time_s < 5.0, 0.0, 8.0)
    found = fixes_from_degrees(time_s, lat, lon, "g")
    assert len(found.time_s) == 35
    assert found.north_m[-1] == pytest.approx(np.radians(34e-4) * 6.371e6, abs=0.01)
    with pytest.raises(EvaluationError, match="g: 0 fixes with time and position"):
        fixes_from_degrees(time_s, 0.0 * lat, 0.0 * lon, "g")


def test_hard_iron_error_on_a_level_turn_has_the_textbook_form(vehicle):
    """A hard iron b ahead changes the heading by atan(b sin / (H + b cos))."""
    heading = np.linspace(-np.pi, np.pi, 721)[:-1]
    field = np.column_stack(
        [0.2 * np.cos(heading) + 0.02, -0.2 * np.sin(heading), 0.4 + 0 * heading]
    )
    up = np.tile([0.0, 0.0, -1.0], (720, 1))
    time_s = np.arange(720.0)
    reference = course_reference(vehicle.fixes, 4.0)
    reference = replace(reference, time_s=time_s, heading_rad=heading, half_width_s=0.0)
    expected = np.arctan2(-0.02 * np.sin(heading), 0.2 + 0.02 * np.cos(heading))
    found = heading_figures(time_s, field, up, reference)
    assert found.rms_deg == pytest.approx(np.degrees(np.sqrt(np.mean(expected**2))), rel=1e-6)
    assert found.worst_deg == pytest.approx(np.degrees(np.arcsin(0.1)), rel=1e-3)
    assert found.offset_deg == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "world",
    [Rotation.from_euler("z", 77, degrees=True), Rotation.from_euler("x", 180, degrees=True)],
)
def test_optical_frame_may_have_any_yaw_and_z_up(vehicle, perfect, world):
    track = with_optics(vehicle, world)
    reference = optical_reference(track)
    found = judge("r", track, perfect, [reference])
    assert found.headings[0].tilt == "reference"
    assert found.headings[0].figures.after.worst_deg < 1e-6
    assert found.headings[0].figures.before.rms_deg > 5.0


@pytest.mark.parametrize(
    ("convention", "words"),
    [
        (lambda q: q * [-1.0, -1.0, -1.0, 1.0], "turns the other way than the gyro says"),
        (lambda q: q[:, [1, 2, 3, 0]], "turn"),  # the scalar in another place
        (
            lambda q: (
                Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
                * Rotation.from_quat(q)
                * Rotation.from_euler("x", 180, degrees=True)
            ).as_quat(),
            "turns the other way than the gyro says",
        ),  # of axes x forward, y left, z up
    ],
)
def test_an_attitude_of_another_convention_is_left_out(vehicle, perfect, convention, words):
    q = convention(Rotation.from_matrix(vehicle.R_nb).as_quat())
    names = ("ref_qx", "ref_qy", "ref_qz", "ref_qw")
    track = with_columns(vehicle, **dict(zip(names, q.T, strict=True)))
    found = judge("r", track, perfect, [optical_reference(track)])
    assert found.headings == ()
    assert found.better  # by the field, not by a reference that means something else
    (told,) = [text for text in found.warnings if text.startswith("optical attitude ")]
    assert words in told
    assert told.endswith("it is left out")


@pytest.mark.parametrize(
    ("column", "factor", "words"),
    [
        ("h_deg", -57.29577951308232, "turns the other way than the gyro says: a heading is posi"),
        ("h_deg", 1.0, "it is in another unit"),
        ("h_deg", 57.29577951308232, None),
        ("h_rad", 1.0, None),
    ],
)
def test_a_heading_of_another_convention_is_left_out(vehicle, perfect, column, factor, words):
    track = with_columns(vehicle, **{column: factor * np.unwrap(vehicle.heading_rad)})
    found = judge("r", track, perfect, [column_reference(track, column)])
    assert len(found.headings) == (words is None)
    told = [text for text in found.warnings if "left out" in text]
    assert len(told) == (words is not None)
    assert all(words in text for text in told)


def test_optical_attitude_works_when_the_x_axis_is_vertical(vehicle, perfect):
    """The error is that of the field's direction about the vertical, independent of the x axis."""
    noses_up = Rotation.from_matrix(vehicle.R_nb) * Rotation.from_euler("y", 89.9, degrees=True)
    turned = Rotation.from_euler("y", 89.9, degrees=True).inv().as_matrix()
    track = with_optics(replace(vehicle, R_nb=noses_up.as_matrix()))
    field_b = np.einsum("kji,j->ki", noses_up.as_matrix(), FIELD_N)
    raw = field_b @ SOFT_IRON.T + HARD_IRON
    track = replace(
        track, raw_b_gauss=raw, before_b_gauss=raw, accel_b_m_s2=track.accel_b_m_s2 @ turned.T
    )
    found = judge("r", track, perfect, [optical_reference(track)])
    assert found.headings[0].figures.after.worst_deg < 1e-3


def test_rows_without_optical_attitude_are_left_out(vehicle, perfect):
    track = with_optics(vehicle)
    for name in ("ref_qw", "ref_qx", "ref_qy", "ref_qz"):
        track.covariates[name][:4000] = np.nan
    found = judge("r", track, perfect, [optical_reference(track)])
    assert len(found.headings[0].figures.after.error_deg) == 6000
    assert found.headings[0].figures.after.worst_deg < 1e-6
    for name in ("ref_qw", "ref_qx", "ref_qy", "ref_qz"):
        track.covariates[name][:] = np.nan
    assert optical_reference(track) is None
    assert optical_reference(vehicle.track) is None


def test_device_yaw_is_reported_not_to_be_the_truth(vehicle, perfect):
    yaw = np.degrees(wrapped(vehicle.heading_rad))
    track = with_columns(vehicle, vn_yaw_deg=yaw, vn_pitch_deg=0 * yaw, vn_roll_deg=0 * yaw)
    reference = device_heading(track)
    assert not reference.truth
    found = judge("r", track, perfect, [reference])
    assert any("no truth" in text for text in found.warnings)
    assert found.headings[0].figures.after.offset_deg == pytest.approx(-DECLINATION_DEG, abs=0.02)
    assert column_reference(track, "vn_yaw_deg").truth is False
    track.covariates["compass_deg"] = yaw
    assert column_reference(track, "compass_deg").truth is True
    with pytest.raises(EvaluationError, match="no column nose_deg; further columns: compass_deg"):
        column_reference(track, "nose_deg")
    with pytest.raises(EvaluationError, match="must end in _deg or _rad"):
        column_reference(track, "velocity_x_m_s")
    assert device_heading(vehicle.track) is None


def test_device_tilt_is_used_and_reported_without_an_accelerometer(vehicle, perfect):
    yaw, pitch, roll = np.degrees(Rotation.from_matrix(vehicle.R_nb).as_euler("ZYX").T)
    track = with_columns(vehicle, vn_yaw_deg=yaw, vn_pitch_deg=pitch, vn_roll_deg=roll)
    blind = replace(track, accel_b_m_s2=np.full((len(track), 3), np.nan))
    found = judge("r", blind, perfect, [course_reference(vehicle.fixes, 4.0)])
    assert found.headings[0].tilt == "device"
    assert found.headings[0].figures.after.rms_deg < 0.05
    assert any("roll and pitch are the device's own" in text for text in found.warnings)
    with pytest.raises(EvaluationError, match="--tilt gravity: not every sample"):
        judge("r", blind, perfect, [], tilt_source="gravity")
    lost = replace(vehicle.track, accel_b_m_s2=np.full((len(track), 3), np.nan))
    nothing = judge("r", lost, perfect, [course_reference(vehicle.fixes, 4.0)])
    assert nothing.headings == ()
    assert any("nothing says which way is up" in text for text in nothing.warnings)


def test_estimated_gravity_is_better_than_the_accelerometer(vehicle):
    """An oscillation of 2 m/s^2 at 0.2 Hz, and a gyro bias of 1 mrad/s."""
    t = vehicle.track.time_s
    true = vehicle.track.accel_b_m_s2
    shaken = true + 2.0 * np.sin(2 * np.pi * 0.2 * t)[:, None] * np.array([0.0, 1.0, 0.0])
    track = replace(
        vehicle.track, accel_b_m_s2=shaken, gyro_b_rad_s=vehicle.track.gyro_b_rad_s + 1e-3
    )

    def worst_deg(kind):
        up, _ = up_directions(track, kind)
        cosine = np.sum(up * true, axis=1) / (
            np.linalg.norm(up, axis=1) * np.linalg.norm(true, axis=1)
        )
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))[1000:-1000].max()

    assert worst_deg("accelerometer") > 11.0
    assert worst_deg("gravity") < 1.0
    assert up_directions(track, "auto")[1] == "gravity"


def test_dead_reckoning_with_a_doppler_log_follows_the_slip(vehicle, perfect):
    found = judge(
        "r", vehicle.track, perfect, [course_reference(vehicle.fixes, 4.0)], fixes=vehicle.fixes
    )
    reckoned = found.reckoned
    assert reckoned.velocity.startswith("Doppler")
    t = np.linspace(0.0, 199.0, 10_000)
    assert reckoned.distance_m == pytest.approx(np.trapezoid(6 + np.sin(0.05 * t), t), rel=1e-3)
    assert reckoned.figures.after.rms_percent < 0.01
    assert reckoned.figures.after.final_percent < 0.01
    assert reckoned.figures.after.offset_deg == pytest.approx(-DECLINATION_DEG, abs=0.02)
    assert reckoned.figures.before.rms_percent > 1.0
    assert reckoned.figures.before.worst_m > 10.0
    north, east = reckoned.figures.after.north_m, reckoned.figures.after.east_m
    assert np.hypot(north - vehicle.fixes.north_m, east - vehicle.fixes.east_m).max() < 0.1


def test_dead_reckoning_with_gps_speed_tests_the_heading(vehicle, perfect):
    track = replace(vehicle.track, covariates={})
    found = judge("r", track, perfect, [], fixes=vehicle.fixes)
    assert found.reckoned.velocity == "speed of GPS"
    assert found.reckoned.figures.after.rms_percent < 0.3
    assert found.reckoned.figures.before.rms_percent > 1.0
    by_column = replace(track, covariates={"speed_m_s": 6.0 + np.sin(0.05 * track.time_s)})
    found = judge("r", by_column, perfect, [], fixes=vehicle.fixes)
    assert found.reckoned.velocity == "column speed_m_s"
    assert found.reckoned.figures.after.rms_percent < 0.05


def test_positions_in_the_recording_serve_as_fixes(vehicle, perfect):
    t = vehicle.track.time_s
    north, east = (
        np.interp(t, vehicle.fixes.time_s, values)
        for values in (vehicle.fixes.north_m, vehicle.fixes.east_m)
    )
    track = with_columns(vehicle, position_north_m=north + 300.0, position_east_m=east)
    fixes = fixes_of_track(track)
    assert fixes.north_m[0] == 0.0
    assert judge("r", track, perfect, [], fixes=fixes).reckoned.figures.after.rms_percent < 0.01
    assert fixes_of_track(vehicle.track) is None


def test_no_dead_reckoning_without_motion(vehicle, perfect):
    still = replace(
        vehicle.fixes, north_m=0 * vehicle.fixes.north_m, east_m=0 * vehicle.fixes.east_m
    )
    found = judge("r", replace(vehicle.track, covariates={}), perfect, [], fixes=still)
    assert found.reckoned is None
    assert any("the distance travelled is too short" in text for text in found.warnings)
    with pytest.raises(EvaluationError, match="0 fixes faster than 4 m/s"):
        course_reference(still, 4.0)
    early = replace(vehicle.fixes, time_s=vehicle.fixes.time_s - 1000.0)
    found = judge("r", vehicle.track, perfect, [course_reference(early, 4.0)], fixes=early)
    assert found.headings == ()
    assert any("are both on the same clock?" in text for text in found.warnings)


def test_gap_of_fixes_is_not_bridged(vehicle):
    kept = np.r_[0:80, 110:200]
    broken = replace(
        vehicle.fixes,
        time_s=vehicle.fixes.time_s[kept],
        north_m=vehicle.fixes.north_m[kept],
        east_m=vehicle.fixes.east_m[kept],
    )
    found = course_reference(broken, 4.0)
    assert len(found.time_s) == 78 + 88
    assert not np.any((found.time_s > 78.5) & (found.time_s < 110.5))


def test_degrees_are_converted_to_metres():
    t = np.arange(20.0)
    lat, lon = 42.0 + 1e-4 * t, 179.999 + 1e-4 * t
    lon = (lon + 180.0) % 360.0 - 180.0  # across the date line
    fixes = fixes_from_degrees(t, lat, lon, "f")
    assert fixes.north_m[-1] == pytest.approx(19e-4 * 111_195, rel=1e-3)
    assert fixes.east_m[-1] == pytest.approx(19e-4 * 111_195 * np.cos(np.radians(42)), rel=1e-3)
    for change, words in (
        ({"time_s": t[::-1]}, "time does not go forward at fix 1"),
        ({"lat_deg": 1e6 * lat}, "positions are no degrees"),
        ({"lat_deg": np.full(20, np.nan)}, "0 fixes with time and position"),
    ):
        with pytest.raises(EvaluationError, match=f"f: {words}"):
            fixes_from_degrees(
                **{"time_s": t, "lat_deg": lat, "lon_deg": lon, "source": "f", **change}
            )


def test_field_figures_follow_their_definitions():
    field = np.zeros((1000, 3))
    field[:, 2] = 0.5 + 0.05 * np.sign(np.sin(np.arange(1000) + 0.5))
    size = field[:, 2]
    found = field_figures(field, None)
    assert found.spread == pytest.approx(size.std() / size.mean())
    assert found.constraint_rms_gauss == pytest.approx(size.std())
    assert field_figures(field, 0.45).constraint_worst_gauss == pytest.approx(0.10)
    assert field_figures(field, 0.45).constraint_rms_gauss == pytest.approx(
        np.sqrt(np.mean((size - 0.45) ** 2))
    )
    assert len(found.fold_spread) == 5


def test_true_calibration_has_no_spread_and_the_world_field_sets_the_scale(vehicle, perfect):
    world = world_field(47.6, -122.3, 0.0, 2026.0)
    found = judge("r", vehicle.track, perfect, [course_reference(vehicle.fixes, 4.0)], world=world)
    assert found.field.after.spread < 1e-9
    assert found.field.before.spread > 0.02
    error = np.linalg.norm(FIELD_N) - world.total_gauss
    assert found.field.after.constraint_rms_gauss == pytest.approx(abs(error))
    offset = -5.0 - DECLINATION_DEG + np.degrees(world.declination_rad)
    assert found.headings[0].figures.after.offset_deg == pytest.approx(offset, abs=0.02)


def test_evaluation_on_training_data_is_warned_about_and_worse_is_a_no(vehicle, perfect):
    own = judge("another.csv.gz", vehicle.track, perfect, [])
    assert not own.held_out
    assert any("made from this very recording" in text for text in own.warnings)
    assert any("no heading to compare with" in text for text in own.warnings)
    worse = replace(perfect, correction=replace(perfect.correction, offset=np.array([0.3, 0, 0])))
    found = judge("r", vehicle.track, worse, [course_reference(vehicle.fixes, 4.0)])
    assert not found.better
    assert found.held_out


def test_json_and_table_have_the_same_figures(vehicle, perfect):
    found = judge(
        "r", vehicle.track, perfect, [course_reference(vehicle.fixes, 4.0)], fixes=vehicle.fixes
    )
    body = evaluation_json(found)
    assert body["schema"] == "ahrsd.evaluation/1"
    assert body["heading"][0]["after"]["rms_deg"] == found.headings[0].figures.after.rms_deg
    assert body["dead_reckoning"]["before"]["worst_m"] == found.reckoned.figures.before.worst_m
    lines = evaluation_lines(found)
    (rms,) = [line for line in lines if "RMS error" in line]
    assert float(rms.split()[-2]) == pytest.approx(
        body["heading"][0]["before"]["rms_deg"], abs=0.01
    )
    assert any("dead reckoning by Doppler velocity" in line for line in lines)


def _figures(error_deg, *, later_s=0.0):
    time_s = np.arange(len(error_deg)) + later_s
    nothing = np.zeros(len(error_deg))
    return HeadingFigures(0.0, 0.0, 0.0, (), 0.0, time_s, nothing, np.asarray(error_deg))


def test_difference_of_two_headings_has_a_confidence_interval():
    """Errors correlated over 20 s: equal ones, independent ones of equal size, and ones of twice
    the size.
    """
    rng = np.random.default_rng(3)
    shared = np.repeat(rng.standard_normal(40), 20)
    one = _figures(shared)
    assert rms_difference(one, one) == (0.0, 0.0)
    low, high = rms_difference(one, _figures(2 * shared))
    assert low < -np.sqrt(np.mean(shared**2)) < high < -0.7
    low, high = rms_difference(one, _figures(np.repeat(rng.standard_normal(40), 20)))
    assert -0.6 < low < 0.0 < high < 0.6
    assert high - low > 0.3  # 40 errors of size 1, not 800


def test_headings_at_other_instants_or_of_a_short_time_are_not_compared():
    one = _figures(np.ones(400))
    assert rms_difference(one, _figures(np.ones(400), later_s=0.5)) is None
    assert rms_difference(_figures(np.ones(70)), _figures(np.ones(70))) is None
