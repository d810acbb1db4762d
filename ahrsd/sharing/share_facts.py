"""How a share stands, for the status."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ShareFacts:
    """One `[[share]]`.

    send:    what it sends: measurements and answers where it is empty (a pty)
    readers: programs that have it open; None where nobody knows (udp)
    lost_bytes: of whole messages that a reader did not take in time
    turned_away: connections beyond the limit; ignored_bytes: what readers of tcp sent
    """

    name: str
    send: str = ""
    readers: int | None = 0
    lost_bytes: int = 0
    turned_away: int = 0
    ignored_bytes: int = 0
    fault: str = ""
