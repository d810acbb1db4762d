"""`ahrsd page` as a process: with a daemon's socket, in a real browser, and refused starts."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import psutil
import pytest
from browser import BROWSER
from click.testing import CliRunner
from live_browser import LiveBrowser
from patience import PATIENCE_S

from ahrsd.__main__ import group
from ahrsd.daemon.operator_inbox import OperatorAnswer, OperatorBox, OperatorInbox
from ahrsd.telemetry.unix_socket import SocketServer

TOKEN = "a1b2c3d4e5f6a7b8"
in_a_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
OVERFLOW = """[...document.querySelectorAll('body *')].filter(e =>
    e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"""


class Daemon:
    """The daemon's socket and its operator input, with a status that a test may change."""

    def __init__(self, state, status):
        self.state, self.status, self.said = state, status, []
        self.answer = OperatorAnswer(True, "43278c0e is being written")
        box = OperatorBox(state)
        box.prepare()
        self.inbox = OperatorInbox(box)
        self._ended = threading.Event()
        self.server = None
        self._thread = threading.Thread(target=self._run)
        self.serve()
        self._thread.start()

    def serve(self):
        self.server = SocketServer(self.state / "socket")

    def leave(self):
        server, self.server = self.server, None
        server.close()

    def close(self):
        self._ended.set()
        self._thread.join()
        self.inbox.close(5.0)
        if self.server is not None:
            self.server.close()

    def _run(self):
        while not self._ended.wait(0.1):
            if self.server is not None:
                self.server.status(self.status)
            for word in self.inbox.take():
                self.said.append((word.verb, word.argument))
                self.inbox.answer(word.name, self.answer)


@pytest.fixture
def daemon(tmp_path, qualified):
    found = Daemon(tmp_path, qualified)
    yield found
    found.close()


@contextmanager
def page_of(state, *options):
    """The address of a page that serves, and its process."""
    command = [sys.executable, "-m", "ahrsd", "page", "--state-directory", str(state)]
    process = subprocess.Popen(
        [*command, "--port", "0", *options], stdout=subprocess.PIPE, text=True
    )
    try:
        line = process.stdout.readline()
        yield line.split()[0], process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.fixture
def token_file(tmp_path):
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    path.chmod(0o600)
    return path


def text_of(browser, place="body"):
    return browser.value(f"document.querySelector('{place}').innerText")


def has(place, words):
    return f"document.querySelector('{place}').innerText.includes({json.dumps(words)})"


@in_a_browser
@pytest.mark.parametrize("dark", [pytest.param(False, marks=pytest.mark.slow), True])
def test_page_fits_a_phone_and_a_desktop(daemon, tmp_path, dark):
    with page_of(tmp_path) as (address, _), LiveBrowser(tmp_path / "browser") as browser:
        for width in (390, 1280):
            browser.open(address, width, dark=dark)
            browser.until(has("#head", "QUALIFIED"))
            assert browser.value("document.documentElement.scrollWidth") == width
            assert browser.value(OVERFLOW) == []
            for words in ("Heading now", "As it would be", "49 of 49 open", "level circle"):
                assert words in text_of(browser)
            drawn = browser.value("document.querySelector('.dot.shown').getBBox().width")
            assert drawn > 100
            back = browser.value("getComputedStyle(document.body).backgroundColor")
            assert back == ("rgb(14, 17, 20)" if dark else "rgb(238, 241, 244)")
        assert browser.errors == []


@in_a_browser
def test_page_follows_the_daemon_and_shows_no_outdated_values(daemon, tmp_path):
    with page_of(tmp_path) as (address, page), LiveBrowser(tmp_path / "browser") as browser:
        browser.open(address, 390)
        browser.until(has("#head", "QUALIFIED"))
        turned = json.loads(json.dumps(daemon.status))
        turned["readings"] |= {"heading_deg": 123.4, "age_s": 0.1}
        turned["sensors"] = ["<b id='planted'>the gyro is stuck</b>"]
        daemon.status = turned
        browser.until(has("#heading", "123°"))
        browser.until(has("#alarms", "<b id='planted'>the gyro is stuck</b>"))
        assert browser.value("document.getElementById('planted')") is None

        # an unfolded section stays unfolded while its text is updated
        shut = [one | {"ok": False, "advice": f"turn {k}"} for k, one in enumerate(turned["gates"])]
        held = [f"gate {one['gate']}: {one['advice']}" for one in shut[:9]]
        back = turned["write_back"] | {"holds": held}
        daemon.status = turned | {"gates": shut, "write_back": back}
        browser.until("document.querySelector('#gates details') !== null")
        assert "Turn 8." not in text_of(browser, "#gates")
        browser.value("document.querySelector('#gates summary').click()")
        assert "Turn 8." in text_of(browser, "#gates")
        shut[0]["value"] = 77.0
        browser.until(has("#gates", "77"))
        assert "Turn 8." in text_of(browser, "#gates")
        daemon.status = turned

        daemon.leave()
        browser.until(has("#alarms", "The daemon is away"))
        assert "Since " in text_of(browser, "#alarms")
        assert "123" not in text_of(browser, "main")
        daemon.serve()
        browser.until(has("#heading", "123°"))

        page.send_signal(signal.SIGSTOP)
        browser.until("document.body.classList.contains('lost')")
        assert "Nothing comes from the vehicle since" in text_of(browser, "#lost")
        assert browser.value("getComputedStyle(document.querySelector('main')).visibility") == (
            "hidden"
        )
        page.send_signal(signal.SIGCONT)
        browser.until("!document.body.classList.contains('lost')")
        assert browser.errors == []


@in_a_browser
def test_candidate_is_approved_with_the_token(daemon, tmp_path, token_file):
    def approve(browser, token):
        browser.value(f"document.getElementById('token').value = {json.dumps(token)}")
        browser.value("document.querySelector('#approve button').click()")
        browser.until("document.querySelector('#answer').className !== ''")
        answer = text_of(browser, "#answer")
        browser.value("document.querySelector('#answer').className = ''")
        return answer

    options = ("--token-file", str(token_file))
    with page_of(tmp_path, *options) as (address, _), LiveBrowser(tmp_path / "b") as browser:
        browser.open(address, 390)
        browser.until(has("#candidate", "43278c0e"))
        assert approve(browser, "wrong") == "Refused: this is not the operator's token"
        assert daemon.said == []
        assert approve(browser, TOKEN) == "Accepted: 43278c0e is being written"
        assert daemon.said == [("approve", "43278c0e")]
        daemon.answer = OperatorAnswer(False, "the vehicle has not said that a write is safe")
        assert approve(browser, TOKEN) == ("Refused: the vehicle has not said that a write is safe")
        assert browser.value("document.getElementById('token').value") == ""

        daemon.status = json.loads(json.dumps(daemon.status))
        daemon.status["write_back"]["state"] = "TRIAL"
        browser.until("getComputedStyle(document.getElementById('approve')).display === 'none'")
        # the browser's console names the two answers that were a refusal; nothing else went wrong
        assert all("403" in text or "409" in text for text in browser.errors)
        assert len(browser.errors) == 2


@in_a_browser
def test_page_without_a_token_has_no_form(daemon, tmp_path):
    with page_of(tmp_path) as (address, _), LiveBrowser(tmp_path / "browser") as browser:
        browser.open(address, 390)
        browser.until(has("#candidate", "43278c0e"))
        assert browser.value("document.querySelector('form, input, button')") is None
        assert "ahrsd operator approve 43278c0e" in text_of(browser, "#candidate")


def events(address, count):
    """The first events that a browser gets, as dictionaries."""
    asked = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE_S)
    asked.request("GET", "/events")
    answer = asked.getresponse()
    found = []
    while len(found) < count:
        line = answer.readline()
        if line.startswith(b"data: "):
            found.append(json.loads(line[6:]))
    asked.close()
    return found


