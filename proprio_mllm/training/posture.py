"""Motion windows in other postures: more varied movement for the motion tokenizer than the clips hold.

A window's limbs are turned about their own joints, by an angle that stays and one that changes slowly, and everything above the
pelvis leans and twists. Bones keep their lengths, so what results is a body of the same robot; it need not stand. Training on
such windows brings real motion, which moves in ways the generated corpus does not, nearer to what the tokenizer has seen.

Shape letters: B windows, T frames, F features, R windows with a turn of their own.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data.motion import KEY_BODY_COUNT, PELVIS_HEIGHT, PLANAR_VELOCITY, YAW_RATE
from interface.bodies import KEY_BODIES

Array = NDArray[np.float64]
_INDEX: Final = {name: index for index, name in enumerate(KEY_BODIES)}
_SIDES: Final = ("left", "right")
_UPPER: Final = [_INDEX["torso"], _INDEX["head"]]
_ARMS: Final = [[_INDEX[f"{side}_{part}"] for part in ("shoulder", "elbow", "hand")] for side in _SIDES]
_LEGS: Final = [[_INDEX[f"{side}_{part}"] for part in ("hip", "knee", "ankle")] for side in _SIDES]
_KNOTS: Final = 4
#: Deviation of a turn in rad: at a shoulder, an elbow, hip and knee, and of the trunk about x, y, z.
_SHOULDER, _ELBOW, _LEG, _TRUNK = 0.36, 0.22, 0.07, np.array([0.09, 0.15, 0.12])
#: Chance that a window's trunk, an arm, a leg is turned.
_TURNED: Final = {"trunk": 0.7, "arm": 0.7, "leg": 0.5}
#: Deviation of pelvis height (m), planar velocity (m/s) and yaw rate (rad/s).
_HEIGHT, _VELOCITY, _SPIN = 0.03, 0.15, 0.2


def in_other_postures(windows: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
    """Windows (B, T, F) in raw units, each with another posture and movement, from `rng` alone."""
    count, frames = windows.shape[:2]
    keys = windows[..., : 3 * KEY_BODY_COUNT].reshape(count, frames, KEY_BODY_COUNT, 3).astype(np.float64)
    arms = [body for arm in _ARMS for body in arm]
    above = keys[:, :, [*_UPPER, *arms]]
    keys[:, :, [*_UPPER, *arms]] = _turned(above, _turns(rng, count, frames, _TRUNK, _TURNED["trunk"]))
    for limb, first, second, chance in (
        *((arm, _SHOULDER, _ELBOW, _TURNED["arm"]) for arm in _ARMS),
        *((leg, _LEG, _LEG, _TURNED["leg"]) for leg in _LEGS),
    ):
        root, middle, end = limb
        whole, part = _turns(rng, count, frames, first, chance), _turns(rng, count, frames, second, chance)
        upper, lower = keys[:, :, middle] - keys[:, :, root], keys[:, :, end] - keys[:, :, middle]
        keys[:, :, middle] = keys[:, :, root] + _turned(upper[:, :, None], whole)[:, :, 0]
        keys[:, :, end] = keys[:, :, middle] + _turned(_turned(lower[:, :, None], part), whole)[:, :, 0]
    moved = np.array(windows, dtype=np.float64)
    moved[..., : 3 * KEY_BODY_COUNT] = keys.reshape(count, frames, -1)
    moved[..., PELVIS_HEIGHT] += _HEIGHT * rng.normal(size=(count, 1))
    moved[..., PLANAR_VELOCITY] += _VELOCITY * _slow(rng, count, frames, 2)
    moved[..., YAW_RATE] += _SPIN * _slow(rng, count, frames, 1)[..., 0]
    return moved.astype(np.float32)


def _turns(rng: np.random.Generator, count: int, frames: int, scale: float | Array, chance: float) -> Array:
    """Rotation matrices (B, T, 3, 3), identity for windows that chance leaves as they are."""
    still, changing = rng.normal(size=(count, 1, 3)), _slow(rng, count, frames, 3)
    vectors = scale * (still + 0.6 * changing) * (rng.random((count, 1, 1)) < chance)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(count, frames, 3, 3)


def _turned(vectors: Array, matrices: Array) -> Array:
    """Vectors (B, T, N, 3) turned by matrices (B, T, 3, 3)."""
    return np.einsum("btij,btnj->btni", matrices, vectors)


def _slow(rng: np.random.Generator, count: int, frames: int, size: int) -> Array:
    """Noise (B, T, size) of unit deviation at a few knots, smooth between them."""
    knots = rng.normal(size=(count, _KNOTS, size))
    at = np.linspace(0.0, _KNOTS - 1.0, frames)
    left = np.minimum(at.astype(int), _KNOTS - 2)
    part = (at - left)[:, None]
    part = part * part * (3.0 - 2.0 * part)
    return knots[:, left] * (1.0 - part) + knots[:, left + 1] * part
