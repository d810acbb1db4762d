"""Order of commands, and the recipient of each answer."""

from __future__ import annotations

import numpy as np
import pytest
from cabled_units import sentence

from ahrsd.events import SendToClient
from ahrsd.sharing.arbiter import MOST_WAITING, PATIENCE_S, Arbiter, SharePolicy
from drivers.vn100.commands import Identity, NoReply, Read, Write
from drivers.vn100.errors import DeviceRefused
from drivers.vn100.messages import Reply
from drivers.vn100.registers import profile_of

IDENTITY = Identity("VN-100S-CR", 8, 100130608, "3.1.0.0", profile_of("3.1.0.0"))


@pytest.fixture
def arbiter():
    return Arbiter([SharePolicy("a", owner=True), SharePolicy("b")])


def ask(arbiter, client, *bodies, at_s=0.0, identity=IDENTITY):
    arbiter.receive(client, b"".join(map(sentence, bodies)), identity, at_s)


def sent_to_clients(arbiter):
    return [(one.client, one.data) for one in arbiter.take_answers()]


def test_identity_is_answered_from_memory_in_the_format_of_the_device(arbiter):
    ask(arbiter, "b", "VNRRG,01", "VNRRG,02", "VNRRG,03", "VNRRG,04")
    assert sent_to_clients(arbiter) == [
        ("b", b"$VNRRG,01,VN-100S-CR*35\r\n"),
        ("b", b"$VNRRG,02,8*65\r\n"),
        ("b", b"$VNRRG,03,0100130608*51\r\n"),
        ("b", b"$VNRRG,04,3.1.0.0*77\r\n"),
    ]
    assert arbiter.next_command(0.0) is None


def test_command_with_a_crc_in_pieces_is_recognised(arbiter):
    for piece in (b"$VNRR", b"G,01*E1", b"5F\r\n"):
        arbiter.receive("a", piece, IDENTITY, 0.0)
    assert sent_to_clients(arbiter) == [("a", b"$VNRRG,01,VN-100S-CR*35\r\n")]


def test_unknown_device_is_queried(arbiter):
    ask(arbiter, "a", "VNRRG,01", identity=None)
    assert sent_to_clients(arbiter) == []
    assert arbiter.next_command(0.0).asked.command == Read(1)


def test_one_command_at_a_time_and_each_answer_goes_to_its_client(arbiter):
    ask(arbiter, "a", "VNWRG,07,20", "VNRRG,23")
    ask(arbiter, "b", "VNRRG,23", "VNRRG,30")
    sent = []
    while arbiter.next_command(0.1) is not None:
        waiting = arbiter.start_next()
        assert arbiter.next_command(0.1) is None  # while one is on the wire
        command = waiting.asked.command
        sent.append((waiting.client, command))
        word = "VNWRG" if isinstance(command, Write) else "VNRRG"
        arbiter.finish_current(Reply(word, command.register, (str(len(sent)),)), None)
    assert sent == [("a", Write(7, (20,))), ("a", Read(23)), ("b", Read(23)), ("b", Read(30))]
    bodies = ["VNWRG,07,1", "VNRRG,23,2", "VNRRG,23,3", "VNRRG,30,4"]
    assert sent_to_clients(arbiter) == [
        (client, sentence(body)) for client, body in zip("aabb", bodies, strict=True)
    ]


def test_refusal_goes_to_the_client_and_silence_to_none(arbiter):
    ask(arbiter, "b", "VNRRG,74", "VNRRG,75")
    arbiter.start_next()
    arbiter.finish_current(None, DeviceRefused(8))
    arbiter.start_next()
    arbiter.finish_current(None, NoReply(Read(75)))
    assert sent_to_clients(arbiter) == [("b", b"$VNERR,08*79\r\n")]
    assert arbiter.counts["b", "unanswered"] == 1


def test_repeated_waiting_command_is_absorbed(arbiter):
    ask(arbiter, "a", "VNRRG,30")
    arbiter.start_next()
    for k in range(5):
        ask(arbiter, "a", "VNRRG,30", at_s=0.05 * k)
    assert arbiter.counts["a", "absorbed"] == 5
    arbiter.finish_current(Reply("VNRRG", 30, ("0",)), None)
    assert len(sent_to_clients(arbiter)) == 1
    ask(arbiter, "a", "VNRRG,30", at_s=0.3)  # answered: a new query
    assert arbiter.next_command(0.3) is not None


