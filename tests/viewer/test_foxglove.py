"""`ahrsd foxglove`: records of the socket as topics, and the process as a Foxglove finds it."""

from __future__ import annotations

import base64
import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import closing

import numpy as np
import pytest
from cabled_run import IRON, estimate
from click.testing import CliRunner
from patience import PATIENCE_S
from websockets.sync.client import connect

from ahrsd import events
from ahrsd.__main__ import group
from ahrsd.errors import EXIT_BUSY, DeviceError
from ahrsd.telemetry.unix_socket import SocketServer
from ahrsd.viewer.foxglove import CLOUDS, SCHEMAS, Topics

SAMPLES = {
    "record": "samples",
    "seq": 7,
    "host_s": [100.0, 100.005],
    "raw_b_gauss": [[0.3, 0.0, 0.4], [None, 0.1, 0.2]],
    "corrected_b_gauss": [[0.2, 0.0, 0.0], [0.2, 0.001, 0.0]],
    "gyro_b_rad_s": [[0.01, 0.02, 0.03], [0.0, 0.0, 0.0]],
}
ESTIMATE = {
    "record": "estimate",
    "host_s": 101.0,
    "hard_iron_gauss": [0.01, 0.02, 0.03],
    "gyro_bias_rad_s": [1e-3, 2e-3, 3e-3],
    "standard_deviation": [*[9.0] * 6, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
    "heading_sigma_deg": 0.7,
    "converged": True,
}


def test_samples_have_their_wall_clock_time():
    said = Topics(wall_offset_s=1e9).of(SAMPLES, 100.1)
    raw = [one for one in said if one.topic == "/magnetometer/raw"]
    assert [one.unix_ns for one in raw] == [1_000_000_100_000_000_000, 1_000_000_100_005_000_000]
    assert raw[0].content == {"x": 0.3, "y": 0.0, "z": 0.4, "norm": pytest.approx(0.5)}
    assert raw[1].content == {"x": None, "y": 0.1, "z": 0.2, "norm": None}
    rates = [one.content for one in said if one.topic == "/angular_rate"]
    assert rates[0] == {"x": 0.01, "y": 0.02, "z": 0.03}


def test_point_cloud_has_all_directions_and_does_not_grow_at_rest():
    topics, clouds = Topics(0.0), []
    rng = np.random.default_rng(3)
    for k in range(300):
        at_s = 0.1 * k
        vector = [0.5, 0.0, 1e-3 * float(rng.normal())]
        record = {**SAMPLES, "host_s": [at_s]}
        record |= {"raw_b_gauss": [vector], "corrected_b_gauss": [vector], "gyro_b_rad_s": [vector]}
        clouds += [one for one in topics.of(record, at_s) if one.topic == "/field/raw"]
    assert len(clouds) == 30  # one a second
    assert len(clouds[-1].content) == 1
    turning = {**record, "host_s": [40.0], "raw_b_gauss": [[0.0, 0.5, 0.0]]}
    (cloud,) = [one for one in topics.of(turning, 40.0) if one.topic == "/field/raw"]
    assert cloud.content[-1].tolist() == [0.0, 0.5, 0.0]
    assert len(cloud.content) == 2


def test_an_estimate_with_its_sigmas():
    (said,) = Topics(0.0).of(ESTIMATE, 0.0)
    assert said.topic == "/estimate"
    assert said.content["sigma_hard_iron_gauss"] == {"x": 0.1, "y": 0.2, "z": 0.3}
    assert said.content["sigma_gyro_bias_rad_s"] == {"x": 0.4, "y": 0.5, "z": 0.6}
    assert said.content["heading_sigma_deg"] == 0.7


def test_status_has_attitude_and_obstacles_to_a_write(pytestconfig):
    status = json.loads((pytestconfig.rootpath / "tests/page/qualified.json").read_text())
    attitude, write_back = Topics(0.0).of({**status, "record": "status"}, 5.0)
    assert attitude.content == {
        "heading_deg": 301.859,
        "heading_would_be_deg": 282.594,
        "roll_deg": -0.319053,
        "pitch_deg": -9.22819,
    }
    assert write_back.content["state"] == "QUALIFIED"
    assert write_back.content["holds"] == ["an operator must approve 43278c0e"]
    assert write_back.content["gates_shut"] == sum(not gate["ok"] for gate in status["gates"])


def test_log_includes_records_lost_by_this_program():
    topics = Topics(0.0)
    note = {"record": "note", "host_s": 3.0, "level": "warning", "text": "the link was lost"}
    assert topics.of(note, 9.0)[0].content == ("warning", "the link was lost")
    gap = {"record": "gap", "lost": 40, "first_seq": 3, "last_seq": 42}
    ((level, text),) = [one.content for one in topics.of(gap, 9.0)]
    assert level == "warning"
    assert text == "lost 40 records: this program read too slowly"
    assert topics.of({"record": "of a later version"}, 9.0) == []


@pytest.fixture
def daemon(tmp_path, pytestconfig):
    """The daemon's socket, which tells the same records again and again."""
    status = json.loads((pytestconfig.rootpath / "tests/page/qualified.json").read_text())
    server, ended = SocketServer(tmp_path / "socket"), threading.Event()

    def run():
        while not ended.wait(0.05):
            server.samples({**SAMPLES, "host_s": [time.monotonic()] * 2})
            server.publish(events.Estimated(1.0, 1.0, estimate()))
            server.publish(events.Noted(1.0, 1.0, "info", "hello"))
            server.status(status)

    thread = threading.Thread(target=run)
    thread.start()
    yield tmp_path
    ended.set()
    thread.join()
    server.close()


@pytest.fixture
def shown(daemon):
    """`ahrsd foxglove` beside it: process and port."""
    process = subprocess.Popen(
        [sys.executable, "-m", "ahrsd", "foxglove", "--port", "0", "--state-directory", daemon],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    place = process.stdout.readline().split()[0]
    yield process, place
    process.kill()
    process.communicate()


def test_a_foxglove_reads_every_topic_and_can_write_to_none(shown):
    process, place = shown
    with connect(place, subprotocols=["foxglove.sdk.v1"], max_size=None) as client:
        told, topics = {}, {}
        deadline = time.monotonic() + PATIENCE_S
        while len(topics) < len(SCHEMAS) + len(CLOUDS) + 1 and time.monotonic() < deadline:
            message = json.loads(client.recv(30.0))
            told[message["op"]] = message
            if message["op"] == "advertise":
                topics |= {one["topic"]: one for one in message["channels"]}
        assert set(topics) == {*SCHEMAS, *CLOUDS.values(), "/log"}
        assert told["serverInfo"]["name"] == "ahrsd"
        assert "clientPublish" not in told["serverInfo"]["capabilities"]
        wanted = dict(enumerate(topics))
        asked = [{"id": k, "channelId": topics[topic]["id"]} for k, topic in wanted.items()]
        client.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        found: dict[str, bytes] = {}
        expected = {"/magnetometer/raw", "/estimate", "/log", "/field/corrected"}
        while not expected <= found.keys() and time.monotonic() < deadline:
            message = client.recv(30.0)
            if isinstance(message, bytes) and message[0] == 1:
                number, at_ns = struct.unpack("<IQ", message[1:13])
                found[wanted[number]] = message[13:]
                if wanted[number] == "/magnetometer/raw":
                    assert at_ns * 1e-9 == pytest.approx(time.time(), abs=20.0)
        assert expected <= found.keys()
        iron = json.loads(found["/estimate"])["hard_iron_gauss"]
        assert iron == {"x": IRON[0], "y": IRON[1], "z": IRON[2]}
        assert b"hello" in found["/log"]
        assert struct.pack("<3f", 0.2, 0.0, 0.0) in found["/field/corrected"]
        assert base64.b64decode(topics["/log"]["schema"])  # a Foxglove knows what it is
    assert process.stderr.readline().endswith("socket: the daemon answers\n")
    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 0


def test_missing_daemon_is_reported_once_and_awaited(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "ahrsd", "foxglove", "--port", "0", "--state-directory", tmp_path],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline().startswith("ws://127.0.0.1:")
    line = process.stderr.readline()
    assert "no daemon answers" in line
    assert line.endswith("waiting for it\n")
    time.sleep(2.5)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=PATIENCE_S) == ("", "")
    assert process.returncode == 0


def test_occupied_port_is_refused_in_one_line_with_code_75():
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = other.getsockname()[1]
        done = CliRunner().invoke(group, ["foxglove", "--port", str(port)])
    assert isinstance(done.exception, DeviceError)
    assert done.exception.exit_code == EXIT_BUSY
    assert f"127.0.0.1 port {port}: Address already in use; --port" in str(done.exception)


def test_invalid_address_is_refused():
    done = CliRunner().invoke(group, ["foxglove", "--address", "rov.local"])
    assert done.exit_code == 2
    assert "--address rov.local: must be an IP address" in done.output


def test_each_loss_of_the_daemon_is_reported(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "ahrsd", "foxglove", "--port", "0", "--state-directory", tmp_path],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline().startswith("ws://")
    assert "no daemon answers" in process.stderr.readline()
    for _ in range(2):
        server = SocketServer(tmp_path / "socket")
        assert process.stderr.readline().endswith("the daemon answers\n")
        server.close()
        assert process.stderr.readline().endswith("the daemon has ended; waiting for it\n")
        assert "no daemon answers" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=PATIENCE_S) == ("", "")
    assert process.returncode == 0
