"""Reads real motion capture in two plain formats: OMOMO clips as the holosoma project stores them, and arrays of joint
positions.

The clips come with `make motions` (the package `holosoma-retargeting`, used for its data only). They check the retargeting on
real people; no stage trains on them by default.

Paper: none; a check beside HumanML3D. Left out: object poses.
"""

from __future__ import annotations

import pickle
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.contacts import contact_runs
from data.humanml3d import DatasetError, check_joints
from data.motion import FPS, resample
from data.skeleton import HumanMotion, index

Array = NDArray[np.float64]
_OMOMO_FPS: Final = 30.0
_OMOMO_JOINTS: Final = slice(162, 162 + 52 * 3)
#: Index among the 52 SMPL-H joints (in the file's depth-first order) of each joint of `data.skeleton.JOINTS`.
_FROM_SMPLH: Final = (0, 1, 5, 9, 2, 6, 10, 3, 7, 11, 4, 8, 12, 14, 33, 13, 15, 34, 16, 35, 17, 36)
_MOCAP_FPS: Final = 120.0
#: Index among the 53 mocap joints of each joint of `data.skeleton.JOINTS`.
_FROM_MOCAP: Final = (0, 43, 47, 1, 44, 48, 2, 45, 49, 2, 46, 50, 3, 5, 24, 4, 6, 25, 7, 26, 8, 27)

_TOE_M: Final = 0.02
#: When a person is on the floor and upright: toes, pelvis as a share of its standing height, shortest part.
_LOW_TOE_M: Final = 0.08
_HIGH_TOE_M: Final = 0.30
_UPRIGHT: Final = 0.65
#: Cosine of the greatest angle of the trunk from upright.
_TRUNK_UP: Final = 0.26
_LEAST_S: Final = 1.0


def find_demo_clips() -> list[Path]:
    """OMOMO and mocap clips of the installed package, empty when `make motions` has not been run."""
    try:
        root = Path(str(resources.files("holosoma_retargeting"))) / "demo_data"
    except ModuleNotFoundError:
        return []
    return [*sorted(root.glob("OMOMO_new/*.pt")), *sorted(root.glob("climb/*/*.npy"))]


def demo_motions() -> list[HumanMotion]:
    """The installed real clips that a robot on a level floor can follow: OMOMO's, and the level parts of the climbing ones."""
    found: list[HumanMotion] = []
    for path in find_demo_clips():
        found += [load_omomo(path)] if path.suffix == ".pt" else level_parts(load_mocap(path))
    return found


def load_omomo(path: Path) -> HumanMotion:
    """Loads an OMOMO clip (SMPL-H joint positions at 30 frames per second), resampled to 20.

    Raises:
        DatasetError: when the file is not a tensor of the expected shape, or the motion is not plausible.
    """
    import torch  # only this loader needs it

    try:
        tensor = torch.load(path, weights_only=True, map_location="cpu")
    except (OSError, RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
        raise DatasetError(
            f"{path}: not a readable tensor ({str(error).splitlines()[0] if str(error) else 'empty'})"
        ) from error
    if not isinstance(tensor, torch.Tensor) or tensor.ndim != 2 or tensor.shape[1] < _OMOMO_JOINTS.stop:
        shape = tuple(tensor.shape) if isinstance(tensor, torch.Tensor) else type(tensor).__name__
        raise DatasetError(f"{path}: {shape}; expected a tensor (T, {_OMOMO_JOINTS.stop} or more)")
    joints = tensor.detach().numpy()[:, _OMOMO_JOINTS].reshape(-1, 52, 3)[:, list(_FROM_SMPLH)]
    return _checked(path, resample(joints, _OMOMO_FPS))


def load_mocap(path: Path, fps: float = _MOCAP_FPS) -> HumanMotion:
    """Loads an array of joint positions (T, 53, 3), z up, resampled to 20 frames per second.

    Raises:
        DatasetError: when the file is not an array of that shape, or the motion is not plausible.
    """
    try:
        joints = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: not a readable array ({error})") from error
    if joints.ndim != 3 or joints.shape[1] != 53 or joints.shape[2] != 3:
        raise DatasetError(f"{path}: shape {joints.shape}; expected (T, 53, 3)")
    picked = joints[:, list(_FROM_MOCAP)].astype(np.float64)
    picked[:, 9] = 0.5 * (joints[:, 2] + joints[:, 3])  # spine3 lies between the upper spine and the neck
    return _checked(path, resample(picked, fps))


def on_floor(joints: Array) -> Array:
    """Joints (T, 22, 3), z up, moved so that the toes rest 2 cm above 0: a low quantile, robust to single bad frames."""
    floor = float(np.quantile(joints[:, [index("left_foot"), index("right_foot")], 2].min(axis=1), 0.05)) - _TOE_M
    return joints - np.array([0.0, 0.0, floor])


def level_parts(motion: HumanMotion) -> list[HumanMotion]:
    """The parts of a long capture in which the person is on the floor and upright, in order, without captions.

    Both feet are near the floor (the lower toe under 8 cm, the higher under 30 cm), the pelvis is above 0.65 of its median
    height over the frames with such feet, and the trunk is within 75 degrees of upright, for at least 1 s. What lies between is
    climbing, which no floor at 0 explains, kneeling, crawling or lying.

    Returns:
        Clips called `NAME[START:END]`, frames of the capture.
    """
    toes = motion.joints[:, [index("left_foot"), index("right_foot")], 2]
    pelvis = motion.joints[:, 0, 2]
    near = (toes.min(axis=1) < _LOW_TOE_M) & (toes.max(axis=1) < _HIGH_TOE_M)
    if not near.any():
        return []
    trunk = motion.joints[:, index("neck")] - motion.joints[:, 0]
    upright = trunk[:, 2] > _TRUNK_UP * np.linalg.norm(trunk, axis=1)
    level = near & upright & (pelvis > _UPRIGHT * np.median(pelvis[near]))
    runs = [(start, end) for start, end in contact_runs(level) if end - start >= _LEAST_S * motion.fps]
    return [
        HumanMotion(
            f"{motion.name}[{start}:{end}]",
            motion.joints[start:end],
            motion.fps,
            hand_opening=None if motion.hand_opening is None else motion.hand_opening[start:end],
            split=motion.split,
        )
        for start, end in runs
    ]


def _checked(path: Path, joints: Array) -> HumanMotion:
    check_joints(path.name, joints)
    return HumanMotion(path.stem, on_floor(joints), FPS)
