"""Prints THIRD_PARTY.md: assets by hand, every locked package with the licence it declares (`make third-party`)."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

ASSETS = """# Third-party material

## Assets and data in this repository

| what | from | licence |
|---|---|---|
| `robots/assets/h1/` (kinematics, simplified meshes) | google-deepmind/mujoco_menagerie `unitree_h1` | BSD-3-Clause |
| `robots/assets/h1_kinematics.csv` (hands of `h1_with_hand.urdf`) | unitreerobotics/unitree_ros | BSD-3-Clause |
| `robots/assets/x1_kinematics.csv` (kinematics; geometry is ours) | AgibotTech/agibot_x1_infer | Mulan PSL v2 |
| PHC's clip filter list (`data/assets/`) | ZhengyiLuo/PHC label list, keyed by HumanML3D clip id | BSD-3-Clause |
| object dimensions and masses (`sim/`) | measured from AI2-THOR's metadata | Apache-2.0 |
| figures printed in the paper | the paper, quoted as figures | cited |

Rooms, objects, textures, motions, captions, tasks and weights are made by this project's own code.

## Not in this repository, used from a path or a package that you give

| what | licence |
|---|---|
| Qwen2.5-VL-7B-Instruct weights | Apache-2.0 |
| HumanML3D, AMASS, SMPL | their own licences, non-commercial |
| smplx 0.1.28 (extra `motion`) | its own licence, non-commercial research |
| CUT3R code and checkpoint | CC BY-NC-SA 4.0: imported from your checkout, nothing copied |
| real motion clips of `make motions` (holosoma-retargeting 0.1.0, data only) | Apache-2.0 |

## Python packages of `requirements.lock`

| package | version | licence |
|---|---|---|
"""


def licence_of(distribution: metadata.Distribution) -> str:
    """The licence as the package declares it: expression, then classifier, then the first line of the free text."""
    fields = distribution.metadata
    if "License-Expression" in fields:
        return fields["License-Expression"]
    classifiers = [c.split("::")[-1].strip() for c in fields.get_all("Classifier") or [] if c.startswith("License ::")]
    if classifiers:
        return ", ".join(classifiers)
    text = "".join(fields.get_all("License") or []).strip().splitlines()
    return text[0][:60] if text else "see its own files"


def main() -> None:
    """Writes the Markdown page to standard output."""
    locked = Path(__file__).parents[1].joinpath("requirements.lock").read_text(encoding="utf-8")
    rows = []
    for line in locked.splitlines():
        name, sep, version = line.partition("==")
        if sep:
            rows.append(f"| {name} | {version} | {licence_of(metadata.distribution(name))} |")
    sys.stdout.write(ASSETS + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
