from pathlib import Path

import numpy as np
import pytest

from data.activities import ACTIVITIES, RECIPES
from data.contacts import contact_runs, lock, toe_contacts
from data.generator import generate_clip, write_dataset
from data.humanml3d import (
    DatasetError,
    Skipped,
    list_clips,
    load_clip,
    load_dataset,
    parse_captions,
)
from data.posing import two_bone
from data.representation import VECTOR_SIZE, joints_from_vectors, vectors_from_joints
from data.script import minimum_jerk
from data.skeleton import PARENTS, HumanMotion, index, mirrored, to_y_up, to_z_up

CLIPS = len(RECIPES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("motion") / "set", 20, seed=1)


@pytest.mark.parametrize("number", range(CLIPS))
def test_every_recipe_is_a_plausible_motion(number: int) -> None:
    clip = generate_clip(0, number)
    assert 2.0 <= clip.duration_s <= 10.0
    assert np.isfinite(clip.joints).all()
    assert clip.joints[..., 2].min() > 0.0
    for child, parent in enumerate(PARENTS):
        if parent >= 0:
            assert np.ptp(np.linalg.norm(clip.joints[:, child] - clip.joints[:, parent], axis=1)) < 1e-9
    assert np.abs(np.diff(clip.joints, axis=0)).max() * clip.fps < 5.0
    contact = toe_contacts(clip.joints, clip.fps)
    assert contact.any(axis=1).mean() > 0.8
    toes = clip.joints[:, [index("left_foot"), index("right_foot")]]
    speed = np.linalg.norm(np.diff(toes, axis=0), axis=-1) * clip.fps
    assert speed[contact[1:] & contact[:-1]].mean() < 0.03
    assert clip.hand_opening is not None
    assert clip.hand_opening.min() >= 0.0
    assert clip.hand_opening.max() <= 1.0
    assert len(clip.captions) >= 1


def test_recipes_cover_every_activity() -> None:
    assert {name for recipe in RECIPES for name in recipe} == set(ACTIVITIES)


def test_same_seed_same_clip_other_seed_other_clip() -> None:
    np.testing.assert_array_equal(generate_clip(3, 7).joints, generate_clip(3, 7).joints)
    assert generate_clip(3, 7).joints.shape != generate_clip(4, 7).joints.shape or not np.array_equal(
        generate_clip(3, 7).joints, generate_clip(4, 7).joints
    )


def test_captions_name_the_arm_that_moves() -> None:
    for number in range(7, 7 + 40 * CLIPS, CLIPS):  # the recipe of a single reach
        clip = generate_clip(0, number)
        text = clip.captions[0].text
        wrists = clip.joints[:, [index("left_wrist"), index("right_wrist")]] - clip.joints[:, :1]
        moved = np.ptp(wrists, axis=0).max(axis=-1)
        assert ("left" if moved[0] > moved[1] else "right") in text


def test_minimum_jerk_has_still_ends() -> None:
    u = np.linspace(0.0, 1.0, 1001)
    s = minimum_jerk(u)
    assert s[0] == 0.0
    assert s[-1] == pytest.approx(1.0)
    assert np.gradient(s, u).max() == pytest.approx(1.875, rel=1e-4)


def test_two_bones_reach_and_keep_their_length() -> None:
    rng = np.random.default_rng(0)
    root, target = np.zeros((50, 3)), rng.normal(size=(50, 3)) * 0.25
    middle, end = two_bone(root, target, 0.3, 0.25, np.tile([0.0, 0.0, -1.0], (50, 1)))
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 0.3, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(end - middle, axis=1), 0.25, atol=1e-9)
    near = (np.linalg.norm(target, axis=1) < 0.5) & (np.linalg.norm(target, axis=1) > 0.1)
    np.testing.assert_allclose(end[near], target[near], atol=1e-9)


