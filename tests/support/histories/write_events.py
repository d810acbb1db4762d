"""What may happen to a daemon while it writes: one function an event, for campaign and histories.

Each takes the world and dice and does its thing now; what follows later it asks the world for.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scripted_vn100 import Iron, Unit
from scripted_vn100.memory import printed
from scripted_world import World

Dice = np.random.Generator
Act = Callable[[World, Dice], None]
ORIGIN_SERIAL = 100130608
_TRUE_WALL_AHEAD_S = 1.7e9


def random_iron(draw: Dice) -> Iron:
    """A hard iron and a gyro bias that no other unit of the same history has."""
    hard = draw.uniform(-0.07, 0.07, 3)
    return Iron(hard_gauss=hard, gyro_bias_rad_s=draw.uniform(-0.02, 0.02, 3))


def users_values(draw: Dice) -> dict[int, str]:
    """Registers 23 and 84 as a user may have saved them."""
    hard = ",".join(printed(v) for v in draw.uniform(-0.1, 0.1, 3))
    bias = ",".join(printed(v) for v in draw.uniform(-0.01, 0.01, 3))
    return {23: f"1,0,0,0,1,0,0,0,1,{hard}", 84: f"1,0,0,0,1,0,0,0,1,{bias}"}


def another_unit(world: World, draw: Dice) -> Unit:
    """A spare with the same output, its own iron, and its time ahead of or behind the present."""
    here = world.unit
    outputs = {n: here.memory.flash[n] for n in (6, 7, 75)}
    values = users_values(draw) if draw.random() < 0.5 else {}
    ahead_s = float(draw.choice([0.4, 3.0, 3600.0, -2.0]))
    boot_s = min(here.boot_s - ahead_s, world.now_s)
    return Unit(
        555 + len(world.cable.units), random_iron(draw), here.vehicle, boot_s=boot_s,
        presets={**outputs, **values},
    )  # fmt: skip


def swap(world: World, draw: Dice, silent_s: float | None = None) -> None:
    """A spare takes over the cable; no hand and no switch is faster than a tenth of a second."""
    silent_s = float(draw.choice([0.1, 0.3, 2.0])) if silent_s is None else silent_s
    world.cable.exchange(another_unit(world, draw), world.now_s, silent_s=silent_s)


def swap_and_back(world: World, draw: Dice) -> None:
    """And the first one comes back a while later."""
    first = world.unit
    swap(world, draw)

    def back() -> None:
        world.cable.exchange(first, world.now_s, silent_s=0.2)

    world.later(float(draw.uniform(0.5, 6.0)), back)


def restart(world: World, draw: Dice) -> None:
    """The unit loses power for a moment or for a while."""
    world.unit.restart(world.now_s, off_s=float(draw.choice([0.0, 0.1, 1.5])))


def silence(world: World, draw: Dice) -> None:
    """The unit says nothing for a while."""
    world.unit.silent_until_s = world.now_s + float(draw.choice([0.5, 2.5, 5.0]))


def other_writes(world: World, draw: Dice) -> None:
    """A second master writes register 23 or 84, or both."""
    values = users_values(draw)
    for number in ((23,), (84,), (23, 84))[int(draw.integers(3))]:
        world.cable.other_master(f"VNWRG,{number},{values[number]}", world.now_s)


def other_writes_and_saves(world: World, draw: Dice) -> None:
    """And saves."""
    other_writes(world, draw)
    world.cable.other_master("VNWNV", world.now_s)


def other_saves(world: World, draw: Dice) -> None:
    """A second master saves whatever is in RAM."""
    world.cable.other_master("VNWNV", world.now_s)


def other_resets(world: World, draw: Dice) -> None:
    """A second master restarts the unit."""
    world.cable.other_master("VNRST", world.now_s)


def iron(world: World, draw: Dice) -> None:
    """Iron comes to the vehicle or goes: 40 to 90 mG."""
    way = draw.standard_normal(3)
    size = float(draw.uniform(0.04, 0.09))
    world.cable.unit.vehicle.move_iron(size * way / np.linalg.norm(way), world.now_s)


def iron_for_a_while(world: World, draw: Dice) -> None:
    """And goes again."""
    way = draw.standard_normal(3)
    by = float(draw.uniform(0.04, 0.09)) * way / np.linalg.norm(way)
    vehicle = world.cable.unit.vehicle
    vehicle.move_iron(by, world.now_s)
    world.later(float(draw.uniform(2.0, 8.0)), lambda: vehicle.move_iron(-by, world.now_s))


def unsafe_for_a_while(world: World, draw: Dice) -> None:
    """The vehicle says no; later yes again."""

    def yes() -> None:
        world.safe = True

    world.safe = False if draw.random() < 0.7 else None
    world.later(float(draw.uniform(0.5, 8.0)), yes)


def iron_while_unsafe(world: World, draw: Dice) -> None:
    """The iron changes while the vehicle is not safe, and then it is."""
    unsafe_for_a_while(world, draw)
    world.later(float(draw.uniform(0.1, 2.0)), lambda: iron(world, draw))


def clock(world: World, draw: Dice) -> None:
    """The wall clock is set: to the truth, an hour, a second, or years."""
    clocks = world.clocks
    by_s = float(draw.choice([3600.0, -3600.0, 5.0, -5.0, 1e8, -1e8]))
    clocks.wall_ahead_s = _TRUE_WALL_AHEAD_S if draw.random() < 0.4 else clocks.wall_ahead_s + by_s


def kill(world: World, draw: Dice) -> None:
    """kill -9, and the program is started again soon."""
    if world.core is None:
        return
    if draw.random() < 0.5:
        world.later(0.01, lambda: clock(world, draw))
    world.later(float(draw.choice([0.05, 1.0, 4.0])), world.start)
    world.kill()


def kill_and_time_is_set(world: World, draw: Dice) -> None:
    """Between the two runs the wall clock is set to the truth."""
    if world.core is None:
        return
    world.clocks.wall_ahead_s = _TRUE_WALL_AHEAD_S
    world.later(float(draw.choice([0.05, 1.0])), world.start)
    world.kill()


def kill_and_swap(world: World, draw: Dice) -> None:
    """Between the two runs another unit is put on the cable."""
    if world.core is None:
        return
    world.later(0.2, lambda: swap(world, draw))
    world.later(0.6, world.start)
    world.kill()


def kill_and_other_writes(world: World, draw: Dice) -> None:
    """Between the two runs somebody writes and saves values of his own."""
    if world.core is None:
        return
    world.later(0.2, lambda: other_writes_and_saves(world, draw))
    if draw.random() < 0.5:
        world.later(0.3, lambda: world.unit.restart(world.now_s))
    world.later(3.0, world.start)
    world.kill()


def host_reboots(world: World, draw: Dice) -> None:
    """The computer loses power, with or without the unit; its clocks begin anew."""
    if world.core is None:
        return

    def up() -> None:
        world.clocks.reboot(world.now_s)
        if draw.random() < 0.5:  # no battery clock: 1970 until the time is known
            world.clocks.wall_ahead_s = 20.0 - world.now_s
            world.later(float(draw.uniform(0.5, 4.0)), lambda: clock(world, draw))
        world.start()

    if draw.random() < 0.5:
        world.unit.restart(world.now_s, off_s=1.0)
    world.later(1.2, up)
    world.kill()


def stop_and_start(world: World, draw: Dice) -> None:
    """SIGTERM, and the program is started again."""

    def stop() -> None:
        world.stop()
        world.later(0.3, world.start)

    if world.core is not None:
        world.later(0.001, stop)  # a signal comes between two inputs


def disk_full_for_a_while(world: World, draw: Dice) -> None:
    """The journal cannot be written; later it can."""

    def room() -> None:
        world.disk_full = False

    world.disk_full = True
    world.later(float(draw.uniform(0.3, 4.0)), room)


def journal_lost(world: World, draw: Dice) -> None:
    """The program is killed, its journal is removed or emptied, it starts again."""
    if world.core is None:
        return
    empty = draw.random() < 0.5

    def lose() -> None:
        for path in world.folder.glob("journal-*.jsonl"):
            path.unlink()
            if empty:
                path.touch()

    world.later(0.05, lose)
    world.later(0.2, world.start)
    world.kill()


def person(world: World, draw: Dice) -> None:
    """Somebody says something."""
    verb = str(draw.choice(["rollback", "lock", "unlock", "arm", "disarm"]))
    world.later(0.001, lambda: world.operate(verb, "because"))


def lie(world: World, draw: Dice) -> None:
    """From now on the unit does other than it says, for a while or for good."""
    lies = world.unit.lies
    what = int(draw.integers(5))
    if what == 0:
        lies.not_held = {int(draw.choice([23, 84]))}
    elif what == 1:
        lies.not_held, lies.reads_told = {23, 84}, True
    elif what == 2:
        lies.not_saved = True
    elif what == 3:
        lies.half_saved = True
    else:
        lies.refuse = {int(draw.choice([23, 84])): int(draw.choice([3, 5, 7, 12]))}

    def honest() -> None:
        lies.not_held, lies.refuse = set(), {}
        lies.reads_told = lies.not_saved = lies.half_saved = False

    if draw.random() < 0.5:
        world.later(float(draw.uniform(0.5, 5.0)), honest)


def bad_line(world: World, draw: Dice) -> None:
    """Replies are lost, doubled and late from now on."""
    faults = world.cable.faults
    faults.draw = np.random.default_rng(int(draw.integers(2**31)))
    faults.lost, faults.doubled, faults.late = (float(v) for v in draw.uniform(0.0, 0.12, 3))


def client_saves(world: World, draw: Dice) -> None:
    """The vehicle's driver, on its shared port, saves all of RAM."""
    world.later(0.001, lambda: world.say("VNWNV"))