def test_blocked_browser_does_not_delay_others(daemon, tmp_path):
    with page_of(tmp_path) as (address, process):
        place, end_s = urlsplit(address), time.monotonic() + PATIENCE_S
        while "QUALIFIED" not in events(address, 1)[0]["head"]:  # the daemon has not answered yet
            assert time.monotonic() < end_s
        first, *later = events(address, 3)
        assert "QUALIFIED" in first["head"]
        assert all("head" not in one for one in later)  # only what changed
        before = unix_sockets(process)
        sleepers = []
        for _ in range(8):
            sleeper = socket.create_connection((place.hostname, place.port))
            sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            sleeper.sendall(f"GET /events HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode())
            sleepers.append(sleeper)
        for turn in range(40):  # every section changes, a dozen kilobytes each time
            daemon.status = json.loads(json.dumps(daemon.status)) | {"sensors": ["x" * 1900] * turn}
            time.sleep(0.02)
        began_s = time.monotonic()
        assert len(events(address, 2)) == 2
        assert time.monotonic() - began_s < 30.0
        assert unix_sockets(process) == before  # one connection to the daemon for all of them
        for sleeper in sleepers:
            sleeper.close()
        assert process.poll() is None


def unix_sockets(process):
    return len(psutil.Process(process.pid).net_connections("unix"))


def test_page_terminates_with_browsers_connected(daemon, tmp_path):
    with page_of(tmp_path) as (address, process):
        place = urlsplit(address)
        with socket.create_connection((place.hostname, place.port)) as open_one:
            open_one.sendall(f"GET /events HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode())
            assert open_one.recv(100).startswith(b"HTTP/1.1 200")
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE_S) in (0, -signal.SIGTERM)


def test_page_without_a_daemon_says_so_and_waits(tmp_path):
    with page_of(tmp_path) as (address, _):
        (first,) = events(address, 1)
        time.sleep(1.0)
        (first,) = events(address, 1)
        assert "no daemon answers" in first["alarms"]
        assert first["heading"] == ""


# -- What is refused at the start ------------------------------------------------------------------


def refused(*options):
    found = CliRunner().invoke(group, ["page", *map(str, options)])
    assert found.exit_code != 0
    return f"{found.output}{found.exception}", found.exception


def test_token_readable_by_others_is_refused(tmp_path, token_file):
    token_file.chmod(0o640)
    text, error = refused("--token-file", token_file)
    assert text.endswith(f"token: can be read by others: chmod 600 {token_file}")
    assert error.exit_code == 2
    token_file.chmod(0o600)
    token_file.write_text("short")
    assert "holds no token" in refused("--token-file", token_file)[0]
    link = tmp_path / "link"
    link.symlink_to(token_file)
    assert "is a symbolic link" in refused("--token-file", link)[0]
    assert "No such file" in refused("--token-file", tmp_path / "none")[0]


def test_systemd_credential_is_accepted_as_token(daemon, tmp_path, token_file, monkeypatch):
    """Its mode shows a group if an access list admits the unit's user."""
    token_file.chmod(0o440)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    with page_of(tmp_path, "--token-file", str(token_file)) as (address, process):
        assert address.startswith("http://127.0.0.1:")
        assert process.poll() is None
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "of-another"))
    assert "can be read by others" in refused("--token-file", token_file)[0]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_token_of_another_user_is_refused(token_file):
    os.chown(token_file, 12345, 12345)
    assert "belongs to user 12345" in refused("--token-file", token_file)[0]


