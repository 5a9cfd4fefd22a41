"""A robot of one's own, for tests."""

from __future__ import annotations

from pathlib import Path

import yaml

from robots.spec import load_robot


def write_third_robot(folder: Path) -> None:
    """Writes robots/stubby.yaml and .xml into `folder`: the X1 under another name, with a lighter load."""
    mjcf = load_robot("x1").mjcf_path
    values = yaml.safe_load((mjcf.parents[2] / "specs" / "x1.yaml").read_text(encoding="utf-8"))
    values |= {"name": "stubby", "mjcf": "stubby.xml", "two_arm_max_load_kg": 6.0}
    robots = folder / "robots"
    robots.mkdir(parents=True)
    (robots / "stubby.xml").write_text(mjcf.read_text(encoding="utf-8"), encoding="utf-8")
    (robots / "stubby.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
