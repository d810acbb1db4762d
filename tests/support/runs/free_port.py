"""A port of this machine for a server that a test starts later, or stops and starts again.

Not one that the system gives out by itself (`/proc/sys/net/ipv4/ip_local_port_range`): while the
server is down any connection may be given it, and who connects again and again until the server
listens may be given it as well, and is then connected to itself.
"""

from __future__ import annotations

import random
import socket

#: below the ports that Linux, macOS and Windows give out, above those of services
PORTS = range(15_000, 32_000)


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port of 127.0.0.1 that nobody uses now."""
    draw = random.SystemRandom()
    while True:
        port = draw.choice(PORTS)
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:  # in use: another one
                continue
        return port
