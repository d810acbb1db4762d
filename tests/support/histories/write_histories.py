"""Random histories of a daemon that writes, in virtual time, and every event at every moment.

A history: one unit, a vehicle that rests and turns by turns, a daemon that calibrates it, writes,
tries, saves; meanwhile one to five of `write_events`, each at a random time or at a random moment
(before or after a command or a record of the journal). At the end the unit is switched off and on
with the daemon there, so that a record CONFIRMED comes where one can. What is counted and what must
be 0 is said in `write_observer`; besides, no exception may leave the core and no history may spin.
"""

from __future__ import annotations

import datetime
import shutil
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scripted_vn100 import Cable, Iron, Motion, Unit, Vehicle
from scripted_world import POLICY, HostClocks, World
from write_events import (
    CLIENT_EVENTS,
    EVENTS,
    ORIGIN_SERIAL,
    Act,
    random_iron,
    users_values,
)
from write_observer import KINDS

from ahrsd.config.config import Config
from ahrsd.config.sections import LocationSection
from ahrsd.writeback.policy import StillPolicy
from ahrsd.writeback.trial import TrialPolicy

MOTION = Motion(rest_s=2.5, turn_s=3.5)
LENGTH_S, LONG_S = 15.0, 28.0
RESTART_S, END_S = 2.0, 5.0  # behind it: the last restart, later than any save's window; the end
REAL_MOTION, REAL_BEGIN_S, REAL_S = Motion(6.0, 20.0, 0.6), 60.0, 370.0
REAL_SOFT_IRON = np.array([[1.06, 0.02, 0.0], [0.02, 0.97, 0.01], [0.0, 0.01, 0.98]])
MOST_STEPS = 20_000
WRONG = (*KINDS, "exceptions", "spins")
OUTPUT = {
    "binary": {6: "0", 7: "5", 75: "1,160,06,0001,083F"},
    "imu": {6: "19", 7: "5"},
    "ymr": {6: "14", 7: "5"},
}
NAMES = tuple(EVENTS)
_WEIGHTS = np.array([weight for _, weight in EVENTS.values()])
_LABELS = (
    "VNWRG,23", "VNWRG,84", "VNRRG,23", "VNRRG,84", "VNRRG,3", "VNWNV", "VNASY,0", "VNASY,1",
    "PREPARED", "RAM_VERIFIED", "PROVEN", "FLASH_SENT", "FLASH_ACKED", "ROLLBACK", "ROLLED_BACK",
)  # fmt: skip


@dataclass
class HistoriesTally:
    """Counts add up; `wrong` says seed, number and what of each violation."""

    histories: int = 0
    virtual_s: float = 0.0
    events: Counter[str] = field(default_factory=Counter)
    seen: Counter[str] = field(default_factory=Counter)  # records, writes, saves, candidates
    violations: Counter[str] = field(default_factory=Counter)
    ends: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)


class Spins(AssertionError):
    """Virtual time hardly moves on."""


@contextmanager
def folder() -> Iterator[Path]:
    """A state directory, in memory where the machine has such a place."""
    memory = Path("/dev/shm")
    made = Path(tempfile.mkdtemp(dir=memory if memory.is_dir() else None, prefix="history-"))
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


def make_world(
    at: Path, draw: np.random.Generator, *, stream: str, policy: Any = POLICY, users: bool = False
) -> World:
    """A unit that streams, and a daemon's surroundings."""
    vehicle = Vehicle(MOTION, seed=int(draw.integers(3)))
    presets = {**OUTPUT[stream], **(users_values(draw) if users else {})}
    boot_s = -float(draw.choice([0.0, 20.0, 5000.0]))
    unit = Unit(ORIGIN_SERIAL, random_iron(draw), vehicle, boot_s=boot_s, presets=presets)
    return World(Cable(unit), at, policy)


def random_world(at: Path, draw: np.random.Generator) -> World:
    """Another stream, another policy and other clocks each time."""
    stream = str(draw.choice(["binary", "imu", "ymr"], p=[0.6, 0.3, 0.1]))
    policy, by_hand = POLICY, draw.random() < 0.4
    if by_hand:
        policy = replace(policy, approval="operator", armed_at_start=False, commit_unattended=False)
    if draw.random() < 0.25:
        policy = replace(policy, serial=ORIGIN_SERIAL)
    if draw.random() < 0.15:
        policy = replace(policy, keep_on_stop=True)
    world = make_world(at, draw, stream=stream, policy=policy, users=bool(draw.random() < 0.4))
    world.operator = float(draw.uniform(0.05, 1.5)) if by_hand else None
    wall = float(draw.choice([1.7e9, 1.7e9 - 3600.0, 320.0]))  # true, an hour behind, 1970
    world.clocks = HostClocks(wall_ahead_s=wall)
    return world


