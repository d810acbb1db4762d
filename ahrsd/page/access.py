"""Who may ask, and who may approve: names under which the page is opened, forms, and the token.

A page on a local address can be asked by any web site that is open in the same browser: by a name
that its owner points at this machine (DNS rebinding), or by a form that is sent from there (CSRF).
So a request counts only under a name that is known, a form only where it comes from this page.
Pure: the time and what is random are arguments.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

LEAST_TOKEN = 12  # characters
MOST_TOKEN = 256
_TRIES = 5  # wrong tokens at once, then one in so many seconds
_TRY_AGAIN_S = 30.0


class TokenError(ValueError):
    """Why a token cannot be used, in words that follow the name of its file."""


def host_of(header: str) -> str:
    """The name or address in a Host header, without its port; empty where it is none."""
    try:
        found = urlsplit(f"//{header}")
        _ = found.port  # raises where it is no number
    except ValueError:
        return ""
    if found.path or found.query or found.fragment or found.username is not None:
        return ""
    return (found.hostname or "").removesuffix(".")


def host_is_known(header: str, own_address: str, names: Iterable[str]) -> bool:
    """Whether a request under this Host header is for this page.

    own_address: the address of this machine at which the request came in. That address itself
    cannot be rebound, and neither can `localhost`; another name counts only where it is in `names`.
    """
    host = host_of(header)
    if not host:
        return False
    if host in {name.lower().removesuffix(".") for name in names}:
        return True
    own = _address(own_address)
    if host == "localhost":
        return own is not None and own.is_loopback
    asked = _address(host)
    return asked is not None and own is not None and (asked == own)


def comes_from_here(headers: Mapping[str, str], scheme: str) -> bool:
    """Whether the browser says that a form was sent by a page of this very origin."""
    site = headers.get("sec-fetch-site", "same-origin")
    origin, host = headers.get("origin", ""), headers.get("host", "")
    return site == "same-origin" and bool(host) and origin == f"{scheme}://{host}".lower()


def form_mark(secret: bytes, browser: str) -> str:
    """What a form of this page carries; it is bound to the browser's cookie."""
    return hmac.new(secret, browser.encode(), hashlib.sha256).hexdigest()


def is_form_mark(secret: bytes, browser: str, mark: str) -> bool:
    """Whether a form carries the mark of this browser."""
    return bool(browser) and hmac.compare_digest(form_mark(secret, browser), mark)


def token_in(text: str) -> str:
    """The token that a file holds. Raises TokenError."""
    token = text.strip()
    if not LEAST_TOKEN <= len(token) <= MOST_TOKEN or not token.isascii() or " " in token:
        raise TokenError(
            f"holds no token: one word of {LEAST_TOKEN} to {MOST_TOKEN} letters and digits"
        )
    return token


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the token was right; `text` says why not."""

    right: bool
    text: str = ""


class Token:
    """The operator's token; wrong ones are counted over all who ask. Time is monotonic."""

    def __init__(self, token: str) -> None:
        self._digest = hashlib.sha256(token.encode()).digest()
        self._left, self._counted_s = float(_TRIES), 0.0

    def check(self, given: str, now_s: float) -> Verdict:
        """One try; while too many were wrong, a right one is refused like any other."""
        more = (now_s - self._counted_s) / _TRY_AGAIN_S
        self._left, self._counted_s = min(self._left + max(more, 0.0), _TRIES), now_s
        if self._left < 1.0:
            wait_s = (1.0 - self._left) * _TRY_AGAIN_S
            return Verdict(False, f"too many wrong tokens: try again in {wait_s:.0f} s")
        digest = hashlib.sha256(given.strip().encode(errors="replace")).digest()
        if hmac.compare_digest(digest, self._digest):
            return Verdict(True)
        self._left -= 1.0
        return Verdict(False, "this is not the operator's token")


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        found = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    mapped = getattr(found, "ipv4_mapped", None)
    return found if mapped is None else mapped
