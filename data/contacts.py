"""Foot contacts of a human motion and targets that keep a planted foot where it is.

Shape letters: T frames; feet are ordered left, right; z is up.

Paper: motion retargeting (there: PHC's pipeline). Here contact is read off the toes, and each contact run gets one place.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.skeleton import index

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
CONTACT_HEIGHT_M: Final = 0.06
CONTACT_SPEED_MPS: Final = 0.30


def toe_contacts(joints: Array, fps: float) -> Mask:
    """Frames in which each toe is low and slow.

    Args:
        joints: (T, 22, 3) metres, z up, floor at 0.
        fps: frames per second.

    Returns:
        (T, 2) left, right.
    """
    toes = joints[:, [index("left_foot"), index("right_foot")]]
    speed = np.zeros(toes.shape[:2])
    if len(toes) > 1:
        speed[1:] = np.linalg.norm(np.diff(toes, axis=0), axis=-1) * fps
        speed[0] = speed[1]
    return (toes[..., 2] < CONTACT_HEIGHT_M) & (speed < CONTACT_SPEED_MPS)


def contact_runs(contact: Mask) -> list[tuple[int, int]]:
    """Start and end (exclusive) of each run of True in (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], contact.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def lock(values: Array, contact: Mask) -> Array:
    """Replaces each contact run by its mean and blends the correction across the swings.

    Args:
        values: (T, N) foot coordinates.
        contact: (T,).

    Returns:
        (T, N), constant in each run, equal to `values` plus a linearly blended offset elsewhere.
    """
    runs = contact_runs(contact)
    if not runs:
        return values.copy()
    at: list[float] = []
    offsets: list[Array] = []
    for start, end in runs:
        mean = values[start:end].mean(axis=0)
        for frame in range(start, end):
            at.append(frame)
            offsets.append(mean - values[frame])
    frames, table = np.arange(len(values)), np.array(offsets)
    return values + np.stack([np.interp(frames, at, table[:, i]) for i in range(values.shape[1])], axis=1)