def plan(
    world: World, draw: np.random.Generator, tally: HistoriesTally, from_s: float = 1.0,
    length_s: float = LENGTH_S,
) -> list[str]:  # fmt: skip
    """Draw events and when they come; their names."""
    names = [str(n) for n in draw.choice(NAMES, size=1 + int(draw.integers(5)), p=_shares())]
    for name in names:
        act = EVENTS[name][0]

        def now(act: Act = act) -> None:
            act(world, draw)

        how = draw.random()
        if how < 0.4:
            world.at(float(draw.uniform(from_s, length_s)), now)
        elif how < 0.6:
            world.at_moment(int(draw.integers(0, 180)), now)
        else:
            where = f"{draw.choice(['before', 'after'])} {draw.choice(_LABELS)}"
            world.at_label(where, now, 1 + int(draw.integers(2)))
        tally.events[name] += 1
    return names


def _shares() -> np.ndarray:
    return np.asarray(_WEIGHTS / _WEIGHTS.sum())


def carry_out(world: World, length_s: float = LENGTH_S) -> None:
    """The whole history; raises what leaves the core, and Spins."""
    steps = 0

    def spins() -> bool:
        nonlocal steps
        steps += 1
        if steps > MOST_STEPS * max(1.0, length_s / LONG_S):
            raise Spins(f"{steps} steps until {world.now_s:.2f} s")
        return False

    world.start()
    world.run(length_s, spins)
    if world.core is None:
        world.start()
    world.safe, world.disk_full = True, False
    world.run(length_s + RESTART_S, spins)
    world.unit.restart(world.now_s)
    world.run(length_s + END_S, spins)


def judge(world: World, where: str, tally: HistoriesTally, error: Exception | None) -> None:
    """Add what was seen to the tally."""
    observer = world.observer
    for kind, text in observer.violations:
        tally.violations[kind] += 1
        tally.wrong.append(f"{where}: {text}")
    if error is not None:
        kind = "spins" if isinstance(error, Spins) else "exceptions"
        tally.violations[kind] += 1
        last = traceback.extract_tb(error.__traceback__)[-1]
        tally.wrong.append(
            f"{where}: {kind}: {error!r} at {Path(last.filename).name}:{last.lineno}"
        )
    tally.histories += 1
    tally.virtual_s += world.now_s
    tally.seen.update({k: n for k, n in observer.counts.items() if k not in KINDS})
    tally.ends["" if world.core is None else world.core.writeback.state.value] += 1


def attempt(world: World, length_s: float = LENGTH_S) -> Exception | None:
    """Carry it out; what it raised, as a finding."""
    try:
        carry_out(world, length_s)
    except Exception as error:  # noqa: BLE001 - whatever leaves the core is what is looked for
        return error
    return None


def run_one(number: int, seed: int, tally: HistoriesTally) -> World:
    """The `number`-th history of this seed."""
    draw = np.random.default_rng([seed, number])
    with folder() as at:
        world = random_world(at, draw)
        names = plan(world, draw, tally)
        error = attempt(world)
        judge(world, f"history {number} of seed {seed} ({', '.join(names)})", tally, error)
    return world


def run_with_client(number: int, seed: int, tally: HistoriesTally) -> World:
    """The same with a driver on the owner's port that saves, mostly in the middle of a trial."""
    draw = np.random.default_rng([seed, number, 2])
    with folder() as at:
        world = random_world(at, draw)
        names = plan(world, draw, tally, length_s=LONG_S) if draw.random() < 0.7 else []
        for _ in range(1 + int(draw.integers(3))):
            name = str(draw.choice(list(CLIENT_EVENTS)))
            names.append(name)
            _client_comes(world, draw, CLIENT_EVENTS[name])
            tally.events[name] += 1
        error = attempt(world, LONG_S)
        judge(world, f"client history {number} of seed {seed} ({', '.join(names)})", tally, error)
    return world


def _client_comes(world: World, draw: np.random.Generator, act: Act) -> None:
    def now() -> None:
        world.later(float(draw.uniform(0.0, 2.2)), lambda: act(world, draw))

    if draw.random() < 0.3:
        world.at(float(draw.uniform(1.0, LONG_S)), now)
    else:
        label = str(draw.choice(["PREPARED", "RAM_VERIFIED", "PROVEN", "ROLLED_BACK"]))
        world.at_label(f"after {label}", now, 1 + int(draw.integers(3)))


ASIDE_FOR = (("VNWNV",), ("VNWNV", "VNRST"), ("VNRST",))
ASIDE_MOMENTS = (
    240  # not of seven; from the record of the rollback to the second RAM_VERIFIED, and some more
)


def aside_moments() -> int:
    """How many there are of `run_aside`."""
    return len(ASIDE_FOR) * (len(NAMES) + len(CLIENT_EVENTS)) * ASIDE_MOMENTS