def test_vectors_round_trip() -> None:
    joints = to_y_up(generate_clip(0, 17).joints)
    vectors = vectors_from_joints(joints)
    assert vectors.shape == (len(joints) - 1, VECTOR_SIZE)
    back = joints_from_vectors(vectors)
    np.testing.assert_allclose(back[0, 0, [0, 2]], 0.0, atol=1e-9)
    # Distances between any two points of the clip do not depend on where the clip starts.
    for a, b in ((0, 21), (10, 15), (4, 20)):
        np.testing.assert_allclose(
            np.linalg.norm(back[:, a] - back[:, b], axis=1), np.linalg.norm(joints[:-1, a] - joints[:-1, b], axis=1), atol=1e-9
        )
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(back[:, 0], axis=0), axis=1), np.linalg.norm(np.diff(joints[:-1, 0], axis=0), axis=1), atol=1e-6
    )
    assert set(np.unique(vectors[:, -4:])) <= {0.0, 1.0}
    with pytest.raises(ValueError, match=r"expected \(T, 263\)"):
        joints_from_vectors(vectors[:, :10])


def test_mirror_is_its_own_inverse_and_swaps_sides() -> None:
    joints = generate_clip(0, 7).joints
    np.testing.assert_array_equal(mirrored(mirrored(joints)), joints)
    np.testing.assert_array_equal(mirrored(joints)[:, index("left_wrist"), 0], joints[:, index("right_wrist"), 0])
    np.testing.assert_array_equal(to_z_up(to_y_up(joints)), joints)


def test_motion_shape_is_checked() -> None:
    with pytest.raises(ValueError, match=r"expected \(T, 22, 3\)"):
        HumanMotion("a", np.zeros((4, 21, 3)), 20.0)
    with pytest.raises(ValueError, match="hand_opening"):
        HumanMotion("a", np.zeros((4, 22, 3)), 20.0, (), np.zeros((3, 2)))


def test_contact_runs_and_lock() -> None:
    contact = np.array([1, 1, 0, 0, 1, 1, 1], dtype=bool)
    assert contact_runs(contact) == [(0, 2), (4, 7)]
    values = np.arange(7.0)[:, None]
    locked = lock(values, contact)
    np.testing.assert_allclose(locked[:2], 0.5)
    np.testing.assert_allclose(locked[4:], 5.0)
    # In between the offsets -0.5 and +1 are blended.
    np.testing.assert_allclose(locked[2:4, 0], [2 - 0.5 + 0.5, 3 - 0.5 + 1.0])
    np.testing.assert_array_equal(lock(values, np.zeros(7, dtype=bool)), values)


def test_written_data_set_loads(folder: Path) -> None:
    assert len(list_clips(folder)) == 20
    assert {split for _, split in list_clips(folder)} == {"train", "val", "test"}
    clips = list(load_dataset(folder))
    assert not any(isinstance(clip, Skipped) for clip in clips)
    clip = clips[0]
    assert isinstance(clip, HumanMotion)
    original = generate_clip(1, int(clip.name))
    assert len(clip.joints) == len(original.joints) - 1
    assert [c.text for c in clip.captions] == [c.text for c in original.captions]
    assert clip.hand_opening is not None
    head = clip.joints[:, index("head"), 2]
    np.testing.assert_allclose(head, original.joints[:-1, index("head"), 2] - original.joints[..., 2].min(), atol=1e-5)
    assert (folder / "texts" / f"{clip.name}.txt").read_text().count("#0.0#0.0") >= 1


def test_writing_again_changes_nothing_and_foreign_folders_are_left_alone(folder: Path, tmp_path: Path) -> None:
    before = (folder / "new_joints" / "000000.npy").stat().st_mtime_ns
    write_dataset(folder, 20, seed=1)
    assert (folder / "new_joints" / "000000.npy").stat().st_mtime_ns == before
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(ValueError, match="was not generated"):
        write_dataset(tmp_path, 2, seed=0)
    with pytest.raises(ValueError, match="clips 0"):
        write_dataset(tmp_path / "new", 0, seed=0)


