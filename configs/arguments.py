"""Command lines of tools that take a few `key=value` arguments and no config groups: values are YAML, checked by `build`.

`--help` among them prints what there is and ends the program, as `argparse` does.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any, TypeVar

import yaml

from configs.help import asks_for_help, tool_help
from configs.validate import ConfigError, build

__all__ = ["read_arguments"]

T = TypeVar("T")


def read_arguments(cls: type[T], arguments: Sequence[str]) -> T:
    """Builds the dataclass `cls` from arguments such as `count=600` or `robots=[h1,x1]`.

    Raises:
        SystemExit: after `-h` or `--help`, with code 0.
        ConfigError: on an argument of another form, one that is given twice, an unknown key, or a wrong value.
    """
    if asks_for_help(arguments):
        sys.stdout.write(tool_help(cls, sys.modules[cls.__module__].__doc__ or ""))
        raise SystemExit(0)
    allowed = ", ".join(f.name for f in dataclasses.fields(cls))  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for argument in arguments:
        key, sign, text = argument.partition("=")
        if not sign:
            raise ConfigError(f"{argument!r} is not key=value; keys: {allowed}")
        if key in values:
            raise ConfigError(f"{key} is given twice")
        try:
            values[key] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ConfigError(f"{argument!r}: the value cannot be read") from None
    return build(cls, values)