def test_bad_or_occupied_address_is_refused():
    assert "must be an IP address" in refused("--address", "rov.local")[0]
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        text, error = refused("--port", port)
    assert f"127.0.0.1 port {port}: Address already in use" in text
    assert error.exit_code == 75


def test_host_option_is_a_name_for_any_port(daemon, tmp_path):
    assert "must be a name such as rov.local" in refused("--host", "http://rov.local/")[0]
    with page_of(tmp_path, "--host", "ROV.local:9191") as (address, _):
        asked = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE_S)
        codes = []
        for name in ("rov.local", "other.local"):
            asked.request("GET", "/", headers={"Host": name})
            answer = asked.getresponse()
            answer.read()
            codes.append(answer.status)
        asked.close()
    assert codes == [200, 421]


def test_public_address_is_warned_about(tmp_path):
    command = [sys.executable, "-m", "ahrsd", "page", "--state-directory", str(tmp_path)]
    process = subprocess.Popen(
        [*command, "--port", "0", "--address", "0.0.0.0"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    process.stdout.readline()
    assert "anybody who reaches 0.0.0.0:" in process.stderr.readline()
    process.kill()
    process.communicate()


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    text, error = refused()
    assert text.endswith("starlette and uvicorn are missing: pip install 'ahrsd[page]'")
    assert error.exit_code == 2


def test_process_loads_no_heavy_modules():
    """It loads no module that estimates, records or plots."""
    program = (
        "import sys, ahrsd.page.app; heavy = {'gtsam', 'scipy', 'rerun', 'matplotlib', 'pyarrow'};"
        "print(sorted(heavy & {name.partition('.')[0] for name in sys.modules}))"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert found.stdout == "[]\n"
