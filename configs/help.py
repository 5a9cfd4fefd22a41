"""`--help` of the entry points: the groups with their values, and every field with what it means and what it is by default.

Meanings come from the `Attributes:` sections of the schemas' docstrings, so that there is one text for both.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import textwrap
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import yaml

from configs.compose import CONFIG_DIR, compose, groups

_WIDTH: Final = 110
#: Stands for a field that has no default.
_UNSET: Final = object()
_ENTRY: Final = re.compile(r"^(\w+(?:, \w+)*): (.*)$")


def asks_for_help(arguments: typing.Sequence[str]) -> bool:
    """Whether `-h` or `--help` is among the arguments."""
    return any(argument in ("-h", "--help") for argument in arguments)


def shows_help(arguments: typing.Sequence[str], text: str | None) -> bool:
    """Prints a text, such as a module's docstring, when help is asked for; whether it was."""
    asked = asks_for_help(arguments)
    if asked:
        sys.stdout.write(f"{(text or '').strip()}\n")
    return asked


def help_text(root: str, schema: type, about: str) -> str:
    """What a command takes.

    Args:
        root: name of its root file, `train` or `eval`.
        schema: its frozen configuration.
        about: the command's own description.
    """
    values = compose(root)
    lines = [*textwrap.dedent(about).strip().splitlines(), "", "Groups (`group=value`):", ""]
    defaults = yaml.safe_load((CONFIG_DIR / f"{root}.yaml").read_text(encoding="utf-8"))["defaults"]
    for name in (name for entry in defaults if isinstance(entry, dict) for name in entry if name in groups()):
        lines += _entry(name, ", ".join(groups()[name]), 2, 16)
    lines += ["", "Fields (`field=value`; of a group `group.field=value`) and their defaults:", ""]
    for name, default, meaning in _fields(schema, values, ""):
        lines += _entry(f"{name}={default}", meaning, 2, 44)
    return "\n".join(lines) + "\n"


def tool_help(schema: type, about: str) -> str:
    """What a command without groups takes.

    Args:
        schema: its configuration.
        about: the command's own description.
    """
    lines = [*textwrap.dedent(about).strip().splitlines(), "", "Arguments (`key=value`) and their defaults:", ""]
    for name, default, meaning in _fields(schema, {}, ""):
        lines += _entry(f"{name}={default}", meaning, 2, 44)
    return "\n".join(lines) + "\n"


def _entry(head: str, text: str, indent: int, column: int) -> list[str]:
    first = " " * indent + head
    start = f"{first:<{column}}" if len(first) < column else f"{first}  "
    return textwrap.wrap(text, _WIDTH, initial_indent=start, subsequent_indent=" " * column) or [first]


def _fields(schema: type, values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, str, str]]:
    """Name, default and meaning of every field; fields of nested configurations follow theirs."""
    meanings, kinds = _meanings(schema), typing.get_type_hints(schema)
    for field in dataclasses.fields(schema):
        value = values.get(field.name, _default(field))
        meaning = meanings.get(field.name, "")
        nested = [kind for kind in (kinds[field.name], *typing.get_args(kinds[field.name])) if _is_schema(kind)]
        if nested and isinstance(value, Mapping):
            yield from _of_kinds(nested, value, f"{prefix}{field.name}.")
            continue
        allowed = typing.get_args(kinds[field.name]) if typing.get_origin(kinds[field.name]) is typing.Literal else ()
        if allowed:
            meaning = f"{meaning.rstrip('.')} [{', '.join(map(str, allowed))}]"
        yield prefix + field.name, _shown(value), meaning.strip()
        if nested and value is None:  # a group that is not chosen; its fields as its files leave them
            yield from _of_kinds(nested, {}, f"{prefix}{field.name}.")


def _of_kinds(schemas: Sequence[type], values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, str, str]]:
    """Fields of a configuration that may be one of several; those that some kinds alone have say so."""
    found: dict[str, tuple[str, str]] = {}
    users: dict[str, list[str]] = {}
    for schema in schemas:
        for name, default, meaning in _fields(schema, values, prefix):
            found.setdefault(name, (default, meaning))
            users.setdefault(name, []).extend(typing.get_args(typing.get_type_hints(schema).get("kind")))
    kinds = users.get(f"{prefix}kind", [])
    for name, (default, meaning) in found.items():
        if len(schemas) > 1 and name == f"{prefix}kind":
            meaning = f"{meaning.partition(' [')[0]} [{', '.join(kinds)}]"
        yield (
            name,
            default,
            meaning if len(users[name]) == len(kinds) else f"{meaning.rstrip('.')} (kind {', '.join(users[name])})",
        )


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return _UNSET if field.default is dataclasses.MISSING else field.default


def _is_schema(kind: object) -> bool:
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _shown(value: object) -> str:
    if value is _UNSET:
        return "…"
    if value is None or value == "":
        return "null" if value is None else "''"
    if isinstance(value, bool):
        return str(value).lower()
    return "[" + ", ".join(_shown(one) for one in value) + "]" if isinstance(value, list | tuple) else str(value)


def _meanings(schema: type) -> dict[str, str]:
    """Texts of a docstring's `Attributes:` section by field, those of the classes it extends included."""
    _, _, section = textwrap.dedent((schema.__doc__ or "").partition("\n")[2]).partition("Attributes:\n")
    found: dict[str, str] = {name: text for base in schema.__bases__ for name, text in _meanings(base).items()}
    names: tuple[str, ...] = ()
    for line in section.splitlines():
        if line and not line.startswith(" "):
            break
        entry = _ENTRY.match(line[4:]) if line.startswith("    ") and not line.startswith("     ") else None
        if entry is not None:
            names = tuple(entry[1].split(", "))
            found |= dict.fromkeys(names, entry[2])
        else:
            found |= {name: f"{found[name]} {line.strip()}".strip() for name in names}
    return found