def run_aside(number: int, seed: int, tally: HistoriesTally) -> World:
    """A client saves, resets or does both in a trial, and an event at one moment of what follows.

    The first numbers are spread over all moments: the moments go on in steps of seven.
    """
    acts = {**{name: act for name, (act, _) in EVENTS.items()}, **CLIENT_EVENTS}
    rest, does = divmod(number, len(ASIDE_FOR))
    turn, event = divmod(rest, len(acts))
    after, lines = 7 * turn % ASIDE_MOMENTS, ASIDE_FOR[does]
    name, draw = list(acts)[event], np.random.default_rng([seed, number, 3])
    with folder() as at:
        stream = STREAMS[number % 2]
        world = make_world(at, draw, stream=stream, users=bool(draw.random() < 0.5))
        world.clocks.wall_ahead_s = WALLS_S[number % len(WALLS_S)]

        def begin() -> None:
            where = len(world.moments) + after
            world.at_moment(where, lambda: acts[name](world, draw))

        for line in lines:
            world.at_label("after RAM_VERIFIED", lambda say=line: _says_later(world, say))
        world.at_label("before ROLLBACK", begin)
        error = attempt(world, LONG_S)
        where = f"{name} {after} moments on, for {' and '.join(lines)}"
        judge(world, f"{where}, seed {seed}, number {number}", tally, error)
        tally.events[name] += 1
    return world


def _says_later(world: World, line: str) -> None:
    world.later(0.7, lambda: world.say(line))


def run_at(
    event: str, label: str, tally: HistoriesTally, *, stream: str = "binary", seed: int = 0,
    occurrence: int = 1, policy: Any = POLICY, wall_s: float = 1.7e9,
) -> World:  # fmt: skip
    """One event at one moment of an ordinary history; every other seed has a factory's unit."""
    draw = np.random.default_rng([seed, len(event), len(label)])
    with folder() as at:
        world = make_world(at, draw, stream=stream, policy=policy, users=bool(seed % 2))
        world.clocks.wall_ahead_s = wall_s
        world.at_label(label, lambda: EVENTS[event][0](world, draw), occurrence)
        error = attempt(world, LONG_S)
        judge(world, f"{event} {label} ({stream}, seed {seed})", tally, error)
        tally.events[event] += 1
    return world


def run_real(number: int, seed: int, tally: HistoriesTally) -> World:
    """A history with the estimator and the gates as they come: six minutes, soft iron, a location.

    An operator approves; the trial and the rest are as in a run but for their length.
    """
    draw = np.random.default_rng([seed, number, 1])
    soft = REAL_SOFT_IRON / np.cbrt(np.linalg.det(REAL_SOFT_IRON))
    policy = replace(
        POLICY, approval="operator", armed_at_start=False, commit_unattended=False,
        trial=TrialPolicy(duration_s=20.0, turns=100.0), still=StillPolicy(),
    )  # fmt: skip
    presets = {7: "40", **({6: "19"} if number % 3 == 2 else {6: "0", 75: "1,20,06,0001,083F"})}
    iron = Iron(soft, random_iron(draw).hard_gauss, random_iron(draw).gyro_bias_rad_s)
    unit = Unit(ORIGIN_SERIAL, iron, Vehicle(REAL_MOTION), boot_s=-20.0, presets=presets)
    place = LocationSection(latitude_deg=48.0, longitude_deg=11.0, date=datetime.date(2026, 6, 1))
    with folder() as at:
        clocks = HostClocks(wall_ahead_s=float(draw.choice(WALLS_S)))
        world = World(Cable(unit), at, policy, clocks, Config(location=place))
        world.operator = 0.5
        names = plan(world, draw, tally, REAL_BEGIN_S, REAL_S)
        error = attempt(world, REAL_S)
        judge(world, f"real history {number} of seed {seed} ({', '.join(names)})", tally, error)
    return world


STREAMS = ("binary", "imu")
WALLS_S = (1.7e9, 320.0, 1.7e9 - 3600.0)  # true, 1970, an hour behind
PLACES = tuple(
    (f"{side} {label}", occurrence)
    for label, most in (
        ("VNRRG,3", 2), ("VNRRG,23", 6), ("VNRRG,84", 5), ("VNASY,0", 3), ("VNASY,1", 3),
        ("VNWRG,23", 1), ("VNWRG,84", 1), ("VNWNV", 1), ("PREPARED", 1), ("RAM_VERIFIED", 1),
        ("PROVEN", 1), ("FLASH_SENT", 1), ("FLASH_ACKED", 1),
    )
    for occurrence in range(1, most + 1)
    for side in ("before", "after")
)  # fmt: skip


def moments() -> int:
    """How many there are of `run_moment`."""
    return len(NAMES) * len(PLACES) * len(STREAMS)


def run_moment(number: int, seed: int, tally: HistoriesTally) -> World:
    """Event, place and stream by number; the host's clock is another one each time."""
    rest, event = divmod(number, len(NAMES))
    stream, place = divmod(rest, len(PLACES))
    label, occurrence = PLACES[place]
    return run_at(
        NAMES[event], label, tally, stream=STREAMS[stream % len(STREAMS)], seed=seed + number,
        occurrence=occurrence, wall_s=WALLS_S[number % len(WALLS_S)],
    )  # fmt: skip
