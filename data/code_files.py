"""A user's own code: a class or a function in a Python file, named `FILE.py:NAME`.

The file runs with the rights of the user, as any script. Its folder can be imported from, as when Python runs a script.
Paper: none (engineering).
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

from data.files import file_hash


class CodeFileError(ValueError):
    """Code that cannot be used; the message names the file and what is wrong."""


def split_source(source: str, setting: str, kind: Literal["class", "function"]) -> tuple[Path, str]:
    """File and name of `FILE.py:NAME`.

    Args:
        source: where the code is.
        setting: which setting says so, for messages.
        kind: of the code.

    Raises:
        CodeFileError: when it is not of that form.
    """
    file, _, name = source.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        raise CodeFileError(f"{setting}={source!r} is not allowed; allowed: FILE.py:{kind.upper()}")
    return Path(file), name


def load_named(source: str, setting: str, kind: Literal["class", "function"]) -> Any:
    """Runs a file and gives its class or function of that name; arguments as of `split_source`.

    Raises:
        CodeFileError: when the file cannot be run, or has no such class or function.
    """
    path, name = split_source(source, setting, kind)
    if not path.is_file():
        raise CodeFileError(f"{setting}={source!r}: there is no file {path}")
    module = _module(path, f"{setting.partition('.')[0]}_file_{path.stem}")
    found = getattr(module, name, None)
    fits = inspect.isclass if kind == "class" else inspect.isfunction
    if not fits(found):
        own = sorted(k for k, v in vars(module).items() if fits(v) and v.__module__ == module.__name__)
        raise CodeFileError(f"{path} has no {kind} {name!r}; it has: {', '.join(own) or 'none'}")
    return found


def source_digest(source: str) -> str:
    """Short hash of a loaded file, the name in it, and the modules beside and below it that are imported."""
    file, _, name = source.rpartition(":")
    path = Path(file).resolve()
    root = path.parent
    loaded = {Path(file).resolve() for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))}
    beside = {file for file in loaded if file.is_relative_to(root) and "site-packages" not in file.parts}
    parts = [f"{file.relative_to(root)} {file_hash(file)}" for file in sorted({path, *beside})]
    return hashlib.sha256("\n".join([*parts, name]).encode()).hexdigest()[:16]


def _module(path: Path, name: str) -> ModuleType:
    path = path.resolve()
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise CodeFileError(f"{path} cannot be run: {type(error).__name__}: {error}") from error
    return module
