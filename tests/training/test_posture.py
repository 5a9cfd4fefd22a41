"""Other postures for the motion tokenizer: the same body, moved otherwise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from data.motion import HAND_OPENING, KEY_BODY_COUNT, N_FEATURES
from interface.bodies import KEY_BODIES, SIDES
from proprio_mllm.training.posture import in_other_postures

BONES = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in SIDES
    for a, b in (("shoulder", "elbow"), ("elbow", "hand"), ("hip", "knee"), ("knee", "ankle"))
]


def bodies(windows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Key bodies (B, T, K, 3)."""
    return windows[..., : 3 * KEY_BODY_COUNT].reshape(*windows.shape[:2], KEY_BODY_COUNT, 3)


def windows_of(seed: int, count: int = 8, frames: int = 32) -> NDArray[np.float32]:
    """Random windows (B, T, F)."""
    return np.random.default_rng(seed).normal(size=(count, frames, N_FEATURES)).astype(np.float32)


def test_bones_keep_their_lengths_and_hips_their_place() -> None:
    windows = windows_of(0)
    before, after = bodies(windows), bodies(in_other_postures(windows, np.random.default_rng(1)))
    for pair in BONES:
        a, b = (KEY_BODIES.index(name) for name in pair)
        lengths = [np.linalg.norm(keys[:, :, a] - keys[:, :, b], axis=-1) for keys in (before, after)]
        np.testing.assert_allclose(lengths[1], lengths[0], atol=1e-5)
    for side in SIDES:
        hip = KEY_BODIES.index(f"{side}_hip")
        np.testing.assert_array_equal(after[:, :, hip], before[:, :, hip])
    moved = np.linalg.norm(after - before, axis=-1).mean(axis=(0, 1))
    assert (moved[[KEY_BODIES.index(f"{side}_hand") for side in SIDES]] > 0.1).all()


def test_hands_stay_as_open_as_they_were() -> None:
    windows = windows_of(2)
    moved = in_other_postures(windows, np.random.default_rng(0))
    np.testing.assert_array_equal(moved[..., HAND_OPENING], windows[..., HAND_OPENING])


def test_a_seed_gives_the_same_postures_and_the_windows_are_left_alone() -> None:
    windows = windows_of(3)
    kept = windows.copy()
    first, again = (in_other_postures(windows, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(windows, kept)
    assert not np.array_equal(first, in_other_postures(windows, np.random.default_rng(6)))


def test_turns_change_slowly() -> None:
    still = np.repeat(windows_of(4, frames=1), 64, axis=1)
    moved = bodies(in_other_postures(still, np.random.default_rng(0)))
    assert np.abs(np.diff(moved, axis=1)).max() < 0.25  # a limb of two metres here, per 50 ms
