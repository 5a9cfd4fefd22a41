"""What this machine has of what the project needs, and what to do about the rest: `python -m sim doctor`.

Nothing is drawn in this process, so that a driver that crashes is a line of the report. Exit code 1 when something is missing
without which no episode runs.
"""

from __future__ import annotations

import ctypes.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from configs.arguments import EXTRAS, command, read_arguments
from data.files import cache_folder

#: Largest time for one drawing test, seconds.
_PATIENCE_S: Final = 20
#: Memory of an evaluation with two workers, gigabytes.
_MEMORY_GB: Final = 4
#: Of each backend, the library and the system packages that bring it.
_LIBRARIES: Final = {"egl": ("EGL", "libegl1 libgl1-mesa-dri"), "osmesa": ("OSMesa", "libosmesa6")}
_DRAW: Final = """
import mujoco
context = mujoco.GLContext(16, 16)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
mujoco.MjrContext(model, int(mujoco.mjtFontScale.mjFONTSCALE_50))
from OpenGL import GL
print(GL.glGetString(GL.GL_RENDERER).decode())
"""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report.

    Attributes:
        found: what is there.
        remedy: what to do; empty where nothing has to be done.
        fatal: whether no episode runs without it.
    """

    found: str
    remedy: str = ""
    fatal: bool = False


def _python() -> Finding:
    found = sys.version.split()[0]
    return Finding(found) if sys.version_info >= (3, 11) else Finding(found, "install Python 3.11 or newer", True)


def _packages() -> Finding:
    """What pyproject.toml asks for is there, in the versions that requirements.lock pins."""
    lock, project = Path("requirements.lock"), Path("pyproject.toml")
    if not (lock.is_file() and project.is_file()):
        return Finding("no requirements.lock and pyproject.toml here, nothing is compared")
    pins = dict(re.findall(r"^([\w.-]+)==([^\s;]+)", lock.read_text(encoding="utf-8"), re.MULTILINE))
    asked = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    groups = {"": asked["dependencies"]} | {name: asked["optional-dependencies"][name] for name in EXTRAS}
    absent = {group: [name for name in map(_name, wanted) if _version(name) is None] for group, wanted in groups.items()}
    if absent[""]:
        return Finding(f"missing: {', '.join(absent[''])}", "run `make setup`", True)
    here = {name: found for name in pins if (found := _version(name)) is not None}
    others = [f"{name} {found} (pinned {pins[name]})" for name, found in here.items() if found != pins[name]]
    if others:
        return Finding(f"other versions: {', '.join(others)}", "run `make setup` for the tested ones")
    without = [name for name in EXTRAS if absent[name]]
    return Finding(f"{len(here)} as pinned{', without the extras ' + ' and '.join(without) if without else ''}")


def _name(requirement: str) -> str:
    return re.split(r"[<>=!~\[; ]", requirement, maxsplit=1)[0]


def _version(name: str) -> str | None:
    try:
        return version(name).split("+")[0]
    except PackageNotFoundError:
        return None


def _draws(backend: str) -> Finding:
    """Whether a picture can be drawn with a backend."""
    library, packages = _LIBRARIES[backend]
    if ctypes.util.find_library(library) is None:
        return Finding(f"no library lib{library}", f"apt-get install {packages}")
    try:
        done = subprocess.run(
            [sys.executable, "-c", _DRAW],
            env=os.environ | {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
            capture_output=True,
            text=True,
            timeout=_PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Finding(f"no picture within {_PATIENCE_S} s", "set MUJOCO_GL to the other one")
    if done.returncode == 0:
        return Finding(done.stdout.strip())
    last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    return Finding(f"no picture: {last[:160]}", f"apt-get install {packages}")


def _cores() -> Finding:
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Finding(f"{count}") if count > 1 else Finding("1", "two make an evaluation twice as fast")


def _memory() -> Finding:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (AttributeError, OSError, ValueError):
        return Finding("unknown")
    return Finding(f"{total:.0f} GB", "" if total >= _MEMORY_GB else "use `workers=1`")


def _cache() -> Finding:
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return Finding(f"{folder}: {error.strerror}", "set XDG_CACHE_HOME to a folder that can be written")
    return Finding(str(folder))


def _torch() -> Finding:
    try:
        found = version("torch")
    except PackageNotFoundError:
        return Finding("none", "for models, `make setup` or the extra `train`; simulator, rules and expert do without")
    seen = "an NVIDIA driver is here" if shutil.which("nvidia-smi") else "no NVIDIA driver is here"
    return Finding(f"{found}, {seen}")


def _weights() -> Finding:
    found = sorted(path.parent.name for path in Path("weights").glob("*/*/config.json"))
    if not found:
        return Finding("none", "run from the repository's root, where weights/ is, or train: `python train.py stage=all`")
    return Finding(", ".join(found))


CHECKS: Final[dict[str, Callable[[], Finding]]] = {
    "python": _python,
    "packages": _packages,
    "egl": lambda: _draws("egl"),
    "osmesa": lambda: _draws("osmesa"),
    "cores": _cores,
    "memory": _memory,
    "cache": _cache,
    "torch": _torch,
    "weights": _weights,
}


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        quiet: only what is missing is printed.
    """

    quiet: bool = False


def examine() -> dict[str, Finding]:
    """Every check, side by side; that neither backend draws is fatal, that one does not is no fault."""
    with ThreadPoolExecutor() as pool:
        found = dict(zip(CHECKS, pool.map(lambda check: check(), CHECKS.values()), strict=True))
    drawing = [name for name in _LIBRARIES if not found[name].remedy]
    for name in _LIBRARIES:
        one = found[name]
        if one.remedy and drawing:
            found[name] = Finding(f"{one.found} (not needed: {drawing[0]} draws)")
        elif one.remedy:
            found[name] = Finding(one.found, one.remedy, True)
    return found


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code."""
    options = read_arguments(Options, arguments)
    found = examine()
    for name, one in found.items():
        if one.remedy or not options.quiet:
            sys.stdout.write(f"{'fault' if one.fatal else 'note ' if one.remedy else 'ok   '}  {name:<9} {one.found}\n")
        if one.remedy:
            sys.stdout.write(f"                 -> {one.remedy}\n")
    return int(any(one.fatal for one in found.values()))
