import dataclasses

import numpy as np
import pytest

from configs.schema.data import ReplayConfig
from data.generator import generate_clip
from data.motion import decode_key_bodies, heading_to_world, world_to_heading
from data.retarget import Retargeter
from data.shards import decode_depth, decode_png
from interface.motion import Motion
from robots.spec import load_robot
from sim.collection.replay import picture_frames, place_path, replay_clip, set_frame
from sim.skills.obstacles import navigation_map
from sim.world.world import World


@pytest.fixture(scope="module")
def motion() -> Motion:
    return Retargeter(load_robot("x1"))(generate_clip(0, 0)).motion


@pytest.fixture(scope="module")
def world() -> World:
    return World(load_robot("x1"), "kitchen_1")


def test_frames_are_spread() -> None:
    assert picture_frames(80, 20.0, 1.0).tolist() == [10, 30, 50, 70]
    assert picture_frames(5, 20.0, 1.0).tolist() == [2]


def test_pictures(motion: Motion) -> None:
    cfg = ReplayConfig(rooms=("kitchen_1",), pictures_per_s=1.0, image_size=56)
    made = replay_clip(motion, cfg, seed=3)
    assert made is not None
    assert len(made.images) == len(made.depths) == len(made.frames) == len(made.cameras_in_pelvis)
    image = decode_png(made.images[0])
    assert image.shape == (56, 56, 3)
    assert np.std(image) > 5.0
    depth = decode_depth(made.depths[0], 56, 56)
    assert 0.0 < float(depth.min()) < float(np.median(depth)) < 15.0
    assert np.linalg.norm(made.cameras_in_pelvis[0][:3, 3]) < 0.8
    again = replay_clip(motion, cfg, seed=3)
    assert again is not None
    assert again.images == made.images


def test_the_robot_takes_the_pose_of_the_clip(motion: Motion, world: World) -> None:
    set_frame(world, motion, 20, np.array([0.5, -0.5]), 1.0)
    assert world.recorder is not None
    root, keys = world.recorder.root_pose(world.data), world.recorder.key_bodies(world.data)
    assert motion.root_pose is not None
    expected = decode_key_bodies(motion.features[20])
    # The base has no roll, which shifts far bodies a little.
    np.testing.assert_allclose(world_to_heading(keys, root), expected, atol=0.05)
    assert heading_to_world(expected, root).shape == keys.shape


def test_the_whole_path_is_free(motion: Motion, world: World) -> None:
    assert motion.root_pose is not None
    placed = place_path(motion.root_pose[:, :2], world, np.random.default_rng(0), 200)
    assert placed is not None
    start, turn = placed
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    points = start + (motion.root_pose[::4, :2] - motion.root_pose[0, :2]) @ rotation.T
    nav = navigation_map(world, load_robot("x1").footprint_radius_m)
    assert all(nav.is_free(point) for point in points)


def test_a_path_longer_than_the_room_finds_no_place(world: World) -> None:
    long = np.column_stack([np.linspace(0.0, 50.0, 100), np.zeros(100)])
    assert place_path(long, world, np.random.default_rng(0), 20) is None


def test_refuses_motions_that_do_not_fit(motion: Motion, world: World) -> None:
    with pytest.raises(ValueError, match="without joint positions"):
        set_frame(world, dataclasses.replace(motion, joint_positions=None), 0, np.zeros(2), 0.0)
    with pytest.raises(ValueError, match="robot 'h1'"):
        set_frame(world, dataclasses.replace(motion, robot="h1"), 0, np.zeros(2), 0.0)
