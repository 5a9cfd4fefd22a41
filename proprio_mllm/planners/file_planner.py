"""A user's own planner: a class in a Python file, named `FILE.py:CLASS`.

The class is made without arguments and is a `Planner`: `privileged = False`, `image_size`, `reset`, `step`. It sees what every
planner sees, observations and feedback. The file runs with the rights of the user, as any script. Paper: none (engineering).
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import sys
from pathlib import Path
from types import ModuleType

from data.files import file_hash
from proprio_mllm.planners.protocol import Planner

__all__ = ["PlannerFileError", "load_planner", "source_digest", "split_source"]


class PlannerFileError(ValueError):
    """A planner that cannot be made from its file; the message names the file and what is wrong."""


def split_source(source: str) -> tuple[Path, str]:
    """File and class of `FILE.py:CLASS`.

    Raises:
        PlannerFileError: when it is not of that form.
    """
    file, _, name = source.rpartition(":")
    if not file.endswith(".py") or not name.isidentifier():
        raise PlannerFileError(f"planner.source={source!r} is not allowed; allowed: FILE.py:CLASS")
    return Path(file), name


def load_planner(source: str) -> Planner:
    """A new planner of a file's class. The file's folder can be imported from, as when Python runs a script.

    Raises:
        PlannerFileError: when the file cannot be run, or has no such class, or the class is no planner.
    """
    path, name = split_source(source)
    if not path.is_file():
        raise PlannerFileError(f"planner.source={source!r}: there is no file {path}")
    module = _module(path)
    found = getattr(module, name, None)
    if not inspect.isclass(found):
        own = sorted(k for k, v in vars(module).items() if inspect.isclass(v) and v.__module__ == module.__name__)
        raise PlannerFileError(f"{path} has no class {name!r}; it has: {', '.join(own) or 'none'}")
    try:
        planner = found()
    except Exception as error:
        raise PlannerFileError(f"{path}: {name}() failed: {type(error).__name__}: {error}") from error
    wanted = {"privileged": bool, "image_size": int}
    missing = [f"{key} ({kind.__name__})" for key, kind in wanted.items() if not isinstance(getattr(planner, key, None), kind)]
    missing += [f"{key}()" for key in ("reset", "step") if not callable(getattr(planner, key, None))]
    if missing or not isinstance(planner, Planner):
        raise PlannerFileError(f"{path}: {name} is no planner; it lacks {', '.join(missing)}")
    if planner.privileged:
        raise PlannerFileError(f"{path}: {name}.privileged must be False: a planner from a file sees observations only")
    return planner


def source_digest(source: str) -> str:
    """Short hash of a loaded planner's file, its class's name, and the modules beside and below it that are imported."""
    path, name = split_source(source)
    root = path.resolve().parent
    loaded = {Path(file).resolve() for module in list(sys.modules.values()) if (file := getattr(module, "__file__", None))}
    beside = {file for file in loaded if file.is_relative_to(root) and "site-packages" not in file.parts}
    parts = [f"{file.relative_to(root)} {file_hash(file)}" for file in sorted({path.resolve(), *beside})]
    return hashlib.sha256("\n".join([*parts, name]).encode()).hexdigest()[:16]


def _module(path: Path) -> ModuleType:
    path = path.resolve()
    name = f"planner_file_{path.stem}"
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
        raise PlannerFileError(f"{path} cannot be run: {type(error).__name__}: {error}") from error
    return module
