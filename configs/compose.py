"""Composes the YAML groups with overrides through Hydra, and says what is wrong with overrides that do not compose.

`configs.app` runs the entry points as Hydra applications; `compose` is the same composition for tests, notebooks and
benchmarks. Both hand a plain mapping to `configs.validate.build`; library code never sees Hydra. Robots of the user's own
assets are offered beside those of `configs/robot`.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from configs.assets import own_files
from configs.validate import ConfigError, allowed_values

CONFIG_DIR = Path(__file__).resolve().parent
#: What Hydra raises when overrides do not compose.
COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException)
#: A field of a part: it may be set although the part's file leaves it at the schema's default.
_FIELD = re.compile(r"(?!hydra\.)\w+(\.\w+)+=")


def groups(folder: Path = CONFIG_DIR) -> dict[str, tuple[str, ...]]:
    """The config groups (folders of `configs/`, or of the user's `--config-dir`) with the values each allows, sorted."""
    found: dict[str, tuple[str, ...]] = {}
    for group in sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else ():
        names = tuple(sorted(path.stem for path in group.glob("*.yaml")))
        if names:
            found[group.name] = names
    return found


@functools.cache
def group_file(group: str, name: str) -> dict[str, Any]:
    """A group's file as it is written, nothing composed; empty when there is no such file."""
    path = CONFIG_DIR / group / f"{name}.yaml"
    return yaml.safe_load(path.read_text(encoding="utf-8")) if name.isidentifier() and path.is_file() else {}


def register(help_text: str = "") -> None:
    """Adds to Hydra's groups what no file of `configs/` holds: the user's own robots, and the text of `--help`."""
    store = ConfigStore.instance().store
    for name, path in own_files("robots").items():
        store(group="robot", name=name, node={"name": name, "spec": str(path), "mjcf": None})
    node = {"app_name": "", "header": "", "footer": "", "template": help_text.replace("$", "$$")}
    store(group="hydra/help", name="fields", node=node)


def open_fields(overrides: Sequence[str]) -> list[str]:
    """Overrides that may set what a file leaves at its default; the schema refuses fields that do not exist.

    Raises:
        ConfigError: on an override without a key.
    """
    for override in overrides:
        if not override.partition("=")[0].strip("+~"):
            raise ConfigError(f"override {override!r}: expected key=value")
    return [f"++{override}" if _FIELD.match(override) else override for override in overrides]


def compose(root: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Composes `configs/<root>.yaml` with overrides such as `robot=x1` or `trials=3`.

    Args:
        root: name of a root file, `train` or `eval`.
        overrides: Hydra override strings.

    Returns:
        A plain nested dictionary, every interpolation resolved.

    Raises:
        ConfigError: on a malformed override, an unknown group, group value or key; the message lists what is allowed.
    """
    if not (CONFIG_DIR / f"{root}.yaml").is_file():
        roots = sorted(path.stem for path in CONFIG_DIR.glob("*.yaml"))
        raise ConfigError(f"no root config {root!r}; {allowed_values(root, roots)}")
    register()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(CONFIG_DIR), version_base=None):
            config = hydra_compose(config_name=root, overrides=open_fields(overrides))
            values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except COMPOSITION_ERRORS as error:
        raise ConfigError(explain(error, root, overrides)) from error
    if not isinstance(values, dict):
        raise ConfigError(f"configs/{root}.yaml: expected a mapping, got {type(values).__name__}")
    return {str(key): value for key, value in values.items()}


def explain(error: Exception, root: str, overrides: Sequence[str], own: Path | None = None) -> str:
    """What is wrong with overrides that did not compose, with what is allowed.

    Args:
        error: one of `COMPOSITION_ERRORS`.
        root: name of the root file.
        overrides: as the user gave them.
        own: the user's folder of groups, `--config-dir`.
    """
    known = groups() | {"robot": (*groups()["robot"], *own_files("robots"))}
    for group, names in (groups(own) if own is not None else {}).items():
        known[group] = (*known.get(group, ()), *names)
    for override in overrides:
        key, sep, value = override.partition("=")
        if not sep and not key.startswith("~"):
            return f"override {override!r}: expected key=value"
        name = key.lstrip("+")
        wrong = [one for one in value.split(",") if one not in known.get(name, (one,))]
        if wrong and isinstance(error, HydraException):
            return f"{name}={wrong[0]!r} is not allowed; {allowed_values(wrong[0], known[name])}"
    if isinstance(error, MissingMandatoryValue) and error.full_key:
        return _missing(str(error.full_key), overrides)
    if isinstance(error, OverrideParseException):
        override = str(error.override).removeprefix("++")
        quoted = "\"key='value'\""  # for Hydra, and for the shell
        return f"override {override!r} cannot be read; a value with ()[]{{}}=~ or letters outside ASCII needs quotes: {quoted}"
    return _unknown_key(root, overrides) or _first_line(error)


def _unknown_key(root: str, overrides: Sequence[str]) -> str:
    """The first key among the overrides that the configuration does not have."""
    GlobalHydra.instance().clear()
    with initialize_config_dir(config_dir=str(CONFIG_DIR), version_base=None):
        config = hydra_compose(config_name=root)
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key in groups() or _FIELD.match(f"{key}=") or key.startswith("hydra"):
            continue
        node: Any = config
        path: list[str] = []
        for part in key.split("."):
            if not isinstance(node, DictConfig) or part not in node:
                options = sorted(str(k) for k in node) if isinstance(node, DictConfig) else []
                return f"{'.'.join([*path, part])}: unknown key in {override!r}; {allowed_values(part, options)}"
            path.append(part)
            node = node[part] if not OmegaConf.is_missing(node, part) else None
    return ""


def _missing(key: str, overrides: Sequence[str]) -> str:
    """What to give for a value that a group's file leaves to the user, in the words of that file's first line."""
    group = key.partition(".")[0]
    given = {name.lstrip("+"): value for name, _, value in (override.partition("=") for override in overrides)}
    chosen = given.get(group, "")
    if not chosen and group == "backend":  # then the planner's file chooses it
        own = CONFIG_DIR / "planner" / f"{given.get('planner', '')}.yaml"
        found = re.search(r"/backend@\S+: (\w+)", own.read_text(encoding="utf-8")) if own.is_file() else None
        chosen = found[1] if found else ""
    path = CONFIG_DIR / group / f"{chosen}.yaml"
    about = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("#").strip() if path.is_file() else ""
    return f"{key} has no value; set {key}=…{f' ({chosen}: {about})' if about else ''}"


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
