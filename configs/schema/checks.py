"""What the schemas check themselves with."""

from __future__ import annotations

import functools
import ipaddress
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any


def require(condition: bool, message: str) -> None:
    """Refuses a value.

    Raises:
        ValueError: with the message, when the condition does not hold.
    """
    if not condition:
        raise ValueError(message)


@functools.cache
def defaults_of(schema: type) -> dict[str, Any]:
    """Plain defaults of a schema's fields; fields without one are left out."""
    return {field.name: field.default for field in fields(schema) if field.default is not MISSING}


def require_used(cfg: Any, of_kinds: Mapping[str, Sequence[str]]) -> None:
    """Refuses values that a configuration's `kind` would ignore.

    Args:
        cfg: a schema with a field `kind`.
        of_kinds: the kinds that use a field, by field; with others it keeps its default.

    Raises:
        ValueError: on another value; the message names what is allowed.
    """
    for name, kinds in of_kinds.items():
        value, default = getattr(cfg, name), defaults_of(type(cfg))[name]
        require(
            cfg.kind in kinds or value == default,
            f"kind {cfg.kind!r} with {name} {value!r}; allowed: {default!r}, others with {', '.join(kinds)}",
        )


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an interface."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
