"""Pictures of retargeting: the human skeleton above, each robot below, at a few instants of a clip.

    python -m sim.tools.motion_look 2 9 12      # numbers of generated clips; pictures go to outputs/look

Paper: none; to look at what the numbers cannot show.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from data.generator import generate_clip
from data.retarget import Retargeter
from data.skeleton import CHAINS, HumanMotion
from sim.robots.spec import load_robot

__all__ = ["main", "stage", "strip"]

mpl.use("Agg")
_SIZE = 240
_EXTENT_M = 2.5


def _human(joints: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.uint8]:
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(3, 3), dpi=_SIZE // 3)
    axes: Any = figure.add_axes((0, 0, 1, 1), projection="3d")
    for chain in CHAINS:
        points = joints[list(chain)]
        axes.plot(*points.T, color="tab:red" if chain[-1] in (10, 20) else "tab:blue", linewidth=2)  # left is red
    axes.set(xlim=centre[0] + np.array([-0.75, 0.75]), ylim=centre[1] + np.array([-0.75, 0.75]), zlim=(0.0, 1.9))
    axes.set_box_aspect((1.5, 1.5, 1.9), zoom=1.3)
    axes.view_init(elev=8, azim=35)
    axes.set_axis_off()
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
    plt.close(figure)
    return picture


def stage(mjcf: Path | None = None, chequered: bool = False) -> mujoco.MjModel:
    """A lit floor below a plain sky, with the robot of an MJCF file; chequered in squares of half a metre on demand."""
    spec = mujoco.MjSpec() if mjcf is None else mujoco.MjSpec.from_file(str(mjcf))
    floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[4, 4, 0.1], rgba=[0.8, 0.8, 0.8, 1])
    if chequered:
        spec.add_texture(
            name="squares", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            width=64, height=64, rgb1=[0.80, 0.82, 0.84], rgb2=[0.66, 0.69, 0.72],
        )  # fmt: skip
        textures = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
        textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "squares"
        spec.add_material(name="squares", textures=textures, texrepeat=[1.0, 1.0], texuniform=True)
        stat: Any = spec.stat
        stat.extent = _EXTENT_M  # the same haze at the horizon for every figure
        floor.material, floor.size, floor.rgba = "squares", [0.0, 0.0, 0.1], [1.0, 1.0, 1.0, 1.0]
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        width=32, height=32, rgb1=[0.93, 0.94, 0.96],
    )  # fmt: skip
    for side in (-1.0, 1.0):
        spec.worldbody.add_light(
            pos=[3.0, 2.0 * side, 3.0],
            dir=[-0.7, -0.5 * side, -0.6],
            type=int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL),
            castshadow=False,
        )
    return spec.compile()


def _robot(retargeter: Retargeter, clip: HumanMotion, frames: list[int]) -> list[NDArray[np.uint8]]:
    motion = retargeter(clip).motion
    assert motion.root_pose is not None
    assert motion.joint_positions is not None
    model = stage(retargeter.spec.mjcf_path)
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    scale = retargeter.spec.standing_pelvis_height_m
    camera.distance, camera.azimuth, camera.elevation = 3.4 * scale, 215.0, -8.0
    pictures = []
    with mujoco.Renderer(model, _SIZE, _SIZE) as renderer:
        for frame in frames:
            pose = motion.root_pose[frame]
            data.qpos[:7] = pose
            for name, value in zip(retargeter.robot.joint_names, motion.joint_positions[frame], strict=True):
                data.qpos[model.joint(name).qposadr[0]] = value
            mujoco.mj_forward(model, data)
            camera.lookat[:] = [pose[0], pose[1], 0.9 * scale]
            renderer.update_scene(data, camera)
            pictures.append(renderer.render().copy())
    return pictures


def strip(clip: HumanMotion, retargeters: list[Retargeter], columns: int = 7) -> NDArray[np.uint8]:
    """One picture: the human in the first row, one robot in each further row, time to the right."""
    frames = [int(f) for f in np.linspace(0, len(clip.joints) - 1, columns)]
    rows = [[_human(clip.joints[f], clip.joints[f, 0]) for f in frames]]
    rows += [_robot(retargeter, clip, frames) for retargeter in retargeters]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0)


def main(numbers: list[int], folder: Path) -> list[Path]:
    """Writes a strip for each generated clip; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    retargeters = [Retargeter(load_robot(name)) for name in ("h1", "x1")]
    paths = []
    for number in numbers:
        path = folder / f"motion_{number:04d}.png"
        Image.fromarray(strip(generate_clip(0, number), retargeters)).save(path)
        paths.append(path)
    return paths


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        "python -m sim.tools.motion_look", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("numbers", nargs="*", type=int, default=[0, 8, 12])
    main(parser.parse_args().numbers, Path("outputs/look"))
