"""Command lines of reports: names first (runs, a task), then `key=value` options that `configs.arguments` checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from configs.arguments import read_arguments
from configs.help import asks_for_help
from configs.validate import ConfigError

__all__ = ["read_named"]

T = TypeVar("T")


def read_named(cls: type[T], arguments: Sequence[str], names: tuple[str, ...], more: bool = False) -> tuple[list[str], T]:
    """Splits a command line into names and options.

    Args:
        cls: dataclass of the options.
        arguments: of the command line.
        names: what the names stand for, for messages.
        more: whether the last one may be given several times.

    Raises:
        SystemExit: after `-h` or `--help`, with code 0.
        ConfigError: on too few or too many names, or a wrong option.
    """
    if asks_for_help(arguments):
        read_arguments(cls, arguments)
    given = [argument for argument in arguments if "=" not in argument]
    if len(given) < len(names) or (len(given) > len(names) and not more):
        expected = " ".join(names) + (f" [{names[-1]} ...]" if more else "")
        raise ConfigError(f"expected {expected} [key=value ...], got {' '.join(arguments) or 'nothing'}")
    return given, read_arguments(cls, [argument for argument in arguments if "=" in argument])
