"""Where a command that serves listens: the address that was given, and how it stands in a URL."""

from __future__ import annotations

import ipaddress

import click

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


def ip_address(text: str) -> IpAddress:
    """The address of --address.  click.UsageError where it is none."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        raise click.UsageError(f"--address {text}: must be an IP address") from None


def in_url(address: IpAddress, port: int) -> str:
    """`127.0.0.1:9191`, `[::1]:9191`."""
    return f"[{address}]:{port}" if address.version == 6 else f"{address}:{port}"
