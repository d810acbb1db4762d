"""The page as requested by a browser and by others."""

import re

import pytest
from starlette.testclient import TestClient

from ahrsd.page.access import Token
from ahrsd.page.app import Heard, Site, make_app

TOKEN = "a1b2c3d4e5f6a7b8"
HERE = "http://127.0.0.1:9191"


class Words:
    """The operator's side of a daemon that answers as configured."""

    def __init__(self):
        self.said, self.answer = [], (True, "43278c0e is being written")

    def __call__(self, candidate):
        self.said.append(candidate)
        return self.answer


@pytest.fixture
def words():
    return Words()


@pytest.fixture
def client(feed, words):
    """A client of a page with a token."""
    app = make_app(Site(feed, words, frozenset({"rov.local"}), Token(TOKEN)))
    with TestClient(app, base_url=HERE) as client:
        yield client


@pytest.fixture
def read_only(feed, words):
    with TestClient(make_app(Site(feed, words)), base_url=HERE) as client:
        yield client


def mark_of(client):
    return re.search(r'name="mark" value="([0-9a-f]{64})"', client.get("/").text)[1]


def approve(client, headers=None, **changes):
    form = {"mark": mark_of(client), "token": TOKEN, "candidate": "43278c0e"} | changes
    sent = {"origin": HERE, "accept": "application/json"} | (headers or {})
    sent = {name: value for name, value in sent.items() if value is not None}
    return client.post("/approve", data=form, headers=sent)


def test_page_shows_the_daemon_and_loads_nothing_external(client):
    answer = client.get("/")
    assert answer.status_code == 200
    assert "QUALIFIED" in answer.text
    assert "43278c0e" in answer.text
    loaded = re.findall(r'(?:src|href)="([^"]+)"', answer.text)
    assert loaded == ["static/icon.svg", "static/page.css", "static/page.js"]
    for name in loaded:
        assert client.get(f"/{name}").status_code == 200
    assert re.search(r"<script(?![^>]*src=)", answer.text) is None
    assert " style=" not in answer.text
    assert " on" not in "".join(re.findall(r"<[^>]* on\w+=", answer.text))


def test_every_answer_has_security_headers(client):
    for answer in (client.get("/"), client.get("/static/page.js"), client.get("/nothing")):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "script-src 'self'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cache-control"] == "no-store"
        assert "access-control-allow-origin" not in answer.headers
    cookie = client.get("/").headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie


@pytest.mark.parametrize("path", ["/", "/events", "/static/page.js", "/approve"])
def test_request_under_a_foreign_host_name_is_refused(client, path):
    answer = client.get(path, headers={"host": "evil.example"})
    assert answer.status_code == 421
    assert "QUALIFIED" not in answer.text
    assert client.get("/", headers={"host": "rov.local:9191"}).status_code == 200


def test_only_files_of_the_page_are_served(client):
    for name in ("../app.py", "page.html", "..%2f..%2fpyproject.toml", "%2fetc%2fpasswd"):
        assert client.get(f"/static/{name}").status_code == 404


def test_approval_reaches_the_daemon_and_its_answer_is_shown(client, words):
    answer = approve(client)
    assert (answer.status_code, answer.json()) == (
        200,
        {"accepted": True, "text": "43278c0e is being written"},
    )
    assert words.said == ["43278c0e"]
    words.answer = (False, "the vehicle has not said that a write is safe")
    answer = approve(client)
    assert (answer.status_code, answer.json()["accepted"]) == (409, False)
    assert answer.json()["text"] == "the vehicle has not said that a write is safe"


def test_answer_is_a_page_without_javascript(client, words):
    words.answer = (False, "<b>no</b>")
    answer = approve(client, headers={"accept": "text/html"})
    assert "<h2>Refused</h2><p>&lt;b&gt;no&lt;/b&gt;</p>" in answer.text


@pytest.mark.parametrize(
    ("headers", "form", "code", "why"),
    [
        ({"origin": "http://evil.example"}, {}, 403, "not sent by this page"),
        ({"origin": None}, {}, 403, "not sent by this page"),
        ({"origin": "null"}, {}, 403, "not sent by this page"),
        ({"sec-fetch-site": "cross-site"}, {}, 403, "not sent by this page"),
        ({}, {"mark": "0" * 64}, 403, "load it again"),
        ({}, {"mark": ""}, 403, "load it again"),
        ({}, {"token": "wrong"}, 403, "not the operator's token"),
        ({}, {"token": ""}, 403, "not the operator's token"),
        ({}, {"candidate": "deadbeef"}, 409, "no longer proposed"),
        ({}, {"candidate": ""}, 409, "no longer proposed"),
        ({}, {"candidate": "../../lock"}, 409, "no longer proposed"),
        ({}, {"token": "x" * 5000}, 413, "a form of more than 4096 bytes"),
    ],
)
def test_unauthorised_approval_never_reaches_the_daemon(client, words, headers, form, code, why):
    answer = approve(client, headers, **form)
    assert answer.status_code == code
    assert answer.json()["accepted"] is False
    assert why in answer.json()["text"]
    assert words.said == []


def test_form_mark_of_another_browser_is_refused(client, words):
    mark = mark_of(client)
    client.cookies.clear()
    mark_of(client)  # another browser
    client.cookies.set("ahrsd-page", "a-cookie-that-was-planted", domain="127.0.0.1")
    answer = client.post(
        "/approve",
        data={"mark": mark, "token": TOKEN, "candidate": "43278c0e"},
        headers={"origin": HERE},
    )
    assert answer.status_code == 403
    assert words.said == []


def test_wrong_tokens_are_limited(client, words):
    for _ in range(5):
        assert "not the operator's token" in approve(client, token="guess").json()["text"]
    answer = approve(client)
    assert "too many wrong tokens" in answer.json()["text"]
    assert words.said == []


def test_page_without_a_token_is_read_only(read_only, words):
    text = read_only.get("/").text
    assert "<form" not in text
    assert "<input" not in text
    assert "this page only shows" in text
    answer = read_only.post("/approve", data={"candidate": "43278c0e"}, headers={"origin": HERE})
    assert answer.status_code == 403
    assert "only shows" in answer.text
    assert read_only.get("/approve").status_code == 405
    assert words.said == []


def test_changed_candidate_is_not_approved(client, feed, qualified, words):
    qualified["write_back"]["proposal"]["id"] = "0badcafe"
    feed.hear(qualified)
    answer = approve(client)
    assert "no longer proposed" in answer.json()["text"]
    assert words.said == []


def test_page_without_a_daemon_shows_no_old_values(client, feed, words):
    feed.heard = Heard(feed.heard.status, feed.heard.at_s - 60.0, "the daemon has ended")
    text = client.get("/").text
    assert "The daemon is away" in text
    assert "the daemon has ended" in text
    assert "43278c0e" not in text
    answer = approve(client)
    assert (answer.status_code, answer.json()["text"]) == (
        503,
        "the daemon is away: the daemon has ended",
    )
    assert words.said == []


def test_foreign_text_is_escaped(client, feed, qualified):
    qualified["sensors"] = ["<img src=x onerror=alert(1)>"]
    feed.hear(qualified)
    text = client.get("/").text
    assert "<img" not in text
    assert "&lt;img src=x" in text
