"""Where a server is: a URL that can be asked, and whether it is this machine's. Paper: none (engineering)."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit

from proprio_mllm.backends.protocol import BackendSetupError

__all__ = ["checked_url", "on_this_machine"]


def checked_url(url: str, backend: str) -> str:
    """The URL itself.

    Args:
        url: of a server.
        backend: whose it is, for messages.

    Raises:
        BackendSetupError: when it cannot be asked, or holds a user, a password or a query, where keys are put.
    """
    if "@" in url or "?" in url:
        raise BackendSetupError(f"backend {backend}: base_url holds a user or a query; a key belongs in the environment")
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        usable = False
    if not usable or not url.isascii() or any(character.isspace() for character in url):
        raise BackendSetupError(f"backend {backend}: base_url {url!r} is not allowed; allowed: http(s)://HOST[:PORT]/PATH")
    return url


def on_this_machine(url: str) -> bool:
    """Whether a URL's host is loopback."""
    host = urlsplit(url).hostname or ""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
