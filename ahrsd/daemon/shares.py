"""Every `[[share]]` of a run: ports for programs that may speak, addresses for those that read."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from ahrsd.config.sections import ShareSection
from ahrsd.daemon.network_shares import Listener, NetworkShares, Target
from ahrsd.daemon.shared_ports import SharedPorts
from ahrsd.errors import ConfigError
from ahrsd.events import SendToClient
from ahrsd.inputs import ClientLeft, ClientSent
from ahrsd.sharing.message_splitter import MessageSplitter
from ahrsd.sharing.share_facts import ShareFacts


class Shares:
    """Opens them; `close` takes them away again. Raises ConfigError where one cannot be.

    put: takes what programs on ptys write, from another thread
    """

    def __init__(
        self,
        shares: Iterable[ShareSection],
        put: Callable[[ClientSent | ClientLeft], None],
        now_ns: Callable[[], int],
    ) -> None:
        self._sections = tuple(shares)
        self._splitter = MessageSplitter()
        self._ports = SharedPorts([s for s in self._sections if s.pty is not None], put, now_ns)
        try:
            self._network = NetworkShares([s for s in self._sections if s.pty is None])
        except ConfigError:
            self._ports.close()
            raise

    def outlets(self) -> list[Listener | Target]:
        """Those that send more than the device's own messages: they are written from outside."""
        return [place for place in self._network.places if place.share.send != "raw"]

    def heard(self, data: bytes) -> None:
        """Bytes of the device; none where nothing came for a while. Of the thread that reads it."""
        messages = self._splitter.feed(data) if data else self._splitter.silence()
        if messages:
            self._ports.measured(b"".join(messages))
            self._network.raw(messages)

    def send(self, item: SendToClient) -> None:
        """An answer for the program on one port."""
        self._ports.send(item)

    def announced(self) -> list[tuple[int, str]]:
        """What a person should hear at the start, with the level of the log."""
        names = ", ".join(
            share.name if share.pty is not None else f"{share.name} ({share.send})"
            for share in self._sections
        )
        open_ = [share.name for share in self._sections if share.other_hosts]
        warning = f"other machines can read the device at {', '.join(open_)} (other_hosts = true)"
        lines = [(logging.INFO, f"the device is shared on {names}")]
        return [*lines, (logging.WARNING, warning)] if open_ else lines

    def facts(self) -> tuple[ShareFacts, ...]:
        """How each stands, in the order of the configuration."""
        found = {fact.name: fact for fact in (*self._ports.facts(), *self._network.facts())}
        return tuple(found[share.name] for share in self._sections if share.name in found)

    def close(self) -> None:
        """Take them away; safe to call again."""
        self._ports.close()
        self._network.close()