def client_saves_again(world: World, draw: Dice) -> None:
    """And once more a while later."""
    client_saves(world, draw)
    world.later(float(draw.uniform(0.2, 6.0)), lambda: world.say("VNWNV"))


def client_saves_and_resets(world: World, draw: Dice) -> None:
    """As one driver does at every start."""
    client_saves(world, draw)
    world.later(float(draw.choice([0.1, 1.0, 3.0])), lambda: world.say("VNRST"))


def client_sets_and_saves(world: World, draw: Dice) -> None:
    """A setting of its own that is to last."""
    rate = int(draw.choice([5, 10, 20]))
    world.later(0.001, lambda: world.say(f"VNWRG,07,{rate}"))
    world.later(0.05, lambda: world.say("VNWNV"))


def client_calibrates(world: World, draw: Dice) -> None:
    """The driver writes what calibrates, as its share allows; half the time it saves then."""
    values = users_values(draw)
    for k, number in enumerate(((23,), (84,), (23, 84))[int(draw.integers(3))]):
        line = f"VNWRG,{number},{values[number]}"
        world.later(0.001 + 0.2 * k, lambda line=line: world.say(line))
    if draw.random() < 0.5:
        world.later(float(draw.uniform(0.3, 2.0)), lambda: world.say("VNWNV"))


