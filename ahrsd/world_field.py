"""The Earth's field by position and date: WMM through pygeomag, IGRF-14 through pyIGRF14.

    field_n = (H cos D, H sin D, Z),   tan D = Y / X,   tan I = Z / H      (north, east, down)

Of the WMM it is the model whose five years hold the date; the IGRF goes back to 1900. A date that
no model holds is refused, because a silent extrapolation is a wrong answer. The standard deviations
are the WMM's error figures, of WMM2025 for the IGRF, which publishes none: what both leave out is
mostly the same crustal field. The iron of a quay or of a building is in none of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pygeomag import GeoMag  # type: ignore[import-untyped]
from pygeomag.wmm.wmm_2015v2 import WMM_2015v2  # type: ignore[import-untyped]
from pygeomag.wmm.wmm_2020 import WMM_2020  # type: ignore[import-untyped]
from pygeomag.wmm.wmm_2025 import WMM_2025  # type: ignore[import-untyped]
from pyIGRF14 import igrf_value  # type: ignore[import-untyped]

from ahrsd.errors import AhrsdError
from ahrsd.samples import Array

GAUSS_PER_NANOTESLA = 1e-5
_LIFE_YEARS = 5.0
_MODELS = {2015.0: WMM_2015v2, 2020.0: WMM_2020, 2025.0: WMM_2025}
OLDEST_WMM_YEAR = min(_MODELS)
OLDEST_YEAR, _IGRF_END = 1900.0, 2030.0  # IGRF-14; from 2025 on by its predicted secular variation
# WMM2025's error figures: north, east, down and total in nT, inclination in deg
_SIGMA_N_NT, _SIGMA_TOTAL_NT, _SIGMA_INCLINATION_DEG = (137.0, 89.0, 141.0), 138.0, 0.20
_BLACKOUT_NT = 2000.0  # of horizontal field, below which the WMM calls a compass unusable

Model = Literal["wmm", "igrf"]


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
    model: Model = "wmm",
) -> WorldField:
    """Field at a geodetic position (WGS 84) and a date.

    Raises WorldFieldError where the position is missing or off the globe, or the model does not
    hold for the date.
    """
    latitude_deg, longitude_deg = _checked(latitude_deg, longitude_deg, height_m)
    of_model = _wmm if model == "wmm" else _igrf
    return of_model(latitude_deg, longitude_deg, height_m / 1000.0, decimal_year)


def _wmm(latitude_deg: float, longitude_deg: float, height_km: float, year: float) -> WorldField:
    epoch = _epoch(year)
    result = GeoMag(coefficients_data=_MODELS[epoch]).calculate(
        glat=latitude_deg, glon=longitude_deg, alt=height_km, time=year
    )
    sigma = result.calculate_uncertainty()
    return _field(
        (result.x, result.y, result.z),
        (sigma.x, sigma.y, sigma.z),
        sigma.f,
        sigma.i,
        f"WMM{epoch:.0f}",
        epoch + _LIFE_YEARS,
    )


def _igrf(latitude_deg: float, longitude_deg: float, height_km: float, year: float) -> WorldField:
    if not OLDEST_YEAR <= year < _IGRF_END:
        raise WorldFieldError(
            f"no IGRF for the year {year:.2f} (IGRF-14 holds from {OLDEST_YEAR:.0f} to "
            f"{_IGRF_END:.0f}): set the date, or install a newer generation"
        )
    *_, north, east, down, _ = igrf_value(latitude_deg, longitude_deg, height_km, year)
    return _field(
        (north, east, down),
        _SIGMA_N_NT,
        _SIGMA_TOTAL_NT,
        _SIGMA_INCLINATION_DEG,
        "IGRF-14",
        _IGRF_END,
    )


def _field(
    field_n_nt: tuple[float, float, float],
    sigma_n_nt: tuple[float, float, float],
    total_sigma_nt: float,
    inclination_sigma_deg: float,
    model: str,
    valid_until: float,
) -> WorldField:
    north, east, down = field_n_nt
    horizontal = math.hypot(north, east)
    field_n_gauss = np.array(field_n_nt) * GAUSS_PER_NANOTESLA
    sigma_n_gauss = np.array(sigma_n_nt) * GAUSS_PER_NANOTESLA
    field_n_gauss.flags.writeable = sigma_n_gauss.flags.writeable = False
    return WorldField(
        field_n_gauss=field_n_gauss,
        declination_rad=math.atan2(east, north),
        inclination_rad=math.atan2(down, horizontal),
        total_gauss=math.hypot(horizontal, down) * GAUSS_PER_NANOTESLA,
        model=model,
        valid_until=valid_until,
        sigma_n_gauss=sigma_n_gauss,
        total_sigma_gauss=total_sigma_nt * GAUSS_PER_NANOTESLA,
        inclination_sigma_rad=math.radians(inclination_sigma_deg),
        heading_usable=horizontal >= _BLACKOUT_NT,
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
