"""Reads AMASS clips: parameters of an SMPL, SMPL-H or SMPL-X body, turned into joints with the user's own body model.

The joints of a body with shape b and pose p follow from the model file alone: rest places are the joint regressor times the
shaped vertices, and the kinematic tree turns them by p (the functions of the package `smplx`, extra `motion`). Vertices are not
posed. The 22 joints of `data.skeleton` are the first 22 of all three models. Shape letters: T frames, B shape coefficients,
V vertices, K joints of the model.

Paper: motion data (AMASS, through HumanML3D). Left out: fingers, face, soft tissue, and models stored as `.pkl`, which can run
code when they are read.
"""

from __future__ import annotations

import importlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data.humanml3d import DatasetError, check_joints
from data.motion import FPS, resample
from data.omomo import on_floor
from data.skeleton import JOINTS, PARENTS, HumanMotion, index

Array = NDArray[np.float64]
GENDERS: Final = ("female", "male", "neutral")
#: Kind of body model by the width of `poses`, three numbers per joint.
_KINDS: Final = {72: "smpl", 156: "smplh", 165: "smplx"}
_RATES: Final = ("mocap_framerate", "mocap_frame_rate")
_MAX_FPS: Final = 1000.0
_CHUNK: Final = 4096
#: SMPL-X files with few directions hold 10 of shape, then 10 of expression; the others 300 of shape first.
_SMPLX_FEW: Final = (300, 10)