CLIENT_EVENTS: dict[str, Act] = {
    "client saves": client_saves,
    "client saves again": client_saves_again,
    "client saves and resets": client_saves_and_resets,
    "client sets and saves": client_sets_and_saves,
    "client calibrates": client_calibrates,
}
EVENTS: dict[str, tuple[Act, float]] = {
    "swap": (swap, 3.0),
    "swap and back": (swap_and_back, 1.5),
    "restart": (restart, 2.0),
    "silence": (silence, 0.7),
    "other writes": (other_writes, 2.0),
    "other writes and saves": (other_writes_and_saves, 1.0),
    "other saves": (other_saves, 0.7),
    "other resets": (other_resets, 0.7),
    "iron": (iron, 2.0),
    "iron for a while": (iron_for_a_while, 0.7),
    "iron while unsafe": (iron_while_unsafe, 1.5),
    "unsafe for a while": (unsafe_for_a_while, 1.5),
    "clock": (clock, 1.5),
    "kill": (kill, 2.0),
    "kill and time is set": (kill_and_time_is_set, 1.0),
    "kill and swap": (kill_and_swap, 1.0),
    "kill and other writes": (kill_and_other_writes, 1.0),
    "host reboots": (host_reboots, 2.0),
    "stop and start": (stop_and_start, 0.7),
    "disk full": (disk_full_for_a_while, 0.7),
    "journal lost": (journal_lost, 0.5),
    "person": (person, 0.7),
    "lie": (lie, 1.5),
    "bad line": (bad_line, 1.0),
}
