"""The page as a web application. The only importer of starlette and uvicorn.

The newest status comes from one connection to the daemon (`DaemonFeed`), however many browsers look
at the page; its sections are made as HTML once for all of them (`Board`), and each changes by
itself.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import re
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import ahrsd
from ahrsd.errors import DeviceError
from ahrsd.page import view
from ahrsd.page.access import Token, comes_from_here, form_mark, host_is_known, is_form_mark
from ahrsd.report.template import render
from ahrsd.telemetry.driving import Pace, circle_is_wanted, shown_of, tilt_is_wanted
from ahrsd.telemetry.protocol import STATUS_SCHEMA
from ahrsd.telemetry.unix_socket import DaemonConnection

# -- The newest status -----------------------------------------------------------------------------


_AGAIN_S = 1.0
_STALE_S = 3.5  # a status comes every second


@dataclass(frozen=True, slots=True)
class Heard:
    """The newest status and when it came (monotonic); `fault`: why none comes, empty if one may."""

    status: dict[str, Any] | None = None
    at_s: float = 0.0
    fault: str = ""

    def away(self, now_s: float) -> str:
        """Why the status says nothing of now; empty where it does."""
        if self.fault:
            return self.fault
        if self.status is None:
            return "the daemon has not sent its status yet"
        if now_s - self.at_s > _STALE_S:
            return "the daemon is silent"
        return ""


class DaemonFeed:
    """Watches the daemon in a thread of its own; connects again by itself."""

    def __init__(self, connect: Callable[[], DaemonConnection]) -> None:
        self._connect = connect
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)
        self.heard = Heard(at_s=time.monotonic())

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End with the next status; the thread does not keep the process."""
        self._stopped.set()

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                with self._connect() as daemon:
                    self._watch(daemon)
            except (DeviceError, OSError, ValueError) as error:
                self.heard = Heard(self.heard.status, self.heard.at_s, str(error))
            self._stopped.wait(_AGAIN_S)

    def _watch(self, daemon: DaemonConnection) -> None:
        """The newest status at once, then each one as it comes."""
        self._take(daemon.ask("status"))
        for record in daemon.watch(("status",)):
            if self._stopped.is_set():
                return
            if record.get("record") == "status":
                self._take(record)
            elif "error" in record:
                raise ValueError(str(record["error"]))

    def _take(self, status: dict[str, Any]) -> None:
        if status.get("schema") != STATUS_SCHEMA:
            raise ValueError(f"the daemon sends {status.get('schema')}, not {STATUS_SCHEMA}")
        self.heard = Heard(status, time.monotonic())


# -- Sections as HTML ------------------------------------------------------------------------------


TEMPLATES = Path(__file__).with_name("templates")
#: sections in the order of the page; each is an element of this id
SECTIONS = (
    "head",
    "alarms",
    "todo",
    "sphere",
    "marker",
    "drive",
    "heading",
    "gates",
    "candidate",
    "estimate",
    "readings",
)
#: what a status of another version may cause
_OTHER_VERSION = (KeyError, TypeError, ValueError, AttributeError, IndexError)
LOOK_ELSEWHERE = "the page does not understand this daemon, it may be another version"


