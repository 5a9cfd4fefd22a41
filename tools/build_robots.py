"""Makes the robots' MJCF under `robots/assets/` again: `python tools/build_robots.py [h1|x1] [--menagerie DIR]`."""

from __future__ import annotations

import argparse
from pathlib import Path

from robots.build import ASSETS, find_menagerie
from robots.build_x1 import build_x1


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
            from robots.build_h1 import build_h1  # needs the `assets` extra

            build_h1(args.menagerie or find_menagerie(), ASSETS / "h1_kinematics.csv", args.target / "h1")
        else:
            parser.error(f"unknown robot {robot!r}; allowed: h1, x1")


if __name__ == "__main__":
    main()
