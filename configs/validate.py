"""Turns plain mappings (from YAML or the command line) into frozen dataclasses, refusing what they do not declare.

Library code never sees a DictConfig: `build` is the only door. A wrong key, type or value stops at once with the path of the
offending entry and the allowed ones.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
#: Longest list of allowed values that is printed whole.
_LISTED: Final = 60


class ConfigError(ValueError):
    """A configuration entry that is not allowed; the message names its path, its value and what is allowed."""


def allowed_values(value: object, allowed: Iterable[object]) -> str:
    """The second half of a message that refuses a value: what is allowed, and the nearest of it to what was given."""
    names = [str(name) for name in allowed]
    near = difflib.get_close_matches(str(value), names, n=1, cutoff=0.6)
    listed = names if len(names) <= _LISTED else (*names[:5], f"… ({len(names)} in all)")
    return f"allowed: {', '.join(listed) or 'none'}" + (f"; did you mean {near[0]!r}?" if near else "")


def build(cls: type[T], values: Mapping[str, Any], where: str = "") -> T:
    """Builds the frozen dataclass `cls` from a mapping.

    Args:
        cls: a dataclass; nested dataclasses, enums, Literal, tuples, frozensets, Optional and plain scalars are understood.
        values: plain mapping with string keys; where a field may be one of several dataclasses, its `kind` says which.
        where: dotted path of this mapping in the whole configuration, for messages.

    Raises:
        ConfigError: on an unknown key, a missing required key, or a value of the wrong type or outside the allowed set.
    """
    if not dataclasses.is_dataclass(cls):
        raise TypeError(f"{cls!r} is not a dataclass")
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where or cls.__name__}: expected a mapping, got {values!r}")
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    unknown = [key for key in values if key not in fields]
    if unknown:
        of = f" with kind {values['kind']!r}" if {"kind"} <= values.keys() & fields.keys() else ""
        raise ConfigError(f"{_at(where, str(unknown[0]))}: unknown key{of}; {allowed_values(unknown[0], sorted(fields))}")
    hints = get_type_hints(cls)
    kwargs: dict[str, Any] = {}
    for name, f in fields.items():
        if name in values:
            kwargs[name] = _convert(hints[name], values[name], _at(where, name))
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{_at(where, name)}: missing")
    try:
        return cls(**kwargs)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{where or cls.__name__}: {error}") from error


def _of_kind(schemas: Sequence[Any], kind: object, where: str) -> Any:
    """The one of several dataclasses whose field `kind` takes a value."""
    found = {one: schema for schema in schemas for one in get_args(get_type_hints(schema)["kind"])}
    if kind not in found:
        raise ConfigError(f"{_at(where, 'kind')}: {kind!r} is not allowed; {allowed_values(kind, found)}")
    return found[kind]


def _at(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = get_origin(hint)
    if hint is Any:
        return value
    if origin is Literal:
        allowed = get_args(hint)
        # YAML 1.1 reads on/off/yes/no as booleans.
        if value not in allowed or isinstance(value, bool) != isinstance(allowed[0], bool):
            raise ConfigError(f"{where}: {value!r} is not allowed; {allowed_values(value, allowed)}")
        return value
    if origin in (Union, types.UnionType):
        options = get_args(hint)
        if value is None and type(None) in options:
            return None
        schemas = [option for option in options if dataclasses.is_dataclass(option)]
        if len(schemas) > 1 and isinstance(value, Mapping):
            return build(_of_kind(schemas, value.get("kind"), where), value, where)
        errors: list[str] = []
        for option in options:
            if option is type(None):
                continue
            try:
                return _convert(option, value, where)
            except ConfigError as error:
                errors.append(str(error))
        raise ConfigError("; ".join(errors))
    if origin is tuple:
        if isinstance(value, str) or not hasattr(value, "__iter__"):
            raise ConfigError(f"{where}: expected a list, got {value!r}")
        items, args = list(value), get_args(hint)
        if len(args) == 2 and args[1] is Ellipsis:
            return tuple(_convert(args[0], item, f"{where}[{i}]") for i, item in enumerate(items))
        if len(items) != len(args):
            raise ConfigError(f"{where}: expected {len(args)} entries, got {value!r}")
        return tuple(_convert(arg, item, f"{where}[{i}]") for i, (arg, item) in enumerate(zip(args, items, strict=True)))
    if origin is frozenset:
        if isinstance(value, str) or not hasattr(value, "__iter__"):
            raise ConfigError(f"{where}: expected a list, got {value!r}")
        return frozenset(_convert(get_args(hint)[0], item, where) for item in value)
    if origin in (dict, Mapping) or getattr(origin, "__name__", "") == "Mapping":
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where}: expected a mapping, got {value!r}")
        key_hint, value_hint = get_args(hint)
        return {_convert(key_hint, k, where): _convert(value_hint, v, f"{where}.{k}") for k, v in value.items()}
    if isinstance(hint, type):
        if dataclasses.is_dataclass(hint):
            return value if isinstance(value, hint) else build(hint, value, where)
        if issubclass(hint, Enum):
            try:
                return hint(value)
            except ValueError:
                members = [member.value for member in hint]
                raise ConfigError(f"{where}: {value!r} is not allowed; {allowed_values(value, members)}") from None
        if hint is Path and isinstance(value, (str, Path)):
            return Path(value)
        if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
        if isinstance(value, hint) and not (hint is not bool and isinstance(value, bool)):
            return value
        raise ConfigError(f"{where}: expected {hint.__name__}, got {value!r}")
    raise TypeError(f"{where}: unsupported type {hint!r} in a config dataclass")
