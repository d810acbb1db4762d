"""Addresses of network shares: an IP address and a port, in numbers; nothing is looked up."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass

_FORM = re.compile(r"(?:\[(?P<six>[^\]]+)\]|(?P<four>[^:\[\]]+)):(?P<port>\d{1,5})")


@dataclass(frozen=True, slots=True)
class Address:
    """Where to listen or to send. `text` is how a person wrote it."""

    text: str
    ip: ipaddress.IPv4Address | ipaddress.IPv6Address
    port: int

    @staticmethod
    def parse(key: str, text: str) -> Address:
        """From `127.0.0.1:2101` or `[::1]:2101`. Raises ValueError, which names the key."""
        example = "write an IP address and a port, such as 127.0.0.1:2101 or [::1]:2101"
        found = _FORM.fullmatch(text)
        if found is None:
            raise ValueError(f"{key} = {text!r}: {example}")
        try:
            ip = ipaddress.ip_address(found["six"] or found["four"])
        except ValueError:
            hint = "; a name is not looked up" if found["four"] else ""
            raise ValueError(f"{key} = {text!r}: {example}{hint}") from None
        if (ip.version == 6) != (found["six"] is not None):
            raise ValueError(f"{key} = {text!r}: {example}")
        port = int(found["port"])
        if not 1 <= port <= 65535:
            raise ValueError(f"{key} = {text!r}: a port is 1 to 65535")
        return Address(text, ip, port)

    def check(self, key: str, *, other_hosts: bool) -> None:
        """Raise ValueError where this cannot be meant, or needs a word that was not given."""
        if key == "udp" and self.ip.is_unspecified:
            raise ValueError(f"{key} = {self.text!r}: nobody is there; name whom to send to")
        if key == "tcp" and self.ip.is_multicast:
            raise ValueError(f"{key} = {self.text!r}: a group of hosts, for udp only")
        if not self.ip.is_loopback and not other_hosts:
            what = "would leave this machine" if key == "udp" else "could be read by other machines"
            raise ValueError(
                f"{key} = {self.text!r}: what is sent {what}; write other_hosts = true if that is "
                "meant, or choose an address of this machine alone, such as 127.0.0.1"
            )

    @property
    def family(self) -> socket.AddressFamily:
        """For `socket.socket`."""
        return socket.AF_INET6 if self.ip.version == 6 else socket.AF_INET

    @property
    def place(self) -> tuple[str, int]:
        """For `bind` and `sendto`."""
        return str(self.ip), self.port
