"""World field: values, units, and what is refused."""

import math

import numpy as np
import pytest

from ahrsd.world_field import WorldFieldError, world_field

SEATTLE = (47.6205, -122.3493, 0.0)


def test_declination_of_seattle_is_the_one_in_pygeomags_documentation() -> None:
    assert math.degrees(world_field(*SEATTLE, 2025.25).declination_rad) == pytest.approx(
        15.0656, abs=1e-3
    )


def test_components_agree_with_total_declination_and_inclination_in_gauss() -> None:
    field = world_field(*SEATTLE, 2025.25)
    north, east, down = field.field_n_gauss
    assert 0.50 < field.total_gauss < 0.55
    assert np.linalg.norm(field.field_n_gauss) == pytest.approx(field.total_gauss, rel=1e-9)
    assert math.atan2(east, north) == pytest.approx(field.declination_rad, abs=1e-9)
    assert math.atan2(down, math.hypot(north, east)) == pytest.approx(field.inclination_rad)
    assert field.model == "WMM2025"
    assert field.valid_until == 2030.0
    assert field.total_sigma_gauss == pytest.approx(138e-5)
    assert field.heading_usable


def test_an_older_date_takes_the_model_of_its_time() -> None:
    field = world_field(*SEATTLE, 2024.5)
    assert (field.model, field.valid_until) == ("WMM2020", 2025.0)
    now = world_field(*SEATTLE, 2025.0)
    assert np.linalg.norm(now.field_n_gauss - field.field_n_gauss) < 2e-3


def test_height_weakens_the_field() -> None:
    low, high = world_field(*SEATTLE, 2026.0), world_field(47.6205, -122.3493, 1e5, 2026.0)
    assert high.total_gauss == pytest.approx(low.total_gauss * (6371 / 6471) ** 3, rel=0.01)


def test_near_the_magnetic_pole_heading_is_not_usable() -> None:
    assert not world_field(86.5, 164.0, 0.0, 2025.0).heading_usable


# The test values that NOAA publishes with WMM2025 (WMM2025_TEST_VALUES.txt): all twelve rows of
# year, height km, latitude, longitude, X, Y, Z, H, F in nT, I, D in deg.
PUBLISHED = [
    (2025.0, 0, 80, 0, 6521.6, 145.9, 54791.5, 6523.2, 55178.5, 83.21, 1.28),
    (2025.0, 0, 0, 120, 39677.8, -109.6, -10580.2, 39677.9, 41064.3, -14.93, -0.16),
    (2025.0, 0, -80, 240, 6117.5, 15751.9, -52022.5, 16898.1, 54698.2, -72.00, 68.78),
    (2025.0, 100, 80, 0, 6216.0, 92.4, 52598.8, 6216.7, 52964.9, 83.26, 0.85),
    (2025.0, 100, 0, 120, 37688.6, -96.2, -10152.1, 37688.7, 39032.1, -15.08, -0.15),
    (2025.0, 100, -80, 240, 5907.6, 14780.3, -49540.7, 15917.1, 52035.0, -72.19, 68.21),
    (2027.5, 0, 80, 0, 6500.8, 294.5, 54869.4, 6507.5, 55253.9, 83.24, 2.59),
    (2027.5, 0, 0, 120, 39701.6, -167.4, -10381.8, 39702.0, 41036.9, -14.65, -0.24),
    (2027.5, 0, -80, 240, 6200.7, 15730.3, -51783.7, 16908.3, 54474.2, -71.92, 68.49),
    (2027.5, 100, 80, 0, 6196.7, 233.8, 52670.5, 6201.1, 53034.3, 83.29, 2.16),
    (2027.5, 100, 0, 120, 37711.5, -148.7, -9969.8, 37711.8, 39007.4, -14.81, -0.23),
    (2027.5, 100, -80, 240, 5984.0, 14760.1, -49317.7, 15927.0, 51825.7, -72.10, 67.93),
]


@pytest.mark.parametrize("row", PUBLISHED)
def test_the_published_test_values_of_wmm2025(row) -> None:
    year, height_km, latitude, longitude, x, y, z, _, total, inclination, declination = row
    field = world_field(latitude, (longitude + 180) % 360 - 180, 1e3 * height_km, year)
    assert 1e5 * field.field_n_gauss == pytest.approx([x, y, z], abs=0.1)
    assert 1e5 * field.total_gauss == pytest.approx(total, abs=0.1)
    assert math.degrees(field.inclination_rad) == pytest.approx(inclination, abs=0.006)
    assert math.degrees(field.declination_rad) == pytest.approx(declination, abs=0.006)


