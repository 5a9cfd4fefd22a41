"""Films of retargeting: the human skeleton beside each robot, every frame of a clip, for a person to look at.

    python -m sim motion 2 9 robots=[h1,x1] out=outputs/films    # numbers of generated clips
    python -m sim motion 000021 dataset=HumanML3D                # ids of a folder in that format
    python -m sim motion walk_poses.npz body_models=models       # files: .npz (AMASS), .pt, .npy

All panels have the same scale and time; each camera goes along with its figure, and squares of half a metre on the floor show
how far it walks. Left limbs of the human are red. Robots are shown as retargeted: no gate is applied, nothing is simulated.

Paper: none; to look at what the numbers cannot show.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import imageio.v3 as iio
import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from configs.arguments import command, read_named
from configs.schema.checks import require
from configs.validate import allowed_values
from data.generator import generate_clip
from data.humanml3d import DatasetError, load_clip
from data.motion import FPS
from data.retarget import Retargeter
from data.skeleton import JOINTS, PARENTS, HumanMotion, index
from data.sources import SUFFIXES, load_file
from robots.spec import available_robots, load_robot

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
_WIDTH: Final = 320
_HEIGHT: Final = 400
_TITLE_LINES: Final = 3
_LINE_PX: Final = 20
#: Camera: distance to the figure (m), height of what it looks at (m), and frames over which it is smoothed.
_DISTANCE_M: Final = 3.3
_LOOK_M: Final = 0.95
_SMOOTH_FRAMES: Final = 6.0
_COLOURS: Final = {"left": (0.85, 0.25, 0.2, 1.0), "right": (0.2, 0.4, 0.85, 1.0), "": (0.35, 0.37, 0.42, 1.0)}
_BONE_M: Final = 0.035
_HEAD_M: Final = 0.10


#: Half the width of what a camera sees, metres.
_EXTENT_M: Final = 2.5


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


def find_clip(name: str, dataset: Path | None, body_models: Path | None) -> HumanMotion:
    """A clip by what a person types: a file, an id of a folder in HumanML3D's format, or the number of a generated clip.

    Raises:
        DatasetError: when it is none of them, or cannot be used.
    """
    if Path(name).suffix in SUFFIXES["folder"]:
        return load_file(Path(name).expanduser(), body_models)
    if dataset is not None:
        return load_clip(dataset, name)
    if name.isdigit():
        return generate_clip(0, int(name))
    raise DatasetError(
        f"{name!r}: neither a generated clip's number nor a file ({', '.join(SUFFIXES['folder'])}); an id needs dataset=FOLDER"
    )


def title_lines(text: str, width_px: int, font: Any, most: int = _TITLE_LINES) -> list[str]:
    """Breaks a text into lines of at most a width; what does not fit into `most` lines is cut and ends with `…`."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if font.getlength(longer) <= width_px or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    if len(lines) > most:
        lines = lines[:most]
        while lines[-1] and font.getlength(f"{lines[-1]} …") > width_px:
            lines[-1] = lines[-1].rpartition(" ")[0]
        lines[-1] = f"{lines[-1]} …"
    return lines


def film(clip: HumanMotion, retargeters: Sequence[Retargeter], path: Path) -> int:
    """Writes the film of a clip; returns its frames.

    The file appears when it is complete.
    """
    motions = [retargeter(clip) for retargeter in retargeters]
    human = motions[0].source if motions else clip  # at 20 frames per second
    panels = [_Panel("human", None, human.joints[:, 0])]
    draws: list[Callable[[int], Picture]] = [lambda frame: panels[0].skeleton(human.joints[frame], frame)]
    for retargeter, done in zip(retargeters, motions, strict=True):
        root, joints = done.motion.root_pose, done.motion.joint_positions
        assert root is not None
        assert joints is not None
        panel = _Panel(retargeter.spec.name.upper(), retargeter, root[:, :3])
        panels.append(panel)
        draws.append(lambda frame, panel=panel, root=root, joints=joints: panel.robot(root[frame], joints[frame], frame))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.mp4")
    font = ImageFont.load_default(15)
    try:
        with iio.imopen(temporary, "w", plugin="pyav") as file:
            writer: Any = file
            writer.init_video_stream("libx264", fps=int(FPS), pixel_format="yuv420p")
            for frame in range(len(human.joints)):
                views = np.concatenate([draw(frame) for draw in draws], axis=1)
                writer.write_frame(_titled(views, human, frame, font))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
        for panel in panels:
            panel.close()
    return len(human.joints)


