"""Level parts of long captures."""

import dataclasses

import numpy as np
import pytest

from data.generator import generate_clip
from data.omomo import find_demo_clips, level_parts, load_mocap
from data.skeleton import HumanMotion, index

UP = np.array([0.0, 0.0, 0.5])


def capture() -> HumanMotion:
    """Standing 2 s, on a box of 0.5 m 2 s, standing 1.5 s, crouching low 2 s, standing 0.5 s, 20 frames per second."""
    stand = generate_clip(0, 6).joints[:1]
    low = stand.copy()
    above = low[..., 2] > 0.12
    low[..., 2] = np.where(above, 0.12 + (low[..., 2] - 0.12) * 0.4, low[..., 2])
    pieces = [(stand, 40), (stand + UP, 40), (stand, 30), (low, 40), (stand, 10)]
    joints = np.concatenate([np.repeat(frame, count, axis=0) for frame, count in pieces])
    return HumanMotion("climb", joints, 20.0, hand_opening=np.linspace(0.0, 1.0, 320).reshape(160, 2))


def test_parts_on_the_floor_and_upright() -> None:
    motion = capture()
    parts = level_parts(motion)
    assert [part.name for part in parts] == ["climb[0:40]", "climb[80:110]"]
    np.testing.assert_array_equal(parts[1].joints, motion.joints[80:110])
    assert parts[1].hand_opening is not None and motion.hand_opening is not None
    np.testing.assert_array_equal(parts[1].hand_opening, motion.hand_opening[80:110])


def test_a_lifted_foot_ends_a_part() -> None:
    motion = dataclasses.replace(capture(), joints=capture().joints[:40].copy(), hand_opening=None)
    motion.joints[25:, 10] += [0.0, 0.0, 0.4]
    assert [part.name for part in level_parts(motion)] == ["climb[0:25]"]
    motion.joints[15:, 10] += [0.0, 0.0, 0.4]
    assert level_parts(motion) == []
    assert level_parts(dataclasses.replace(motion, joints=motion.joints + 2.0 * UP)) == []


def test_crawling_ends_a_part() -> None:
    motion = dataclasses.replace(capture(), joints=capture().joints[:40].copy(), hand_opening=None)
    joints = motion.joints[25:]
    trunk = [index(name) for name in ("spine1", "spine2", "spine3", "neck", "head")]
    up = joints[:, trunk] - joints[:, :1]
    joints[:, trunk] = joints[:, :1] + np.stack([up[..., 2], up[..., 1], 0.1 * up[..., 2]], axis=-1)
    assert [part.name for part in level_parts(motion)] == ["climb[0:25]"]


@pytest.mark.motions
def test_every_climbing_clip_has_level_parts() -> None:
    clips = [path for path in find_demo_clips() if path.suffix == ".npy"]
    if not clips:
        pytest.skip("real clips are not installed; run `make motions`")
    parts = [level_parts(load_mocap(path)) for path in clips]
    assert all(parts)
    assert sum(len(part.joints) for of in parts for part in of) > 500