def require_smplx() -> Any:
    """The module of `smplx` with the kinematic functions.

    Raises:
        DatasetError: when it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module("smplx.lbs")
    except ImportError as error:
        raise DatasetError("AMASS needs smplx, which is not installed: pip install 'proprio-mllm[motion]'") from error


@dataclass(frozen=True, slots=True)
class BodyModel:
    """What the joints of a body model depend on.

    Attributes:
        rest: (22, 3) joints of the mean shape, metres.
        shape: (B, 22, 3) change of the joints per unit of each shape coefficient.
    """

    rest: Array
    shape: Array

    def joints(self, betas: Array, poses: Array, trans: Array) -> Array:
        """Joints (T, 22, 3) in metres of the body in AMASS's axes, z up.

        Args:
            betas: shape coefficients; those that the model does not have are left out.
            poses: (T, 66) axis-angle rotations of the 22 joints, rad.
            trans: (T, 3) metres.
        """
        import torch

        lbs = require_smplx()
        known = min(len(betas), len(self.shape))
        rest = torch.from_numpy(self.rest + np.tensordot(betas[:known], self.shape[:known], axes=1))
        parents = torch.tensor(PARENTS)
        out = np.empty((len(poses), len(JOINTS), 3))
        for start in range(0, len(poses), _CHUNK):  # in pieces, because a long capture has 10^5 frames
            turns = torch.from_numpy(poses[start : start + _CHUNK].reshape(-1, 3))
            rotations = lbs.batch_rodrigues(turns).view(-1, len(JOINTS), 3, 3)
            places = rest.expand(len(rotations), -1, -1)
            posed, _ = lbs.batch_rigid_transform(rotations, places, parents, dtype=torch.float64)
            out[start : start + _CHUNK] = posed.numpy()
        return out + trans[:, None]


def find_model(folder: Path, kind: str, gender: str) -> Path:
    """The file of a body model: `smplh/SMPLH_MALE.npz`, `smplh/male/model.npz` or `SMPLH_MALE.npz` in the folder.

    Raises:
        DatasetError: when there is none; the message names the genders that are there and what to do with a `.pkl`.
    """

    def places(who: str, ending: str) -> list[Path]:
        file = f"{kind.upper()}_{who.upper()}.{ending}"
        return [folder / kind / file, folder / kind / who / f"model.{ending}", folder / file]

    for path in places(gender, "npz"):
        if path.is_file():
            return path
    pickled = next((path for path in places(gender, "pkl") if path.is_file()), None)
    if pickled is not None:
        raise DatasetError(
            f"{pickled}: only .npz models are read, a .pkl can run code; docs/data.md says how to convert it once"
        )
    there = [who for who in GENDERS if any(path.is_file() for path in places(who, "npz"))]
    raise DatasetError(
        f"{folder}: no {kind} model for gender {gender!r} (looked for {', '.join(str(p) for p in places(gender, 'npz'))}); "
        f"there: {', '.join(there) or 'none'}"
    )


@lru_cache(maxsize=6)
def load_model(path: Path) -> BodyModel:
    """Reads a body model, `.npz` with `v_template`, `shapedirs`, `J_regressor` and `kintree_table`.

    Raises:
        DatasetError: when the file cannot be read, lacks an array, or has one of another shape or another joint tree.
    """
    import torch

    template, directions, regressor, tree = _read(path, ("v_template",), ("shapedirs",), ("J_regressor",), ("kintree_table",))
    vertices = len(template)
    joints = len(JOINTS)
    fits = {
        "v_template": (template, template.shape == (vertices, 3), "(V, 3)"),
        "shapedirs": (directions, directions.ndim == 3 and directions.shape[:2] == (vertices, 3), f"({vertices}, 3, B)"),
        "J_regressor": (
            regressor, regressor.ndim == 2 and regressor.shape[1] == vertices and len(regressor) >= joints,
            f"({joints} or more, {vertices})",
        ),
        "kintree_table": (tree, tree.ndim == 2 and tree.shape[1] >= joints, f"(2, {joints} or more)"),
    }  # fmt: skip
    for name, (array, fine, shape) in fits.items():
        if not fine:
            raise DatasetError(f"{path}: {name} has shape {array.shape}; expected {shape}")
    parents = tuple(int(parent) for parent in tree[0, 1:joints])
    if parents != PARENTS[1:]:
        raise DatasetError(f"{path}: parents {parents} of joints 1 to {joints - 1}; expected SMPL's {PARENTS[1:]}")
    many, few = _SMPLX_FEW
    if len(regressor) == 55 and directions.shape[2] < many:
        directions = directions[..., :few]
    lbs = require_smplx()
    matrix = torch.from_numpy(regressor[:joints])
    places = lbs.vertices2joints(matrix, torch.from_numpy(np.concatenate([template[None], directions.transpose(2, 0, 1)])))
    return BodyModel(places[0].numpy(), places[1:].numpy())


def load_amass(path: Path, models: Path, name: str | None = None) -> HumanMotion:
    """Loads an AMASS clip; it starts at the origin, looking along x, on a floor at 0, and has 20 frames per second.

    Args:
        path: `.npz` with `poses` (T, 72, 156 or 165), `trans` (T, 3), `betas`, `gender` and the frame rate.
        models: folder of body models, see `find_model`.
        name: of the clip; the file's stem by default.

    Returns:
        The clip, without captions.

    Raises:
        DatasetError: when the clip or its body model cannot be used, naming the file, the value and what is allowed, or
            `smplx` is not installed.
    """
    poses, trans, betas, who, rate = _read(path, ("poses",), ("trans",), ("betas",), ("gender",), _RATES)
    if poses.ndim != 2 or poses.shape[1] not in _KINDS:
        raise DatasetError(f"{path}: poses has shape {poses.shape}; expected (T, {' or '.join(map(str, _KINDS))})")
    if trans.shape != (len(poses), 3):
        raise DatasetError(f"{path}: trans has shape {trans.shape}; expected ({len(poses)}, 3)")
    if betas.size == 0 or betas.size != betas.shape[-1]:
        raise DatasetError(f"{path}: betas has shape {betas.shape}; expected (B,)")
    for key, array in (("poses", poses), ("trans", trans), ("betas", betas)):
        if not np.isfinite(array).all():
            raise DatasetError(f"{path}: {key} has values that are not finite")
    fps = float(rate.ravel()[0]) if rate.size == 1 else float("nan")
    if not 0.0 < fps <= _MAX_FPS:
        raise DatasetError(f"{path}: frame rate {rate.tolist()}; allowed: above 0 and at most {_MAX_FPS:g}")
    model = load_model(find_model(models, _KINDS[poses.shape[1]], _gender(path, who)))
    joints = model.joints(betas.ravel(), poses[:, : 3 * len(JOINTS)], trans)
    label = name or path.stem
    joints = _from_origin(on_floor(resample(joints, fps)))
    check_joints(label, joints)
    return HumanMotion(label, joints, FPS)


def _gender(path: Path, value: NDArray[Any]) -> str:
    text = value.ravel()[0] if value.size == 1 else ""
    gender = (text.decode("ascii", "replace") if isinstance(text, bytes) else str(text)).strip().lower()
    if gender not in GENDERS:
        raise DatasetError(f"{path}: gender {gender!r}; allowed: {', '.join(GENDERS)}")
    return gender


def _read(path: Path, *wanted: tuple[str, ...]) -> list[Any]:
    """Arrays of an `.npz`, each under the first of its names that is there: numbers as float64, texts as they are."""
    found = []
    try:
        with np.load(path, allow_pickle=False) as file:
            there = [str(name) for name in file] if isinstance(file, Mapping) else []
            for names in wanted:
                name = next((name for name in names if name in there), None)
                if name is None:
                    raise DatasetError(
                        f"{path}: {' or '.join(names)} is missing; there: {', '.join(sorted(there)) or 'nothing'}"
                    )
                values = file[name]
                found.append(values if values.dtype.kind in "US" else values.astype(np.float64))
    except DatasetError:
        raise
    except (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: cannot be read ({error})") from error
    return found


def _from_origin(joints: Array) -> Array:
    """Moves and turns joints (T, 22, 3) so that the first frame's pelvis is above the origin and looks along x."""
    first = joints[0]
    left = sum((first[index(f"left_{part}")] - first[index(f"right_{part}")] for part in ("hip", "shoulder")), np.zeros(3))
    ahead = np.arctan2(-left[0], left[1])
    cos, sin = np.cos(ahead), np.sin(ahead)
    turned = (joints - first[0] * [1.0, 1.0, 0.0]) @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return turned.astype(np.float64)