class _Panel:
    """One figure on its floor, followed by a camera.

    Args:
        label: written below.
        retargeter: of the robot, None for the human.
        path: (T, 3) of the pelvis.
    """

    def __init__(self, label: str, retargeter: Retargeter | None, path: Array) -> None:
        self._model = stage(None if retargeter is None else retargeter.spec.mjcf_path, chequered=True)
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, _HEIGHT, _WIDTH)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[int(flag)] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.azimuth, self._camera.elevation = _DISTANCE_M, 215.0, -10.0
        smooth = gaussian_filter1d(path, _SMOOTH_FRAMES, axis=0, mode="nearest")
        self._looks = np.column_stack([smooth[:, :2], np.maximum(_LOOK_M, smooth[:, 2])])
        self._label = label
        if retargeter is not None:
            self._q = np.array([int(self._model.joint(name).qposadr[0]) for name in retargeter.robot.joint_names])
            free = np.flatnonzero(self._model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))[0]
            self._root = int(self._model.jnt_qposadr[free])

    def close(self) -> None:
        """Frees the drawing context."""
        self._renderer.close()

    def robot(self, root: Array, joints: Array, frame: int) -> Picture:
        """The robot in a posture."""
        self._data.qpos[self._root : self._root + 7] = root
        self._data.qpos[self._q] = joints
        self._update(frame)
        return self._picture()

    def skeleton(self, joints: Array, frame: int) -> Picture:
        """The human as capsules between joints (22, 3), with a ball for the head."""
        self._update(frame)
        for child, parent in enumerate(PARENTS):
            if parent >= 0:
                self._add(mujoco.mjtGeom.mjGEOM_CAPSULE, joints[parent], joints[child], _BONE_M, _side(JOINTS[child]))
        head = joints[index("head")]
        self._add(mujoco.mjtGeom.mjGEOM_SPHERE, head, head, _HEAD_M, "")
        return self._picture()

    def _update(self, frame: int) -> None:
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = self._looks[frame]
        self._renderer.update_scene(self._data, self._camera)

    def _add(self, kind: mujoco.mjtGeom, start: Array, end: Array, radius_m: float, side: str) -> None:
        scene = self._renderer.scene
        geom = scene.geoms[scene.ngeom]
        colour = np.array(_COLOURS[side], dtype=np.float32)
        mujoco.mjv_initGeom(geom, int(kind), np.full(3, radius_m), start, np.eye(3).ravel(), colour)
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            mujoco.mjv_connector(geom, int(kind), radius_m, start, end)
        scene.ngeom += 1

    def _picture(self) -> Picture:
        picture = Image.fromarray(self._renderer.render())
        ImageDraw.Draw(picture).text((8, _HEIGHT - 24), self._label, fill=(20, 20, 24), font=ImageFont.load_default(15))
        return np.asarray(picture, dtype=np.uint8)


def _side(joint: str) -> str:
    return joint.split("_", maxsplit=1)[0] if "_" in joint else ""


def _titled(views: Picture, clip: HumanMotion, frame: int, font: Any) -> Picture:
    """The panels under a bar with the clip's name, the time, and the captions of that moment."""
    time_s = frame / clip.fps
    said = _caption(clip, time_s)
    bar = Image.new("RGB", (views.shape[1], _LINE_PX * (_TITLE_LINES + 1) + 8), (24, 24, 28))
    draw = ImageDraw.Draw(bar)
    draw.text((8, 4), f"{clip.name}   {time_s:4.1f} of {clip.duration_s:.1f} s", fill=(160, 165, 175), font=font)
    for row, line in enumerate(title_lines(said, views.shape[1] - 16, font), start=1):
        draw.text((8, 4 + row * _LINE_PX), line, fill=(240, 240, 240), font=font)
    return np.concatenate([np.asarray(bar, dtype=np.uint8), views], axis=0)


def _caption(clip: HumanMotion, time_s: float) -> str:
    """The caption of the moment, or the first of the whole clip."""
    now = [caption.text for caption in clip.captions if caption.end_s and caption.start_s <= time_s <= caption.end_s]
    whole = [caption.text for caption in clip.captions if not caption.end_s]
    return next(iter((*now, *whole)), "(no caption)")


@dataclass(frozen=True)
class MotionConfig:
    """How a clip is filmed.

    Attributes:
        robots: robots beside the human; all by default.
        out: folder of the films.
        dataset: folder in HumanML3D's format, for clips named by id.
        body_models: folder of SMPL models, for .npz files.
    """

    robots: tuple[str, ...] = ()
    out: str = "outputs/films"
    dataset: str = ""
    body_models: str = ""

    def __post_init__(self) -> None:
        for name in self.robots:
            require(name in available_robots(), f"robots: {allowed_values(name, available_robots())}")


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 1 when a clip cannot be used, 2 on wrong arguments."""
    names, config = read_named(MotionConfig, arguments, ("CLIP",), more=True)
    retargeters = [Retargeter(load_robot(name)) for name in config.robots or available_robots()]
    for name in names:
        try:
            clip = find_clip(name, _folder(config.dataset), _folder(config.body_models))
        except DatasetError as error:
            sys.stderr.write(f"{error}\n")
            return 1
        path = Path(config.out) / f"motion_{Path(clip.name).name}.mp4"
        sys.stdout.write(f"{path}: {film(clip, retargeters, path)} frames\n")
        sys.stdout.flush()
    return 0


def _folder(name: str) -> Path | None:
    return Path(name) if name else None
