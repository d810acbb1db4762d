"""Effects in a simulated experiment, and in an emulated device along its own motion.

A user asks for an effect (`Request`) by ID, ID=STRENGTH or ID=name=value,name=value.  STRENGTH is
a multiple of the effect's typical size.  A name is a parameter (the others are then 0) or a part
of the setting (`onset_s`, `time_constant_s`, ...).

Effects that follow a column get columns of an ordinary working vehicle (`columns_for`), one or
more per role:

current, rpm, speed   levels that change every 10 to 40 s, rounded off
temperature           a warm-up of 8 K with a time constant of 5 minutes
position              a lawn-mower pattern, legs of 40 m, 8 m apart, at 0.6 m/s
angle                 a rudder that is put over now and then;  switch, ping: on and off
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ahrsd import so3
from ahrsd.diagnosis.columns import roles
from ahrsd.diagnosis.effects.effect import Effect, Readings, Setting
from ahrsd.diagnosis.effects.library import EFFECTS
from ahrsd.diagnosis.model import Term
from ahrsd.diagnosis.repaired_model.forward import simulate_readings
from ahrsd.samples import Array
from ahrsd.simulation import Experiment
from drivers.vn100.emulator.physics import GRAVITY_M_S2, matrices, quaternions
from drivers.vn100.emulator.scenarios import Setup, hidden

_LEG_M, _APART_M, _SPEED_M_S = 40.0, 8.0, 0.6
_PING_S = 1.7
#: rounding times after which a change of level is over, but for 4e-11 of it
_ROUNDING_REACH = 12.0

LoggedColumns = dict[str, Array]


def readings_of(experiment: Experiment, covariates: Mapping[str, Array]) -> Readings:
    """The experiment's truth and its noise-free readings."""
    truth, samples = experiment.truth, experiment.samples
    return Readings(
        time_s=samples.time_s,
        dt_s=samples.dt_s,
        mag_b_gauss=experiment.field_b @ truth.soft_iron.T + truth.hard_iron_gauss,
        gyro_b_rad_s=experiment.rate_b_rad_s + truth.gyro_bias_rad_s,
        accel_b_m_s2=samples.accel_b_m_s2,
        rate_b_rad_s=experiment.rate_b_rad_s,
        field_b=experiment.field_b,
        R_nb=experiment.R_nb,
        soft_iron=truth.soft_iron,
        covariates=dict(covariates),
    )


def inject_terms(
    experiment: Experiment,
    readings: Readings,
    terms: Sequence[Term],
    library: Mapping[str, Effect] = EFFECTS,
) -> Experiment:
    """The experiment with the effects in its samples; truth and noise stay the same.

    readings: its noise-free readings with the covariates, which become the samples' covariates.
    """
    samples = experiment.samples
    early = [t for t in terms if not library[t.identifier].after_noise]
    late = [t for t in terms if library[t.identifier].after_noise]
    made = simulate_readings(readings, early, library=library)
    noisy = replace(
        made,
        mag_b_gauss=made.mag_b_gauss + (samples.raw_b_gauss - readings.mag_b_gauss),
        gyro_b_rad_s=made.gyro_b_rad_s + (samples.gyro_b_rad_s - readings.gyro_b_rad_s),
    )
    done = simulate_readings(noisy, late, library=library)
    return Experiment(
        name=" with ".join([experiment.name, *(term.identifier for term in terms)]),
        samples=replace(
            samples,
            time_s=done.time_s,
            dt_s=done.dt_s,
            host_s=done.time_s,
            raw_b_gauss=done.mag_b_gauss,
            gyro_b_rad_s=done.gyro_b_rad_s,
            accel_b_m_s2=done.accel_b_m_s2,
            covariates=done.covariates,
        ),
        truth=experiment.truth,
        R_nb=done.R_nb,
        field_b=done.field_b,
        rate_b_rad_s=done.rate_b_rad_s,
    )


