from fractions import Fraction

import numpy as np
import pytest

from data.motion import (
    FEATURES,
    HAND_OPENING,
    KEY_BODY_COUNT,
    N_FEATURES,
    PELVIS_HEIGHT,
    PLANAR_VELOCITY,
    YAW_RATE,
    decode_key_bodies,
    decode_root,
    encode_frames,
    heading_to_world,
    resample,
    world_to_heading,
    wrap_angle,
    yaw_from_quaternion,
)


def circle(frames: int = 40, fps: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    yaw = np.linspace(0.0, 4.0, frames)
    pose = np.zeros((frames, 7))
    pose[:, 0], pose[:, 1], pose[:, 2] = np.sin(yaw), -np.cos(yaw), 0.9
    pose[:, 3], pose[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    keys = np.random.default_rng(0).normal(size=(frames, KEY_BODY_COUNT, 3))
    return pose, keys


def test_names() -> None:
    assert len(FEATURES) == N_FEATURES == 48
    assert FEATURES[PELVIS_HEIGHT] == "pelvis_height_m"
    assert FEATURES[YAW_RATE] == "yaw_rate_radps"
    assert FEATURES[HAND_OPENING] == ("left_hand_opening", "right_hand_opening")


def test_walking_a_circle_has_constant_forward_speed_and_yaw_rate() -> None:
    pose, keys = circle()
    features = encode_frames(pose, keys, np.ones((40, 2)), 20.0)
    rate = 4.0 / 39 * 20.0
    np.testing.assert_allclose(features[:, YAW_RATE], rate, rtol=1e-4)
    # Chord of the unit circle, seen from the start of each step.
    step = 4.0 / 39
    np.testing.assert_allclose(features[:, PLANAR_VELOCITY][:, 0], np.sin(step) * 20, rtol=1e-4)


def test_round_trips() -> None:
    pose, keys = circle()
    features = encode_frames(pose, keys, np.ones((40, 2)), 20.0)
    np.testing.assert_allclose(decode_key_bodies(features), world_to_heading(keys, pose), atol=1e-5)
    np.testing.assert_allclose(heading_to_world(world_to_heading(keys, pose), pose), keys, atol=1e-12)
    start = pose.copy()
    start[:, 1] += 1.0
    np.testing.assert_allclose(decode_root(features, 20.0)[:, :3], start[:, :3], atol=1e-4)


def test_features_do_not_depend_on_where_the_robot_stands() -> None:
    pose, keys = circle()
    features = encode_frames(pose, keys, np.ones((40, 2)))
    moved, angle = pose.copy(), 1.1
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    shift = np.array([3.0, -2.0, 0.0])
    moved[:, :3] = pose[:, :3] @ rotation.T + shift
    yaw = yaw_from_quaternion(pose[:, 3:]) + angle
    moved[:, 3], moved[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    np.testing.assert_allclose(encode_frames(moved, keys @ rotation.T + shift, np.ones((40, 2))), features, atol=1e-4)


def test_a_window_of_a_recording_has_the_features_of_the_recording() -> None:
    pose, keys = circle()
    whole = encode_frames(pose, keys, np.ones((40, 2)))
    window = encode_frames(pose[10:30], keys[10:30], np.ones((20, 2)))
    np.testing.assert_array_equal(window[1:], whole[11:30])


def test_one_frame_stands_still() -> None:
    pose, keys = circle()
    features = encode_frames(pose[:1], keys[:1], np.ones((1, 2)))
    assert (features[:, PLANAR_VELOCITY] == 0).all()


def test_wrap_and_resample() -> None:
    np.testing.assert_allclose(wrap_angle([3.5, -3.5]), [3.5 - 2 * np.pi, 2 * np.pi - 3.5])
    line = np.arange(31)[:, None] / 30.0
    np.testing.assert_allclose(resample(line, 30.0, 20.0)[:, 0], np.arange(21) / 20.0)


@pytest.mark.parametrize(("fps_from", "fps_to"), [(30, 20), (20, 30), (120, 20), (100, 3), (7, 20), (20, 20)])
def test_resampling_keeps_the_frames_that_fit_into_the_duration(fps_from: int, fps_to: int) -> None:
    for frames in range(1, 80):
        fits = int(Fraction(frames - 1, fps_from) * fps_to) + 1
        ramp = np.arange(frames) / fps_from
        np.testing.assert_allclose(resample(ramp, fps_from, fps_to), np.arange(fits) / fps_to, atol=1e-12)


@pytest.mark.parametrize(
    ("pose", "keys", "opening", "fps", "message"),
    [
        (np.ones((2, 6)), np.zeros((2, 14, 3)), np.zeros((2, 2)), 20.0, r"root_pose has shape \(2, 6\)"),
        (np.ones((2, 7)), np.zeros((2, 13, 3)), np.zeros((2, 2)), 20.0, r"key_bodies_world has shape \(2, 13, 3\)"),
        (np.ones((2, 7)), np.zeros((2, 14, 3)), np.zeros((3, 2)), 20.0, r"hand_opening has shape \(3, 2\)"),
        (np.full((2, 7), np.nan), np.zeros((2, 14, 3)), np.zeros((2, 2)), 20.0, "not finite"),
        (np.ones((2, 7)), np.zeros((2, 14, 3)), np.zeros((2, 2)), 0.0, "fps 0.0"),
    ],
)
def test_refuses(pose: np.ndarray, keys: np.ndarray, opening: np.ndarray, fps: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        encode_frames(pose, keys, opening, fps)


def test_decode_refuses_other_widths() -> None:
    with pytest.raises(ValueError, match="last axis must be 48"):
        decode_key_bodies(np.zeros((3, 47)))
    with pytest.raises(ValueError, match="must be positive"):
        resample(np.zeros(3), -1.0)