# IGRF-14 as ppigrf 2.1.0 has it, another implementation with its own copy of the coefficients (its
# authors compare it with NOAA's calculator): latitude, longitude, height m, year; X, Y, Z in nT.
IGRF = [
    ((80, 0, 0, 2025.0), (6527.4, 141.6, 54782.5)),
    ((0, 120, 0, 2025.0), (39676.2, -111.2, -10576.1)),
    ((-80, -120, 100000, 2025.0), (5906.1, 14770.7, -49545.9)),
    ((42.34, -71.09, 0, 2022.0), (19821.8, -5040.2, 47370.6)),
    ((52.5, 13.4, 0, 2027.0), (18633.5, 1704.5, 46488.0)),
    ((-35.36, 149.16, 500, 2015.0), (23155.6, 5079.7, -53128.7)),
    ((47.62, -122.35, 0, 2000.0), (18282.5, 6200.6, 51709.1)),
    ((10, 20, 0, 1950.0), (33938.1, -2290.9, -181.7)),
    ((60.39299, 5.32415, 0, 2021.2356), (14996.7, 458.9, 49019.6)),
]


@pytest.mark.parametrize(("at", "field_nt"), IGRF)
def test_two_implementations_of_the_igrf_agree(at, field_nt) -> None:
    field = world_field(*at, model="igrf")
    assert 1e5 * field.field_n_gauss == pytest.approx(field_nt, abs=0.3)
    assert field.model == "IGRF-14"
    assert field.valid_until == 2030.0


@pytest.mark.parametrize("year", [2016.0, 2021.5, 2025.0, 2029.9])
@pytest.mark.parametrize("place", [(80, 0), (0, 120), (-80, -120), (42, -71), (-35, 149)])
def test_the_two_models_agree_within_tens_of_nanotesla(place, year) -> None:
    """They describe the same main field; the last years of each epoch are predictions."""
    wmm, igrf = (world_field(*place, 0.0, year, model) for model in ("wmm", "igrf"))
    difference_nt = 1e5 * (wmm.field_n_gauss - igrf.field_n_gauss)
    assert np.max(np.abs(difference_nt)) < 90.0
    assert np.linalg.norm(difference_nt) > 0.01  # they are two models


def test_igrf_has_the_text_and_errors_of_the_wmm() -> None:
    field = world_field(*SEATTLE, 1960.0, "igrf")
    assert field.total_sigma_gauss == pytest.approx(138e-5)
    assert field.heading_usable
    assert not world_field(86.5, 164.0, 0.0, 2025.0, "igrf").heading_usable
    for year in (1899.9, 2030.0, math.nan):
        with pytest.raises(WorldFieldError, match=f"no IGRF for the year {year:.2f}"):
            world_field(*SEATTLE, year, "igrf")
    with pytest.raises(WorldFieldError, match="set latitude and longitude"):
        world_field(None, None, 0.0, 2026.0, "igrf")


@pytest.mark.parametrize(
    ("place", "year", "words"),
    [
        ((None, 10.0, 0.0), 2026.0, "set latitude and longitude in the configuration"),
        ((10.0, None, 0.0), 2026.0, "set latitude and longitude in the configuration"),
        ((91.0, 10.0, 0.0), 2026.0, "latitude 91.0 deg is not within -90..90"),
        ((math.nan, 10.0, 0.0), 2026.0, "latitude nan"),
        ((10.0, -181.0, 0.0), 2026.0, "longitude -181.0 deg"),
        ((10.0, 10.0, math.nan), 2026.0, "height nan m"),
        ((10.0, 10.0, 0.0), 2030.0, "2015 to 2030): set the clock, or install a newer pygeomag"),
        ((10.0, 10.0, 0.0), 1980.0, "no world magnetic model for the year 1980.00"),
        ((10.0, 10.0, 0.0), math.nan, "no world magnetic model for the year nan"),
    ],
)
def test_unknown_position_or_date_is_refused_in_one_line(place, year, words) -> None:
    with pytest.raises(WorldFieldError) as refused:
        world_field(*place, year)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
