"""Composes the YAML groups with command-line overrides into one plain mapping, through Hydra.

The entry points call `compose` and hand the result to `configs.validate.build`; nothing else in the project knows Hydra. A
wrong group value or key stops here with the allowed ones; a wrong value of a plain key stops in `build`.
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
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from configs.assets import own_files
from configs.validate import ConfigError

__all__ = ["CONFIG_DIR", "compose", "group_file", "groups"]

CONFIG_DIR = Path(__file__).resolve().parent
#: Of these groups fields can be set that the group's file leaves at their defaults.
_OPEN = ("backend.", "planner.")


def groups() -> dict[str, tuple[str, ...]]:
    """The config groups (folders of `configs/`) with the values each allows, sorted."""
    found: dict[str, tuple[str, ...]] = {}
    for folder in sorted(path for path in CONFIG_DIR.iterdir() if path.is_dir()):
        names = tuple(sorted(path.stem for path in folder.glob("*.yaml")))
        if names:
            found[folder.name] = names
    return found


@functools.cache
def group_file(group: str, name: str) -> dict[str, Any]:
    """A group's file as it is written, nothing composed; empty when there is no such file."""
    path = CONFIG_DIR / group / f"{name}.yaml"
    return yaml.safe_load(path.read_text(encoding="utf-8")) if name.isidentifier() and path.is_file() else {}


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
        allowed = ", ".join(sorted(path.stem for path in CONFIG_DIR.glob("*.yaml")))
        raise ConfigError(f"no root config {root!r}; allowed: {allowed}")
    _check_groups(overrides)
    overrides = _add_fields(_name_own_robots(overrides))
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(CONFIG_DIR), version_base=None):
            config = hydra_compose(config_name=root, overrides=list(overrides))
            values = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_explain(error, root, overrides)) from error
    if not isinstance(values, dict):
        raise ConfigError(f"configs/{root}.yaml: expected a mapping, got {type(values).__name__}")
    return {str(key): value for key, value in values.items()}


def _name_own_robots(overrides: Sequence[str]) -> list[str]:
    """Spells `robot=NAME` out for a robot of the user's own assets, which has no file in `configs/robot`."""
    own = own_files("robots")
    spelled: list[str] = []
    for override in overrides:
        key, _, value = override.partition("=")
        if key.lstrip("+") == "robot" and value in own:
            spelled += [f"robot={groups()['robot'][0]}", f"robot.name={value}", f"robot.spec='{own[value]}'"]
        else:
            spelled.append(override)
    return spelled


def _add_fields(overrides: Sequence[str]) -> list[str]:
    """Lets fields be set that a group's file leaves at their defaults; `build` refuses those that do not exist."""
    return [f"++{override}" if override.startswith(_OPEN) else override for override in overrides]


def _check_groups(overrides: Sequence[str]) -> None:
    known = groups()
    known["robot"] = (*known["robot"], *own_files("robots"))
    for override in overrides:
        key, sep, value = override.partition("=")
        if not key.strip("+~") or (not sep and not key.startswith("~")):
            raise ConfigError(f"override {override!r}: expected key=value")
        name = key.lstrip("+")
        if name in known and value not in known[name]:
            raise ConfigError(f"{name}={value!r} is not allowed; allowed: {', '.join(known[name])}")


def _explain(error: Exception, root: str, overrides: Sequence[str]) -> str:
    if isinstance(error, MissingMandatoryValue) and error.full_key:
        return _missing(str(error.full_key), overrides)
    GlobalHydra.instance().clear()
    with initialize_config_dir(config_dir=str(CONFIG_DIR), version_base=None):
        try:
            config = hydra_compose(config_name=root)
        except (HydraException, OmegaConfBaseException):
            return f"configs/{root}.yaml does not compose: {_first_line(error)}"
    for override in overrides:
        key = override.partition("=")[0].lstrip("+~")
        if key in groups() or key.startswith(_OPEN):
            continue
        node: Any = config
        path: list[str] = []
        for part in key.split("."):
            if not isinstance(node, DictConfig) or part not in node:
                allowed = ", ".join(sorted(str(k) for k in node)) if isinstance(node, DictConfig) else "none"
                return f"{'.'.join([*path, part])}: unknown key in {override!r}; allowed: {allowed}"
            path.append(part)
            node = node[part] if not OmegaConf.is_missing(node, part) else None
    if isinstance(error, OverrideParseException):
        override = str(error.override).removeprefix("++")
        quoted = "\"key='value'\""  # for Hydra, and for the shell
        return f"override {override!r} cannot be read; a value with ()[]{{}}=~ or letters outside ASCII needs quotes: {quoted}"
    return _first_line(error)


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
