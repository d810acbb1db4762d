"""Effects of the world: the field changes with place and time, and near magnetic objects.

All of them are fields f in the world, in the sensor frame D = A R^T f.

The place of a magnetic object (`locate_dipole`) is estimated from the magnitude of the field along
the path.  The magnitude of the calibrated field does not depend on the sensor's attitude.  An
object adds to it, to first order, the component of its field along the earth's: u . B(p - p0; k),
linear in its moment k for a given place.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import product

import numpy as np

from ahrsd.diagnosis import time_series
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects import design_matrix
from ahrsd.diagnosis.effects.effect import Linear, Parameter, Readings, Setting, readings_of
from ahrsd.diagnosis.model import Columns, Context
from ahrsd.samples import Array

_MG = 1e-3
_NED = ("position_north_m", "position_east_m", "position_down_m")
#: the x axis is magnetic north for attitudes and true north for positions: a coarse grid of the
#: difference, in degrees
_DECLINATIONS_DEG = (-135.0, -90.0, -45.0, 0.0, 45.0, 90.0, 135.0, 180.0)
_BUMP_LENGTHS_S = (4.0, 12.0, 36.0)
_BUMPS = 2
_DISTANCES_M = (1.0, 3.0)
_SIDES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
#: metres; least distance of an object from the path
NEAREST_M = 0.2
_PATH_PLACES = 5  # further places along the path around which it is searched for
_SIGNIFICANT = 4.0  # usual departures of the magnitude from which an object is located
#: coarse grids: half waves of a slow pulsation, in lengths of the recording, and their phases
_HALF_WAVES, _PHASES_DEG = (0.45, 0.7, 1.05), (0.0, 45.0, 90.0, 135.0)
#: coarse grid of the height in which a field from below falls by e, in ranges of the height
_DECAYS = (0.15, 0.4, 1.0)
#: entries of a symmetric traceless matrix; the last diagonal one is minus the sum of the others
_GRADIENT = ("nn", "ee", "ne", "nd", "ed")
_REACH_M = 25.0
_MOST_ROWS = 600
_STARTS_M = (
    (0.0, 0.0, 1.0),
    (0.0, 0.0, 4.0),
    (1.5, 1.5, 0.5),
    (-1.5, -1.5, 0.5),
)
_TURNS_RAD = (-np.pi / 2, np.pi / 2, np.pi)  # of a frame of positions that does not point north


class FieldGradient(Linear):
    """W1: a field linear in position."""

    identifier = "field_gradient"
    code = "W1"
    family = "world"
    words = "the earth's field changes from place to place"
    equation = "m += A R^T G (p - p0), G symmetric and traceless"
    parameters = tuple(
        Parameter(f"gradient_{e}", "gauss/m", 0.3 * _MG, 50 * _MG) for e in _GRADIENT
    )
    typical = (0.3 * _MG, -0.1 * _MG, 0.2 * _MG, -0.2 * _MG, 0.15 * _MG)
    needs = ("position",)
    signature = "fixed in the world; the same again at the same place"
    confusers = (
        ("geomagnetic_drift", "on a single pass: cross the place twice"),
        ("altitude_field", "change depth at one place"),
        ("field_anomaly", "a finer grid of passes"),
    )
    manoeuvre = "cross the same place twice, on different headings"
    size = "0.02 to 2 mG/m outdoors, 1 to 50 mG/m indoors"
    source = "MAINS arXiv 2312.02599, GRSL 2016 (dossier W1)"

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """None without a level world frame, as positions are north, east, down."""
        return super().settings(context) if context.world_levelled else ()

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """The rotation between the world's frame and that of the positions."""
        place = position_m(readings)
        if place is None:
            return ()
        middle = [round(float(x), 3) for x in place.mean(axis=0)]
        return tuple({"reference_m": middle, "turn_deg": turn} for turn in _DECLINATIONS_DEG)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The five independent gradients times the position."""
        place = position_m(readings)
        if place is None:
            raise ValueError(f"{self.identifier} needs position_north_m and position_east_m")
        n, e, d = rotate_about_down(place - setting["reference_m"], setting["turn_deg"]).T
        zero = np.zeros_like(n)
        field = np.stack(
            [
                np.column_stack([n, zero, -d]),
                np.column_stack([zero, e, -d]),
                np.column_stack([e, n, zero]),
                np.column_stack([d, zero, n]),
                np.column_stack([zero, d, e]),
            ],
            axis=2,
        )
        return Columns(mag=_as_measured(readings, field))


class FieldAnomaly(Linear):
    """W2: a dipole at a place, or, without positions, a bump of some seconds."""

    identifier = "field_anomaly"
    code = "W2"
    family = "world"
    words = "iron or a magnet in the world, passed by"
    equation = (
        "m += A R^T (3 r (r k) - k) (d/|p - p0|)^3, r = unit(p - p0); or k sin^2(pi (t - t0)/L)"
    )
    parameters = design_matrix.vector("field", "gauss", 10 * _MG, 2000 * _MG)
    typical = design_matrix.along(15 * _MG)
    signature = "a bump of seconds, fixed in the world; the field's size changes"
    confusers = (
        ("field_gradient", "a finer grid of passes"),
        ("switched_device", "turn while it lasts"),
        ("noise_burst", "pass the place again"),
    )
    manoeuvre = "pass the place again on another heading"
    size = "1 to 500 mG"
    source = "BROAD trials 28 to 31 (dossier W2)"
    ordinary = 8.8

    def settings(self, context: Context) -> tuple[Setting, ...]:
        """Where the calibrated field's magnitude departs most: bumps then, dipoles near there."""
        readings = readings_of(context)
        size = field_size_departure(context)
        rows, searched = largest_departures(size, readings)
        first = float(readings.time_s[0])
        bumps = [
            {
                "onset_s": round(max(float(readings.time_s[row]) - part * length, first), 3),
                "length_s": length,
            }
            for row, length, part in product(rows, _BUMP_LENGTHS_S, (0.35, 0.5, 0.65))
        ]
        dipoles = _dipole_settings(context, readings, size, rows)
        return tuple({**setting, "searched": searched} for setting in (*bumps, *dipoles))

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """A dipole below the middle of the path, or a bump in the middle of the recording."""
        place = position_m(readings)
        if place is None:
            return ({"onset_s": design_matrix.middle_s(readings), "length_s": 12.0},)
        return (dipole_setting(place[len(place) // 2] + [0.0, 0.0, 2.0], 2.0),)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """Its field for unit sources along the world's axes."""
        if "onset_s" in setting:
            part = (readings.time_s - setting["onset_s"]) / setting["length_s"]
            bump = np.where((part > 0) & (part < 1), np.sin(np.pi * part) ** 2, 0.0)
            return Columns(mag=design_matrix.in_world(readings, bump[:, None]))
        place = position_m(readings)
        if place is None:
            raise ValueError(f"{self.identifier} needs position_north_m and position_east_m")
        away = rotate_about_down(place - setting["place_m"], setting.get("turn_deg", 0.0))
        axes = design_matrix.world_axes(readings)
        return Columns(mag=unit_dipole_fields(away, setting["distance_m"], axes))


class GeomagneticDrift(Linear):
    """W3: a slow change of the earth's field."""

    identifier = "geomagnetic_drift"
    code = "W3"
    family = "world"
    words = "the earth's field changes with time: daily variation, magnetic storm"
    equation = (
        "m += A R^T k s(t), s = t/T, sin(pi t/T), or sin(pi (t - T/2)/L + phase); "
        "T: length of the recording"
    )
    parameters = design_matrix.vector("change", "gauss", 1.0 * _MG, 50 * _MG)
    typical = design_matrix.along(2.0 * _MG)
    signature = "a trend fixed in the world, the same for all vehicles there"
    confusers = (
        ("mag_scale_temperature", "compare with an observatory (INTERMAGNET)"),
        ("hard_iron_drift", "turn through all headings throughout"),
        ("field_gradient", "cross the same place twice"),
    )
    manoeuvre = "all headings throughout; compare with an observatory"
    size = "0.2 to 1 mG a day when quiet, several mG within minutes in storms"
    source = "dossier W3"
    # the field defines north: a change that turns it about the vertical turns the world as well, is
    # not observable, and would diverge in the joint fit (from 2 mG to 25)

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """A line, a half wave, or a slow pulsation of half a wave or more at any phase."""
        over = design_matrix.span_setting(readings)
        waves = tuple(
            {
                **over,
                "shape": "wave",
                "length_s": round(part * over["span_s"], 3),
                "turn_deg": phase,
            }
            for part, phase in product(_HALF_WAVES, _PHASES_DEG)
        )
        return ({**over, "shape": "line"}, {**over, "shape": "hump"}, *waves)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """The time series on each axis of the world."""
        part = design_matrix.elapsed_fraction(readings, setting)
        if setting["shape"] == "wave":
            # the phase is that of the middle, where it does not correlate with the length
            turns = (part - 0.5) * setting["span_s"] / setting["length_s"]
            series = np.sin(np.pi * turns + np.radians(setting["turn_deg"]))
        else:
            series = part if setting["shape"] == "line" else np.sin(np.pi * np.clip(part, 0, 1))
        return Columns(mag=design_matrix.in_world(readings, series))


class AltitudeField(Linear):
    """W4: a field by height.

    `near` falls off like a dipole layer's field, `decay` like that of stripes in the ground.
    Both have slope 1 at the lowest point.
    """

    identifier = "altitude_field"
    code = "W4"
    family = "world"
    words = "the field changes with height above basalt, a wreck or reinforced concrete"
    equation = (
        "m += A R^T k f(a), f = a - a0, or with the lowest height a0 (1 - (a0/a)^3) a0/3, "
        "or (1 - exp(-(a - a0)/L)) L"
    )
    parameters = design_matrix.vector("per_metre", "gauss/m", 0.5 * _MG, 100 * _MG)
    typical = design_matrix.along(0.5 * _MG)
    needs = ("altitude|position",)
    signature = "follows height, fixed in the world"
    confusers = (("field_gradient", "change height at one place"),)
    manoeuvre = "rise and sink at one place"
    size = "0.1 to 50 mG"
    source = "Sentry 9N, East Pacific Rise (dossier W4)"

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """Linear in each height; a nearby source or a decay where the height is above ground."""
        found = list(design_matrix.settings_per_covariate(readings, "altitude", shape="line"))
        if "position_down_m" in roles.usable_columns(readings.covariates, "position"):
            depth = readings.covariates["position_down_m"]
            line = {"covariate": "position_down_m", "reference": float(depth.mean())}
            found += [{**line, "shape": "line"}] if float(np.ptp(depth)) > 0 else []
        for name in roles.usable_columns(readings.covariates, "altitude"):
            lowest = float(np.min(readings.covariates[name]))
            if lowest > 0.1:
                found.append({"covariate": name, "reference": lowest, "shape": "near"})
            reach = float(np.ptp(readings.covariates[name]))
            if reach > 0:
                at = {"covariate": name, "reference": lowest, "shape": "decay"}
                found += [{**at, "length_m": round(part * reach, 3)} for part in _DECAYS]
        return tuple(found)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """f on each axis of the world."""
        series = design_matrix.covariate_series(readings, setting)
        if setting["shape"] == "near":
            lowest = setting["reference"]
            series = (1 - (lowest / np.maximum(series + lowest, 0.5 * lowest)) ** 3) * lowest / 3
        if setting["shape"] == "decay":
            series = -np.expm1(-series / setting["length_m"]) * setting["length_m"]
        return Columns(mag=design_matrix.in_world(readings, series))


class FieldStep(Linear):
    """W7: a step of the field in the world."""

    identifier = "field_step"
    code = "W7"
    family = "world"
    words = "the vehicle was calibrated next to iron and then moved away from it"
    equation = "m += A R^T k from t0 on"
    parameters = design_matrix.vector("step", "gauss", 10 * _MG, 1000 * _MG)
    typical = design_matrix.along(8 * _MG)
    signature = "one jump, fixed in the world"
    confusers = (
        ("hard_iron_step", "it turns with the vehicle: turn once after the jump"),
        ("soft_iron_step", "pitch and roll before and after"),
        ("field_gradient", "log the position"),
    )
    manoeuvre = "all headings before and after"
    size = "5 to 100 mG"
    source = "inav #8004 (dossier W7)"
    ordinary = 1.8
    recurs = True
    jumps = True

    def choices(self, readings: Readings) -> tuple[Setting, ...]:
        """A coarse grid of onset times."""
        return design_matrix.onset_settings(readings)

    def terms(self, readings: Readings, setting: Setting) -> Columns:
        """A unit step at the onset, on each axis of the world."""
        return Columns(
            mag=design_matrix.in_world(readings, design_matrix.after_onset(readings, setting))
        )


@lru_cache(maxsize=2)
def position_m(readings: Readings) -> Array | None:
    """North, east, down (N, 3) in metres, down 0 where it was not logged.

    None without north and east, or where the vehicle does not move.
    """
    usable = roles.usable_columns(readings.covariates, "position")
    if not {"position_north_m", "position_east_m"} <= set(usable):
        return None
    zero = np.zeros(len(readings.time_s))
    place = np.column_stack([readings.covariates[n] if n in usable else zero for n in _NED])
    return place if float(np.ptp(place, axis=0).max()) > 0 else None


def rotate_about_down(vectors: Array, turn_deg: float) -> Array:
    """Vectors (N, 3) rotated about down."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.asarray(vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T)


def field_size_departure(context: Context) -> Array:
    """Magnitude of the calibrated field minus its median (N,), gauss.

    It does not depend on the attitude of the sensor, only on the calibration.
    """
    track, model = context.track, context.model
    field = np.linalg.solve(model.soft_iron, (track.mag_b_gauss - model.hard_iron_gauss).T)
    size = np.linalg.norm(field, axis=0)
    return np.asarray(np.where(np.isfinite(size), size - np.nanmedian(size), 0.0))


def largest_departures(size: Array, readings: Readings) -> tuple[list[int], int]:
    """Rows where the magnitude departs most, and the number of places compared."""
    rows = max(round(_BUMP_LENGTHS_S[0] / 2 / time_series.median_step(readings.dt_s)), 1)
    away = np.abs(time_series.moving_mean(size, readings.dt_s, rows))
    found: list[int] = []
    for _ in range(_BUMPS):
        found.append(int(np.argmax(away)))
        near = np.abs(readings.time_s - readings.time_s[found[-1]]) < _BUMP_LENGTHS_S[-1] / 2
        away = np.where(near, -1.0, away)
        if away.max() <= 0:
            break
    return found, max(len(size) // rows, 1)


def _dipole_settings(
    context: Context, readings: Readings, size: Array, rows: list[int]
) -> tuple[Setting, ...]:
    """Dipoles near the path: located where the magnitude clearly departs, and on a grid."""
    place = position_m(readings) if context.world_levelled else None
    if place is None:
        return ()
    field_n = np.einsum("nij,nj->ni", readings.R_nb, readings.field_b).mean(axis=0)
    usual = 1.4826 * float(np.median(np.abs(size)))
    found: list[Setting] = []
    for row in rows:
        window = slice(max(row - 2, 0), row + 3)
        if abs(float(np.mean(size[window]))) > _SIGNIFICANT * usual:
            best = locate_dipole(size, place, field_n, row)
            if best is not None:
                nearest = float(np.linalg.norm(place - best[0], axis=1).min())
                found.append(dipole_setting(best[0], max(nearest, NEAREST_M), np.degrees(best[1])))
        around = product(_DISTANCES_M, _SIDES)
        found += [dipole_setting(place[row] + far * np.array(side), far) for far, side in around]
    far = _DISTANCES_M[-1]
    along = place[:: max(len(place) // _PATH_PLACES, 1)]
    found += [dipole_setting(at + far * np.array(side), far) for at, side in product(along, _SIDES)]
    return tuple(found)


def _as_measured(readings: Readings, field_n: Array) -> Array:
    """Fields of the world (N, 3, p) as the magnetometer reads them."""
    return np.asarray(design_matrix.world_axes(readings) @ field_n)


def dipole_setting(place: Array, distance: float, turn_deg: float = 0.0) -> Setting:
    """The setting of a dipole at a place, at this distance from the nearest point of the path."""
    return {
        "place_m": [round(float(x), 4) for x in place],
        "distance_m": round(distance, 3),
        "turn_deg": round(float(turn_deg) % 360.0, 3),
    }


def unit_dipole_fields(away_m: Array, distance_m: float, axes: Array | None = None) -> Array:
    """Fields (N, 3, 3) of unit moments at offsets (N, 3) from the object.

    A moment is given as the field across its axis at `distance_m`.
    axes: (N, 3, 3) the world's axes in the frame of the result; the world's own if None
    """
    size = np.sqrt(np.einsum("ni,ni->n", away_m, away_m))
    distance = np.maximum(size, NEAREST_M / 4)
    r = away_m / distance[:, None]
    strength = (distance_m / distance) ** 3
    direction = r if axes is None else np.einsum("nij,nj->ni", axes, r)
    fields = (3 * strength[:, None] * direction)[:, :, None] * r[:, None, :]
    fields -= strength[:, None, None] * (np.eye(3) if axes is None else axes)
    return np.asarray(fields)


def locate_dipole(
    size_gauss: Array, place_m: Array, field_n: Array, row: int
) -> tuple[Array, float] | None:
    """The place (3,) of a dipole that best explains the magnitude (N,) near `row`, and a rotation.

    The rotation about down (rad) is from the frame of the positions to that of the field.  None
    where the path is too short.
    place_m: (N, 3) path of the sensor;  field_n: (3,) the earth's field
    """
    near = np.linalg.norm(place_m - place_m[row], axis=1) < _REACH_M
    rows = np.flatnonzero(near)
    rows = rows[:: max(len(rows) // _MOST_ROWS, 1)]
    if len(rows) < 20:
        return None
    u = field_n / np.linalg.norm(field_n)
    path, size = place_m[rows], size_gauss[rows]

    def misfit(unknown: Array) -> float:
        place, turn = unknown[:3], float(unknown[3])
        c, s = np.cos(turn), np.sin(turn)
        direction = np.array([c * u[0] + s * u[1], c * u[1] - s * u[0], u[2]])
        columns = np.column_stack(
            [direction @ unit_dipole_fields(path - place, 1.0), np.ones(len(path))]
        )
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        right = columns.T @ size
        ridge = columns.T @ columns + 1e-9 * np.eye(4)
        outside = max(NEAREST_M - float(np.linalg.norm(path - place, axis=1).min()), 0.0)
        return float(size @ size - right @ np.linalg.solve(ridge, right)) * (1 + outside)

    starts = [np.append(place_m[row] + np.array(start), 0.0) for start in _STARTS_M]
    best = min((_minimise(misfit, start, 90) for start in starts), key=lambda one: one[0])
    rotated = [
        _minimise(misfit, np.append(best[1][:3], best[1][3] + turn), 90) for turn in _TURNS_RAD
    ]
    best = min((best, *rotated), key=lambda one: one[0])
    found = _minimise(misfit, best[1], 250)[1]
    return found[:3], float(found[3])


def _minimise(
    cost: Callable[[Array], float], start: Array, evaluations: int
) -> tuple[float, Array]:
    """The lowest cost of a Nelder-Mead search, and where it is."""
    from scipy.optimize import minimize  # slow to import, and seldom needed

    done = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"maxfev": evaluations, "xatol": 0.01, "fatol": 0.0},
    )
    return float(done.fun), np.asarray(done.x, dtype=np.float64)
