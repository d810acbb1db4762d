"""Properties of the state table: no dead end, no way around the rollback, and agreement with the
docs.
"""

from pathlib import Path

import pytest

from ahrsd.writeback.journal_history import RecordKind
from ahrsd.writeback.reconcile import TABLE as RECONCILE
from ahrsd.writeback.reconcile import DeviceContents
from ahrsd.writeback.states import (
    CHANGED_IN_RAM,
    ON_TIMEOUT,
    TABLE,
    WITHOUT_TRANSACTION,
    Signal,
    State,
)

AWAY = {Signal.LINK_LOST, Signal.DEVICE_RESET, Signal.CLIENT_RESET, Signal.IN_DOUBT}
DOCUMENT = Path(__file__).parents[2] / "docs" / "design" / "write-back.md"

# States that only a person, the device or a verdict ends, and that may last for ever.
RESTING = {
    State.OBSERVING,
    State.CANDIDATE,
    State.COMMITTED,
    State.CONFIRMED,
    State.ROLLED_BACK,
    State.FAULT,
    State.FLASH_TORN,
    State.LOCKED,
}


def reachable(start: State, without: frozenset[State] = frozenset()) -> set[State]:
    seen, queue = {start}, [start]
    while queue:
        for target in TABLE[queue.pop()].values():
            if target not in seen and target not in without:
                seen.add(target)
                queue.append(target)
    return seen


def test_table_is_total_over_states_and_signals() -> None:
    assert set(TABLE) == set(State)
    assert {target for row in TABLE.values() for target in row.values()} <= set(State)
    used = {signal for row in TABLE.values() for signal in row}
    assert used == set(Signal)


def test_every_state_is_reachable_and_can_be_left() -> None:
    assert reachable(State.RECONCILING) == set(State)
    for state in State:
        assert State.OBSERVING in reachable(state)


def test_every_waiting_state_has_a_timeout() -> None:
    assert set(ON_TIMEOUT) == set(State) - RESTING
    for state, (seconds, target) in ON_TIMEOUT.items():
        assert TABLE[state][Signal.TIMEOUT] is target
        assert 0.0 < seconds <= 600.0


@pytest.mark.parametrize("state", State)
def test_link_loss_reset_and_doubt_always_lead_to_reconciling(state: State) -> None:
    assert TABLE[state][Signal.LINK_LOST] is State.RECONCILING
    assert TABLE[state][Signal.DEVICE_RESET] is State.RECONCILING
    assert TABLE[state][Signal.CLIENT_RESET] is State.RECONCILING
    assert TABLE[state][Signal.IN_DOUBT] is State.RECONCILING


@pytest.mark.parametrize("state", [State.STAGING, State.STAGED, State.TRIAL, State.PROVEN])
def test_changed_ram_is_always_undone_or_saved(state: State) -> None:
    """RECONCILING and FAULT end with a comparison with the device; ROLLING_BACK undoes."""
    ways_out = frozenset({State.RECONCILING, State.FAULT, State.ROLLING_BACK, State.SAVING})
    assert not reachable(state, without=ways_out) & (WITHOUT_TRANSACTION | {State.LOCKED})


def test_reconciling_never_leads_directly_to_a_write() -> None:
    assert not {State.PREPARING, State.CHECKING, State.STAGING, State.SAVING} & set(
        TABLE[State.RECONCILING].values()
    )


def test_only_an_approval_starts_a_transaction() -> None:
    into = {
        (state, signal)
        for state, row in TABLE.items()
        for signal, target in row.items()
        if target is State.PREPARING
    }
    assert into == {(State.QUALIFIED, Signal.APPROVED), (State.SET_ASIDE, Signal.GO_ON)}
    # a transaction that was set aside had one, for values that the device held and that were undone
    aside = {s for s, row in TABLE.items() if State.SET_ASIDE in row.values()}
    assert aside == {State.ROLLING_BACK, State.RECONCILING}  # the second: after a client's reset


@pytest.mark.parametrize("state", [State.FAULT, State.FLASH_TORN, State.LOCKED])
def test_only_a_person_or_the_device_ends_an_alarm_state(state: State) -> None:
    assert set(TABLE[state]) - AWAY <= {Signal.ROLL_BACK, Signal.UNLOCK}


def test_saving_is_reached_only_from_proven_through_the_journal() -> None:
    into = {state for state, row in TABLE.items() if State.SAVING in row.values()}
    assert into == {State.SAVE_PREPARING}
    assert {s for s, row in TABLE.items() if State.SAVE_PREPARING in row.values()} == {State.PROVEN}
    assert TABLE[State.SAVE_PREPARING][Signal.JOURNALLED] is State.SAVING


def test_every_state_with_changed_ram_can_roll_back_or_is_rolling_back() -> None:
    for state in CHANGED_IN_RAM - {State.ROLLING_BACK, State.SAVING}:
        assert TABLE[state][Signal.ROLL_BACK] is State.ROLLING_BACK


def mermaid() -> str:
    """The table as a Mermaid state diagram; signals between one pair of states share an edge."""
    lines = ["stateDiagram-v2", "    [*] --> RECONCILING"]
    for state, row in TABLE.items():
        edges: dict[State, list[str]] = {}
        for signal, target in row.items():
            if signal not in AWAY:
                edges.setdefault(target, []).append(signal.value)
        for target, signals in edges.items():
            lines.append(f"    {state.value} --> {target.value}: {', '.join(signals)}")
    return "\n".join(lines)


def test_document_shows_this_table() -> None:
    assert f"```mermaid\n{mermaid()}\n```" in DOCUMENT.read_text()


@pytest.mark.parametrize("state", ON_TIMEOUT)
def test_document_shows_every_timeout(state: State) -> None:
    seconds, target = ON_TIMEOUT[state]
    assert f"| {state.value} | {seconds:.0f} s | {target.value} |\n" in DOCUMENT.read_text()


@pytest.mark.parametrize("last", RECONCILE)
def test_document_shows_the_reconciliation_table(last: RecordKind) -> None:
    cells = [
        f"`{row.record.value}`, {row.signal.value}" if row.record else row.signal.value
        for row in (RECONCILE[last][held] for held in DeviceContents)
    ]
    assert f"| `{last.value}` | {' | '.join(cells)} |\n" in DOCUMENT.read_text()


@pytest.mark.parametrize("kind", RecordKind)
def test_document_explains_every_journal_record(kind: RecordKind) -> None:
    rows = [line for line in DOCUMENT.read_text().splitlines() if line.startswith("| `")]
    assert any(f"`{kind.value}`" in row.split("|")[1] for row in rows)