def test_baud_rate_is_emulated_per_client(arbiter):
    ask(arbiter, "b", "VNWRG,05,921600", "VNRRG,05")
    assert sent_to_clients(arbiter) == [
        ("b", sentence("VNWRG,05,921600")),
        ("b", sentence("VNRRG,05,921600")),
    ]
    ask(arbiter, "a", "VNRRG,05")
    assert arbiter.next_command(0.0).asked.command == Read(5)  # this client has set none


def test_output_is_paused_per_client(arbiter):
    ask(arbiter, "b", "VNASY,0", "VNASY,1")
    off, on = arbiter.take_answers()
    assert off == SendToClient("b", sentence("VNASY,0"), stream=False)
    assert on == SendToClient("b", sentence("VNASY,1"), stream=True)
    assert arbiter.next_command(0.0) is None


def test_command_that_waited_too_long_is_dropped_and_reported(arbiter):
    ask(arbiter, "a", "VNRRG,30", at_s=1.0)
    assert arbiter.deadline_s == 1.0 + PATIENCE_S
    assert arbiter.next_command(1.0 + PATIENCE_S) is None
    assert arbiter.take_notes() == ["a: read of register 30 got no turn in time"]
    assert arbiter.deadline_s is None


def test_client_that_left_gets_no_answer(arbiter):
    ask(arbiter, "a", "VNRRG,30", "VNRRG,07")
    arbiter.start_next()
    arbiter.receive("a", b"$VNRRG", IDENTITY, 0.0)
    arbiter.disconnect("a")
    arbiter.finish_current(Reply("VNRRG", 30, ("0",)), None)
    assert sent_to_clients(arbiter) == []
    assert arbiter.next_command(0.0) is None
    ask(arbiter, "a", "VNRRG,01")  # the next client starts with an empty line
    assert sent_to_clients(arbiter) == [("a", b"$VNRRG,01,VN-100S-CR*35\r\n")]


@pytest.mark.parametrize("garbage", [b"\x00" * 9000, b"$" * 9000, b"$VN" + b"A" * 9000])
def test_garbage_and_partial_commands_block_nobody(arbiter, garbage):
    for k in range(0, len(garbage), 100):
        arbiter.receive("a", garbage[k : k + 100], IDENTITY, 0.0)
    ask(arbiter, "b", "VNRRG,01")
    assert ("b", b"$VNRRG,01,VN-100S-CR*35\r\n") in sent_to_clients(arbiter)
    arbiter.receive("a", b"\r\n", IDENTITY, 0.0)
    ask(arbiter, "a", "VNRRG,04")
    assert ("a", b"$VNRRG,04,3.1.0.0*77\r\n") in sent_to_clients(arbiter)


def test_flood_is_bounded_and_the_other_client_is_next(arbiter):
    for k in range(200):
        ask(arbiter, "a", f"VNWRG,00,{k}")
    ask(arbiter, "b", "VNRRG,30")
    for _ in range(MOST_WAITING):
        assert arbiter.start_next().client == "a"
        arbiter.finish_current(None, None)
    assert arbiter.next_command(0.0).client == "b"
    assert arbiter.counts["a", "dropped"] == 200 - MOST_WAITING


def test_unknown_client_is_ignored(arbiter):
    ask(arbiter, "c", "VNRRG,01")
    arbiter.disconnect("c")
    assert sent_to_clients(arbiter) == []


@pytest.mark.parametrize("seed", range(20))
def test_answers_always_go_to_the_requesting_client(seed):
    """Two clients and a device that answers, refuses or is silent: no client gets another's
    answer.
    """
    rng = np.random.default_rng(seed)
    arbiter = Arbiter([SharePolicy("a", owner=True), SharePolicy("b", owner=True)])
    asked, now_s = {"a": set(), "b": set()}, 0.0
    for step in range(400):
        now_s += float(rng.exponential(0.05))
        client = "ab"[rng.integers(0, 2)]
        what = rng.integers(0, 5)
        if what < 2:
            tag = f"{client}{step}"
            asked[client].add(tag)
            ask(arbiter, client, f"VNWRG,00,{tag}", at_s=now_s)
        elif what == 2 and arbiter.next_command(now_s) is not None:
            arbiter.start_next()
        elif what == 3 and (way := arbiter.under_way) is not None:
            how = rng.integers(0, 3)
            reply = Reply("VNWRG", 0, tuple(map(str, way.asked.command.values)))
            arbiter.finish_current(*[(reply, None), (None, DeviceRefused(7)), (None, None)][how])
        elif rng.random() < 0.05:
            arbiter.disconnect(client)
            asked[client].clear()
        for one in arbiter.take_answers():
            text = one.data.decode()
            mine = asked[one.client]
            assert text.startswith("$VNERR") or text.split(",")[2].split("*")[0] in mine