def terms_json(
    terms: Sequence[Term], library: Mapping[str, Effect] = EFFECTS
) -> list[dict[str, object]]:
    """The terms for the truth file of a recording: value, unit and setting of each."""
    return [
        {
            "effect": term.identifier,
            "setting": term.setting,
            "parameters": [
                {"name": p.name, "value": float(value), "unit": p.unit}
                for p, value in zip(
                    library[term.identifier].parameters, np.atleast_1d(term.value), strict=True
                )
            ],
        }
        for term in terms
    ]


# -- In an emulated device ------------------------------------------------------------------------


RATE_HZ = 100.0
PIECE_S = 300.0
WARM_UP_S = 120.0  # history of an effect with a memory before a piece begins
HORIZON_S = 3600.0  # made-up columns repeat after it; onsets and spans refer to it
_COLUMNS_HZ = 20.0


class EmulatedEffects:
    """What the effects add to the device's sensors, as a function of the device's time.

    Computed at 100 Hz in pieces of five minutes, linear in between; before time 0 as at time 0.
    The device sends no further columns, so an effect of a current is one of an unlogged current;
    the temperature is that of the device. Raises ValueError in one line for an effect that is not
    additive or an invalid request.
    """

    def __init__(self, setup: Setup, requested: Sequence[str]) -> None:
        _, self._truth, self._motion = hidden(setup)
        requests = [parse_request(text) for text in requested]
        for one in requests:
            if one.effect.kind != "mean" or one.effect.after_noise:
                known = ", ".join(
                    e.identifier for e in EFFECTS.values() if e.kind == "mean" and not e.after_noise
                )
                raise ValueError(
                    f"{one.effect.identifier} cannot be emulated; there are {known}, and faults"
                )
        grid = np.arange(0.0, HORIZON_S, 1.0 / _COLUMNS_HZ)
        self._columns = columns_for([one.effect for one in requests], grid, setup.seed)
        whole = self._readings(np.arange(0.0, HORIZON_S, 1.0))
        self._terms = tuple(one.term(whole) for one in requests)
        self._pieces: dict[int, tuple[Array, Array, Array]] = {}

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Field (gauss) and rate (rad/s), (N, 3) each, that add at the instants (N,)."""
        instants = np.maximum(time_s, 0.0)
        mag, gyro = np.zeros((len(instants), 3)), np.zeros((len(instants), 3))
        number = (instants // PIECE_S).astype(int)
        for piece in np.unique(number).tolist():
            rows = number == piece
            known_s, of_mag, of_gyro = self._piece(piece)
            for axis in range(3):
                mag[rows, axis] = np.interp(instants[rows], known_s, of_mag[:, axis])
                gyro[rows, axis] = np.interp(instants[rows], known_s, of_gyro[:, axis])
        return mag, gyro

    def _piece(self, number: int) -> tuple[Array, Array, Array]:
        if number not in self._pieces:
            start = max(number * PIECE_S - WARM_UP_S, 0.0)
            rows = round(((number + 1) * PIECE_S - start) * RATE_HZ) + 1
            clean = self._readings(start + np.arange(rows) / RATE_HZ)
            made = simulate_readings(clean, self._terms)
            self._pieces = {
                **{k: v for k, v in self._pieces.items() if k >= number - 1},
                number: (
                    clean.time_s,
                    made.mag_b_gauss - clean.mag_b_gauss,
                    made.gyro_b_rad_s - clean.gyro_b_rad_s,
                ),
            }
        return self._pieces[number]

    def _readings(self, time_s: Array) -> Readings:
        """The device's noise-free readings at equidistant instants (N,)."""
        truth, step_s = self._truth, float(time_s[1] - time_s[0])
        R_nb = matrices(quaternions(self._motion.angles(time_s)))
        before = matrices(quaternions(self._motion.angles(time_s - step_s)))
        rate = so3.log(np.swapaxes(before, 1, 2) @ R_nb) / step_s
        field_b = np.einsum("nji,j->ni", R_nb, truth.field_n_gauss)
        return Readings(
            time_s=time_s,
            dt_s=np.concatenate([[np.nan], np.diff(time_s)]),
            mag_b_gauss=field_b @ truth.soft_iron.T + truth.hard_iron_gauss,
            gyro_b_rad_s=rate + truth.gyro_bias_rad_s,
            accel_b_m_s2=-GRAVITY_M_S2 * R_nb[:, 2, :],
            rate_b_rad_s=rate,
            field_b=field_b,
            R_nb=R_nb,
            soft_iron=truth.soft_iron,
            covariates=self._covariates(time_s),
        )

    def _covariates(self, time_s: Array) -> dict[str, Array]:
        grid = np.arange(0.0, HORIZON_S, 1.0 / _COLUMNS_HZ)
        lap_s = np.mod(time_s, HORIZON_S)
        out = {name: np.interp(lap_s, grid, values) for name, values in self._columns.items()}
        if "temperature_c" in out:
            warmth = 1 - np.exp(-time_s / 600.0)
            out["temperature_c"] = self._truth.temperature_c + self._truth.warming_c * warmth
        return out