class Board:
    """See the module. `may_approve`: whether this page was given an operator's token."""

    def __init__(self, *, may_approve: bool) -> None:
        self.may_approve = may_approve
        self._pace, self._fresh = Pace(), view.Fresh()
        self._taken_s = -math.inf

    def take(self, heard: Heard) -> None:
        """Follow what moves; once for each status."""
        if heard.status is None or heard.at_s == self._taken_s:
            return
        self._taken_s = heard.at_s
        try:
            self._pace.take(heard.status)
            self._fresh.take(_field(heard.status), float(heard.status["at_s"] or 0.0))
        except _OTHER_VERSION:
            return  # `sections` says so

    def sections(self, heard: Heard, now_s: float) -> dict[str, str]:
        """Every section by its id, at `now_s` of the monotonic clock."""
        if why := heard.away(now_s):
            return self._away(why, now_s - heard.at_s, heard.status is not None)
        try:
            return self._present(heard.status or {})
        except _OTHER_VERSION as error:
            return self._away(f"{LOOK_ELSEWHERE}: {error!r}", now_s - heard.at_s, seen=False)

    def _away(self, why: str, for_s: float, seen: bool) -> dict[str, str]:
        """No figure at all: an old one must not be taken for one of now."""
        since = time.strftime("%H:%M:%S", time.localtime(time.time() - for_s))
        text = render(
            "away.html", TEMPLATES, why=why, since=since, for_=view.span(for_s), seen=seen
        )
        return dict.fromkeys(SECTIONS, "") | {"alarms": text}

    def _present(self, status: Mapping[str, Any]) -> dict[str, str]:
        state, meaning, mode = view.state_words(status)
        shown, fresh_s = shown_of(status), float(status["at_s"] or 0.0)
        circle, tilts = circle_is_wanted(status), tilt_is_wanted(status)
        dots, marker = None, None
        if shown is not None:
            fresh = self._fresh.cells(fresh_s)
            dots = view.dots(shown, fresh, circle=circle, tilts=tilts)
            if view.has_readings(status):
                marker = view.marker(_field(status), shown.frame_b)
        values: dict[str, object] = {
            "view": view,
            "status": status,
            "pace": self._pace,
            "may_approve": self.may_approve,
            "state": state,
            "meaning": meaning,
            "mode": mode,
            "dots": dots,
            "marker": marker,
        }
        return {name: render(f"{name}.html", TEMPLATES, **values) for name in SECTIONS}


def _field(status: Mapping[str, Any]) -> list[float | None]:
    """The field now by the best calibration that is known."""
    seen = status["readings"]
    if seen is None:
        return [None] * 3
    new: list[float | None] = seen["would_be_b_gauss"]
    return seen["corrected_b_gauss"] if None in new else new


# -- The application -------------------------------------------------------------------------------


