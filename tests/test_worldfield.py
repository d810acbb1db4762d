"""World field: values, units, and what is refused."""

import math

import numpy as np
import pytest

from ahrsd.worldfield import WorldFieldError, world_field

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
def test_what_is_not_known_is_refused_in_one_line(place, year, words) -> None:
    with pytest.raises(WorldFieldError) as refused:
        world_field(*place, year)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