@dataclass(frozen=True, slots=True)
class Request:
    """An effect that a user asks for: its size as a multiple, or its values by name."""

    effect: Effect
    strength: float = 1.0
    given: Mapping[str, str] = field(default_factory=dict)

    def term(self, readings: Readings) -> Term:
        """The effect's value and setting on those readings.

        Raises ValueError in one line for an unknown name, an invalid value, or readings that lack
        what the effect needs.
        """
        value, setting = self.effect.example(readings, self.strength)
        names = [parameter.name for parameter in self.effect.parameters]
        if any(name in names for name in self.given):
            value = np.zeros(len(names))
        for name, text in self.given.items():
            if name in names:
                value[names.index(name)] = _parse_number(text, name, self.effect)
            elif name in setting:
                setting = {**setting, name: _parse_setting(setting, name, text, self.effect)}
            else:
                known = ", ".join([*names, *setting])
                raise ValueError(f"{self.effect.identifier} has no {name}; it has {known}")
        column = setting.get("covariate")
        if column not in (None, *roles.SENSORS, *readings.covariates):
            there = ", ".join(readings.covariates)
            raise ValueError(f"{self.effect.identifier}: no column {column}; there is {there}")
        return Term(self.effect.identifier, value, np.zeros(len(names)), setting)


def parse_request(text: str, library: Mapping[str, Effect] = EFFECTS) -> Request:
    """Parse a request.  ValueError in one line."""
    identifier, _, rest = text.partition("=")
    if identifier not in library:
        close = difflib.get_close_matches(identifier, library, n=1)
        hint = f"; is {close[0]} meant?" if close else "; docs/reference/effects.md lists them"
        raise ValueError(f"no effect {identifier!r}{hint}")
    effect, strength = library[identifier], 1.0
    given: dict[str, str] = {}
    for position, part in enumerate(rest.split(",") if rest else []):
        name, equals, value = part.partition("=")
        if equals:
            given[name.strip()] = value
        elif position == 0:
            strength = _parse_number(part, "strength", effect)
        else:
            raise ValueError(f"{identifier}: {part!r} is neither a strength nor name=value")
    if strength < 0:
        raise ValueError(f"{identifier}: the strength {strength:g} is negative")
    return Request(effect, strength, given)


def _parse_setting(setting: Setting, name: str, text: str, effect: Effect) -> object:
    """Parse the text as the type that the setting has under this name."""
    present = setting[name]
    if isinstance(present, str):
        return text
    if isinstance(present, bool) or not isinstance(present, int | float):
        raise ValueError(f"{effect.identifier}: {name} cannot be given here")
    number = _parse_number(text, name, effect)
    return round(number) if isinstance(present, int) else number


def _parse_number(text: str, name: str, effect: Effect) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{effect.identifier}: {name} is {text!r}, a number is needed")
    return number


