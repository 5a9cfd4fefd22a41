"""Where rooms, object types, robots and contingencies are read from: the project's files, and a folder of one's own.

The environment variable `DUALTHOR_ASSETS` names that folder. It may hold `rooms/NAME.yaml`, `types/NAME.yaml`,
`robots/NAME.yaml` and `contingency/NAME.yaml`, in the formats of the project's own files. What is there is added; a name that
the project has already is refused, so that no table can silently be about another room or robot than its name says.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from configs.validate import ConfigError

ASSETS_VARIABLE: Final = "DUALTHOR_ASSETS"
KINDS: Final = ("rooms", "types", "robots", "contingency")


def own_files(kind: str) -> dict[str, Path]:
    """YAML files of one kind in the user's folder, by name, sorted; none without the variable.

    Raises:
        ConfigError: when the folder does not exist or holds a folder that is no kind of asset.
        ValueError: on an unknown kind.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of asset {kind!r}; allowed: {', '.join(KINDS)}")
    root = os.environ.get(ASSETS_VARIABLE, "")
    if not root:
        return {}
    folder = Path(root).expanduser().resolve()
    if not folder.is_dir():
        raise ConfigError(f"{ASSETS_VARIABLE}={root!r} is not a folder")
    strange = sorted(
        path.name for path in folder.iterdir() if path.is_dir() and path.name[0] not in "._" and path.name not in KINDS
    )
    if strange:
        raise ConfigError(f"{ASSETS_VARIABLE}: folder {strange[0]!r} is no kind of asset; allowed: {', '.join(KINDS)}")
    return {path.stem: path for path in sorted((folder / kind).glob("*.yaml"))}


def asset_files(kind: str, project: Path) -> dict[str, Path]:
    """All files of one kind by name, the project's from its folder first, then the user's.

    Raises:
        ConfigError: as `own_files`, and when a file of the user has the name of one of the project's.
    """
    found = {path.stem: path for path in sorted(project.glob("*.yaml"))}
    for name, path in own_files(kind).items():
        if name in found:
            raise ConfigError(f"{path}: the project has a file {name!r} in {kind} already; choose another name")
        found[name] = path
    return found
