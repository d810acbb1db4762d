"""The Earth's field by position and date: WMM through pygeomag.

    field_n = (H cos D, H sin D, Z),   tan D = Y / X,   tan I = Z / H      (north, east, down)

The model is the one whose five years hold the date; a date outside all of them is refused, because
a silent extrapolation is a wrong answer. The standard deviations are the model's own error figures:
they include crustal field, not the iron of a quay or of a building.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pygeomag import GeoMag  # type: ignore[import-untyped]
from pygeomag.wmm.wmm_2015v2 import WMM_2015v2  # type: ignore[import-untyped]
from pygeomag.wmm.wmm_2020 import WMM_2020  # type: ignore[import-untyped]
from pygeomag.wmm.wmm_2025 import WMM_2025  # type: ignore[import-untyped]

from ahrsd.errors import AhrsdError
from ahrsd.samples import Array

GAUSS_PER_NANOTESLA = 1e-5
_LIFE_YEARS = 5.0
_MODELS = {2015.0: WMM_2015v2, 2020.0: WMM_2020, 2025.0: WMM_2025}


class WorldFieldError(AhrsdError):
    """Position or date for which there is no field; one line that says what to set."""


@dataclass(frozen=True, slots=True, eq=False)
class WorldField:
    """Field at a place and a date.

    field_n_gauss:  (3,) north, east, down
    sigma_n_gauss:  (3,) standard deviations of the model, same axes
    valid_until:    decimal year at which the model expires
    heading_usable: false where the horizontal field is so weak that a compass is useless
                    (the model's blackout zone around the magnetic poles)
    """

    field_n_gauss: Array
    declination_rad: float
    inclination_rad: float
    total_gauss: float
    model: str
    valid_until: float
    sigma_n_gauss: Array
    total_sigma_gauss: float
    inclination_sigma_rad: float
    heading_usable: bool


def world_field(
    latitude_deg: float | None,
    longitude_deg: float | None,
    height_m: float,
    decimal_year: float,
) -> WorldField:
    """Field at a geodetic position (WGS 84) and a date.

    Raises WorldFieldError where the position is missing or off the globe, or no model is valid.
    """
    latitude_deg, longitude_deg = _checked(latitude_deg, longitude_deg, height_m)
    epoch = _epoch(decimal_year)
    result = GeoMag(coefficients_data=_MODELS[epoch]).calculate(
        glat=latitude_deg, glon=longitude_deg, alt=height_m / 1000.0, time=decimal_year
    )
    sigma = result.calculate_uncertainty()
    field_n_gauss = np.array([result.x, result.y, result.z]) * GAUSS_PER_NANOTESLA
    sigma_n_gauss = np.array([sigma.x, sigma.y, sigma.z], dtype=float) * GAUSS_PER_NANOTESLA
    field_n_gauss.flags.writeable = sigma_n_gauss.flags.writeable = False
    return WorldField(
        field_n_gauss=field_n_gauss,
        declination_rad=math.radians(result.d),
        inclination_rad=math.radians(result.i),
        total_gauss=result.f * GAUSS_PER_NANOTESLA,
        model=f"WMM{epoch:.0f}",
        valid_until=epoch + _LIFE_YEARS,
        sigma_n_gauss=sigma_n_gauss,
        total_sigma_gauss=sigma.f * GAUSS_PER_NANOTESLA,
        inclination_sigma_rad=math.radians(sigma.i),
        heading_usable=not result.in_blackout_zone,
    )


def _checked(
    latitude_deg: float | None, longitude_deg: float | None, height_m: float
) -> tuple[float, float]:
    if latitude_deg is None or longitude_deg is None:
        raise WorldFieldError("no position: set latitude and longitude in the configuration")
    if not abs(latitude_deg) <= 90.0:
        raise WorldFieldError(f"latitude {latitude_deg} deg is not within -90..90")
    if not abs(longitude_deg) <= 180.0:
        raise WorldFieldError(f"longitude {longitude_deg} deg is not within -180..180")
    if not -1000.0 <= height_m <= 850_000.0:
        raise WorldFieldError(f"height {height_m} m is not within -1000..850000")
    return latitude_deg, longitude_deg


def _epoch(decimal_year: float) -> float:
    for epoch in _MODELS:
        if epoch <= decimal_year < epoch + _LIFE_YEARS:
            return epoch
    first, last = min(_MODELS), max(_MODELS) + _LIFE_YEARS
    raise WorldFieldError(
        f"no world magnetic model for the year {decimal_year:.2f} (known: {first:.0f} to "
        f"{last:.0f}): set the clock, or install a newer pygeomag"
    )