MOST_BROWSERS = 32
_MOST_REQUESTS = 64
_LONGEST_FORM = 4096
_LOOK_S = 0.5
_COOKIE = "ahrsd-page"
_ID = re.compile(r"[0-9a-f]{4,64}")
_STATIC = Path(__file__).with_name("static")
_KINDS = {
    "page.css": "text/css",
    "page.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}


@dataclass(slots=True)
class Site:
    """What the page is made of.

    names: names under which it is opened, beside this machine's own addresses
    token: the operator's, None where the page only shows
    approve: says the word for a candidate's id; whether it was accepted, and why not
    """

    feed: DaemonFeed
    approve: Callable[[str], tuple[bool, str]]
    names: frozenset[str] = frozenset()
    token: Token | None = None
    secret: bytes = field(default_factory=lambda: secrets.token_bytes(32))

    def board(self) -> Board:
        """One that follows the feed."""
        return Board(may_approve=self.token is not None)


class Fanout:
    """The newest sections for every browser; one that is slow gets the newest when it can."""

    def __init__(self, site: Site) -> None:
        self._site, self._board = site, site.board()
        self._turned = asyncio.Condition()
        self.number, self.sections = 0, {}  # type: int, dict[str, str]
        self.browsers = 0

    async def run(self) -> None:
        """Look at the feed for ever."""
        while True:
            self.look()
            async with self._turned:
                self._turned.notify_all()
            await asyncio.sleep(_LOOK_S)

    def look(self) -> dict[str, str]:
        """The sections of now."""
        heard = self._site.feed.heard
        self._board.take(heard)
        self.sections = self._board.sections(heard, time.monotonic())
        self.number += 1
        return self.sections

    async def changes(self) -> AsyncIterator[str]:
        """Events for one browser: what changed since its last one."""
        sent: dict[str, str] = {}
        self.browsers += 1
        try:
            while True:
                now = self.sections
                changed = {name: text for name, text in now.items() if sent.get(name) != text}
                sent = now
                yield f"data: {json.dumps(changed)}\n\n"
                async with self._turned:
                    await self._turned.wait()
        finally:
            self.browsers -= 1


class HostGuard:
    """Refuses requests under foreign names, and puts the headers on every answer."""

    def __init__(self, app: ASGIApp, names: frozenset[str]) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        own = (scope.get("server") or ("",))[0]
        asked = Headers(scope=scope).getlist("host")
        if len(asked) != 1 or not host_is_known(asked[0], own, self._names):
            refusal = PlainTextResponse(
                "This page is not served under this name. On the vehicle's computer: "
                "ahrsd page --host NAME\n",
                status_code=421,
            )
            await refusal(scope, receive, guarded)
            return
        await self._app(scope, receive, guarded)


def make_app(site: Site) -> Starlette:
    """The application; it follows the feed while it runs."""
    fanout = Fanout(site)

    @contextlib.asynccontextmanager
    async def life(_: Starlette) -> AsyncIterator[None]:
        task = asyncio.create_task(fanout.run())
        yield
        task.cancel()

    async def page(request: Request) -> Response:
        browser = request.cookies.get(_COOKIE, "") or secrets.token_urlsafe(16)
        text = render(
            "page.html",
            TEMPLATES,
            sections=fanout.look(),
            may_approve=site.token is not None,
            mark=form_mark(site.secret, browser),
            answer="",
            version=ahrsd.__version__,
        )
        answer = HTMLResponse(text)
        secure = request.url.scheme == "https"
        answer.set_cookie(_COOKIE, browser, httponly=True, samesite="strict", secure=secure)
        return answer

    async def events(_: Request) -> Response:
        if fanout.browsers >= MOST_BROWSERS:
            text = f"{MOST_BROWSERS} browsers look at this page already\n"
            return PlainTextResponse(text, status_code=503)
        return StreamingResponse(fanout.changes(), media_type="text/event-stream")

    async def static(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in _KINDS:
            return PlainTextResponse("there is no such file\n", status_code=404)
        return FileResponse(_STATIC / name, media_type=_KINDS[name])

    async def approve(request: Request) -> Response:
        code, text = await _approve(site, request)
        if "application/json" in request.headers.get("accept", ""):
            return JSONResponse({"accepted": code == 200, "text": text}, status_code=code)
        page = render("answer.html", TEMPLATES, accepted=code == 200, text=text)
        return HTMLResponse(page, status_code=code)

    routes = [
        Route("/", page),
        Route("/events", events),
        Route("/static/{name}", static),
        Route("/approve", approve, methods=["POST"]),
    ]
    guard = Middleware(HostGuard, names=site.names)
    app = Starlette(routes=routes, middleware=[guard], lifespan=life)
    app.state.fanout = fanout
    return app


async def _approve(site: Site, request: Request) -> tuple[int, str]:
    """Status code and what became of an approval; every door is tried before the token."""
    if site.token is None:
        return 403, "this page only shows; it was started without an operator's token"
    if not comes_from_here(request.headers, request.url.scheme):
        return 403, "this form was not sent by this page"
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > _LONGEST_FORM:
            return 413, f"a form of more than {_LONGEST_FORM} bytes"
    given = _form(body)
    if not is_form_mark(site.secret, request.cookies.get(_COOKIE, ""), given.get("mark", "")):
        return 403, "this page is from before a restart of its server: load it again"
    verdict = site.token.check(given.get("token", ""), time.monotonic())
    if not verdict.right:
        return 403, verdict.text
    heard, candidate = site.feed.heard, given.get("candidate", "")
    if away := heard.away(time.monotonic()):
        return 503, f"the daemon is away: {away}"
    proposal = (heard.status or {}).get("write_back", {}).get("proposal")
    if not _ID.fullmatch(candidate) or proposal is None or proposal.get("id") != candidate:
        return 409, "this candidate is no longer proposed: look at the page again"
    accepted, text = await run_in_threadpool(site.approve, candidate)
    return (200 if accepted else 409), text


def _form(body: bytes) -> dict[str, str]:
    from urllib.parse import parse_qsl

    try:
        return dict(parse_qsl(body.decode(), max_num_fields=8))
    except ValueError:
        return {}


def serve(app: Starlette, listener: socket.socket) -> None:
    """Serve on a listening socket until SIGINT or SIGTERM."""
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        http="h11",
        ws="none",
        limit_concurrency=_MOST_REQUESTS,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=1,
    )
    uvicorn.Server(config).run(sockets=[listener])