def columns_for(effects: Iterable[Effect], time_s: Array, seed: int) -> LoggedColumns:
    """The columns that the effects need, at the times (N,); the same seed gives the same columns.

    If one of several roles is enough, the first that is a column of its own is made.
    """
    needed_roles: dict[str, None] = {}
    for effect in effects:
        for need in effect.needs:
            made = [role for role in need.split("|") if role not in roles.SENSORS]
            needed_roles.update(dict.fromkeys(made[:1]))
    out: LoggedColumns = {}
    for role in needed_roles:
        number = list(roles.ROLES).index(role)
        out |= PROFILES[role](time_s - time_s[0], np.random.default_rng([seed, 11, number]))
    return out


def _random_levels(
    time_s: Array, rng: np.random.Generator, span: tuple[float, float], rounding_s: float
) -> Array:
    """Random levels within the span that hold for 10 to 40 s, with smooth transitions."""
    length = float(time_s[-1]) + 1.0
    starts = np.cumsum(rng.uniform(10.0, 40.0, int(length / 10.0) + 2))
    values = rng.uniform(*span, len(starts) + 1)
    out = values[np.searchsorted(starts, time_s, side="right")]
    for start, step in zip(starts, np.diff(values), strict=True):
        near = slice(
            *np.searchsorted(
                time_s, (start - _ROUNDING_REACH * rounding_s, start + _ROUNDING_REACH * rounding_s)
            )
        )
        apart = (time_s[near] - start) / rounding_s
        out[near] += step * (0.5 + 0.5 * np.tanh(apart) - (apart >= 0))
    return np.asarray(out)


def _current_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    return {"motor_current_a": _random_levels(time_s, rng, (0.5, 12.0), 0.4)}


def _temperature_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    return {"temperature_c": rng.uniform(12.0, 24.0) + 8.0 * (1 - np.exp(-time_s / 300.0))}


def _position_columns(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    """Along, across, along back; corners are rounded over about two seconds."""
    distance = _SPEED_M_S * time_s
    lap, along = np.divmod(distance, _LEG_M + _APART_M)
    there = np.minimum(along, _LEG_M)
    north = np.where(lap % 2 == 0, there, _LEG_M - there)
    east = _APART_M * lap + np.maximum(along - _LEG_M, 0.0)
    return {
        "position_north_m": _round_corners(north, time_s),
        "position_east_m": _round_corners(east, time_s),
        "position_down_m": _random_levels(time_s, rng, (4.0, 7.0), 5.0),
    }


def _round_corners(values: Array, time_s: Array) -> Array:
    rows = max(round(2.0 / float(np.median(np.diff(time_s)))), 1)
    padded = np.pad(values, (rows, rows), mode="reflect", reflect_type="odd")
    return np.convolve(padded, np.hanning(2 * rows + 3)[1:-1] / (rows + 1), mode="valid")


def _altitude_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    return {"altitude_m": _random_levels(time_s, rng, (2.0, 9.0), 4.0)}


def _angle_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    return {"rudder_angle_rad": _random_levels(time_s, rng, (-0.6, 0.6), 1.0)}


def _speed_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    return {"speed_m_s": _random_levels(time_s, rng, (0.2, 2.0), 3.0)}


def _rpm_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    return {"shaft_rpm": _random_levels(time_s, rng, (500.0, 1400.0), 1.0)}


def _ping_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    count = np.floor((time_s + rng.uniform(0, _PING_S)) / _PING_S)
    return {"sonar_ping": np.diff(count, prepend=count[0])}


def _switch_column(time_s: Array, rng: np.random.Generator) -> LoggedColumns:
    flips = np.cumsum(rng.uniform(10.0, 40.0, int(float(time_s[-1]) / 10.0) + 2))
    return {"lamp_on": np.searchsorted(flips, time_s).astype(np.float64) % 2}


PROFILES: Mapping[str, Callable[[Array, np.random.Generator], LoggedColumns]] = {
    "current": _current_column,
    "temperature": _temperature_column,
    "position": _position_columns,
    "altitude": _altitude_column,
    "angle": _angle_column,
    "speed": _speed_column,
    "rpm": _rpm_column,
    "ping": _ping_column,
    "switch": _switch_column,
}