def test_joints_are_recovered_from_vectors_alone(folder: Path, tmp_path: Path) -> None:
    for part in ("texts", "new_joint_vecs"):
        (tmp_path / part).symlink_to(folder / part)
    np.testing.assert_allclose(load_clip(tmp_path, "000003").joints, load_clip(folder, "000003").joints, atol=1e-4)


def test_captions_with_spans() -> None:
    text = "a man walks .#a/DET man/NOUN#0.0#0.0\nhe turns#he/PRON#1.5#9.0\nhe stops#x/X#nan#nan\n"
    first, second, third = parse_captions(text, 4.0)
    assert (first.text, first.start_s, first.end_s) == ("a man walks .", 0.0, 0.0)
    assert (second.start_s, second.end_s) == (1.5, 4.0)
    assert third.end_s == 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [("a man walks", "1 fields"), ("a#b#x#y", "not two numbers"), ("", "no caption"), ("#a/b#0.0#0.0", "no caption")],
)
def test_bad_captions(text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        parse_captions(text, 1.0)


def test_bad_folder(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"texts, new_joints, train\.txt"):
        list_clips(tmp_path)


def _clip(folder: Path, array: np.ndarray, text: str = "a#b#0.0#0.0\n") -> Path:
    for part in ("new_joints", "texts"):
        (folder / part).mkdir(exist_ok=True)
    np.save(folder / "new_joints" / "c.npy", array)
    (folder / "texts" / "c.txt").write_text(text)
    return folder


def test_bad_clips_say_why(tmp_path: Path) -> None:
    good = to_y_up(generate_clip(0, 6).joints)
    cases = [
        (good[:, :20], r"shape \(\d+, 20, 3\)"),
        (good[:5], "5 frames"),
        (np.where(np.arange(len(good))[:, None, None] == 3, np.nan, good), "not finite"),
        (good * 1000.0, "expected 0.5 to 3 m"),
        (good + np.where(np.arange(len(good)) > 9, 2.0, 0.0)[:, None, None], "jumps 2.00 m"),
    ]
    for array, message in cases:
        with pytest.raises(DatasetError, match=message):
            load_clip(_clip(tmp_path, array), "c")
    _clip(tmp_path, good)
    (tmp_path / "new_joints" / "c.npy").write_bytes(b"no array")
    with pytest.raises(DatasetError, match="not a readable array"):
        load_clip(tmp_path, "c")
    with pytest.raises(DatasetError, match="neither"):
        load_clip(tmp_path, "d")
    with pytest.raises(DatasetError, match="not a clip id"):
        load_clip(tmp_path, "../c")
    _clip(tmp_path, good)
    (tmp_path / "texts" / "c.txt").unlink()
    with pytest.raises(DatasetError, match=r"c\.txt"):
        load_clip(tmp_path, "c")
    _clip(tmp_path, good)
    (tmp_path / "hand_opening").mkdir()
    np.save(tmp_path / "hand_opening" / "c.npy", np.zeros((2, 2)))
    with pytest.raises(DatasetError, match=r"shape \(2, 2\)"):
        load_clip(tmp_path, "c")
    (tmp_path / "hand_opening" / "c.npy").unlink()
    (tmp_path / "hand_opening").rmdir()
    (tmp_path / "new_joints" / "c.npy").unlink()
    (tmp_path / "new_joint_vecs").mkdir()
    np.save(tmp_path / "new_joint_vecs" / "c.npy", np.zeros((20, 12)))
    with pytest.raises(DatasetError, match=r"expected \(T, 263\)"):
        load_clip(tmp_path, "c")


def test_a_bad_clip_is_skipped_with_its_reason(folder: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(folder, tmp_path / "set")
    np.save(tmp_path / "set" / "new_joints" / "000002.npy", np.zeros((3, 22, 3)))
    skipped = [clip for clip in load_dataset(tmp_path / "set") if isinstance(clip, Skipped)]
    assert [clip.name for clip in skipped] == ["000002"]
    assert "3 frames" in skipped[0].reason
