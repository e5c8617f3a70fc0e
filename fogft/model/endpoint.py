"""Where a proxy is reached: ``host:port``. Pure."""

from __future__ import annotations


def is_endpoint(text: str) -> bool:
    """Whether this is ``host:port``; an IPv6 address stands in brackets."""
    host, _, port = text.rpartition(":")
    in_brackets = host.startswith("[") and host.endswith("]")
    if not host or not (in_brackets or ":" not in host) or not host.isascii():
        return False
    return len(port) <= 5 and port.isascii() and port.isdigit() and 0 < int(port) < 65_536
