"""Who may request the page and who may approve."""

import pytest

from ahrsd.page.access import (
    Token,
    TokenError,
    comes_from_here,
    form_mark,
    host_is_known,
    host_of,
    is_form_mark,
    token_in,
)


@pytest.mark.parametrize(
    ("header", "own", "known"),
    [
        ("127.0.0.1:9191", "127.0.0.1", True),
        ("localhost:8080", "127.0.0.1", True),  # through an ssh tunnel
        ("LOCALHOST", "::1", True),
        ("[::1]:9191", "::1", True),
        ("10.0.0.7:9191", "10.0.0.7", True),
        ("10.0.0.7", "::ffff:10.0.0.7", True),
        ("rov.local:9191", "10.0.0.7", True),
        ("ROV.local.", "10.0.0.7", True),
        ("evil.example:9191", "127.0.0.1", False),
        ("localhost.evil.example", "127.0.0.1", False),
        ("localhost", "10.0.0.7", False),
        ("10.0.0.8", "10.0.0.7", False),
        ("127.0.0.1", "10.0.0.7", False),
        ("rov.local@evil.example", "10.0.0.7", False),
        ("127.0.0.1/x", "127.0.0.1", False),
        ("127.0.0.1:x", "127.0.0.1", False),
        ("", "127.0.0.1", False),
    ],
)
def test_host_header_must_be_a_known_name(header, own, known):
    assert host_is_known(header, own, {"rov.local"}) is known


def test_host_name_is_parsed_from_the_header():
    assert host_of("[::1]:80") == "::1"
    assert host_of("Rov.Local:80") == "rov.local"
    assert host_of("a b") in ("", "a b")
    assert host_of("[::1") == ""


@pytest.mark.parametrize(
    ("headers", "fine"),
    [
        ({"origin": "http://rov:9191", "host": "rov:9191"}, True),
        ({"origin": "http://rov:9191", "host": "rov:9191", "sec-fetch-site": "same-origin"}, True),
        ({"origin": "http://rov:9191", "host": "rov:9191", "sec-fetch-site": "cross-site"}, False),
        ({"origin": "http://evil.example", "host": "rov:9191"}, False),
        ({"origin": "https://rov:9191", "host": "rov:9191"}, False),
        ({"origin": "http://rov:8000", "host": "rov:9191"}, False),
        ({"origin": "null", "host": "rov:9191"}, False),
        ({"host": "rov:9191"}, False),
        ({}, False),
    ],
)
def test_form_must_come_from_this_page(headers, fine):
    assert comes_from_here(headers, "http") is fine


def test_form_is_bound_to_its_browser():
    mark = form_mark(b"secret", "browser")
    assert is_form_mark(b"secret", "browser", mark)
    assert not is_form_mark(b"secret", "another", mark)
    assert not is_form_mark(b"restarted", "browser", mark)
    assert not is_form_mark(b"secret", "", form_mark(b"secret", ""))
    assert not is_form_mark(b"secret", "browser", "")


def test_only_the_right_token_is_accepted():
    token = Token("a1b2c3d4e5f6")
    assert token.check("a1b2c3d4e5f6", 0.0).right
    assert token.check(" a1b2c3d4e5f6\n", 0.0).right
    assert token.check("a1b2c3d4e5f", 0.0).text == "this is not the operator's token"
    assert not token.check("", 0.0).right
    assert not token.check("ü\udc80", 0.0).right


def test_too_many_wrong_tokens_also_block_the_right_one():
    token = Token("a1b2c3d4e5f6")
    for _ in range(5):
        assert token.check("guess", 100.0).text == "this is not the operator's token"
    assert token.check("a1b2c3d4e5f6", 100.0).text == "too many wrong tokens: try again in 30 s"
    assert token.check("a1b2c3d4e5f6", 120.0).text == "too many wrong tokens: try again in 10 s"
    assert token.check("a1b2c3d4e5f6", 130.5).right
    assert token.check("a1b2c3d4e5f6", 130.5).right  # a right one uses nothing up
    assert not token.check("guess", 131.0).right
    assert token.check("guess", 131.0).text.startswith("too many wrong tokens")
    for _ in range(5):  # an hour later there are five again, not more
        assert token.check("guess", 3600.0).text == "this is not the operator's token"
    assert token.check("guess", 3600.0).text.startswith("too many wrong tokens")


def test_file_must_contain_one_token():
    assert token_in("a1b2c3d4e5f6\n") == "a1b2c3d4e5f6"
    for wrong in ("", "short", "two words here now", "x" * 300, "a1b2c3d4e5fü"):
        with pytest.raises(TokenError, match="holds no token"):
            token_in(wrong)
