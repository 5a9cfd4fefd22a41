"""AMASS clips through a small body model of SMPL's format, against a naive walk along the kinematic tree."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from configs.schema.data import DataConfig
from data.amass import find_model, load_amass, load_model
from data.generator import generate_clip
from data.humanml3d import DatasetError
from data.pipeline import build_clips
from data.shards import ShardReader
from data.skeleton import PARENTS
from data.sources import activity, clip_ids, load_file

has_smplx = pytest.mark.skipif(
    importlib.util.find_spec("smplx") is None, reason="smplx is not installed; pip install 'proprio-mllm[motion]'"
)
VERTICES = 60
#: joints of the model, shape directions, width of the poses
KINDS = {"smpl": (24, 10, 72), "smplh": (52, 16, 156), "smplx": (55, 20, 165)}
Arrays = dict[str, np.ndarray]


def body(kind: str, seed: int = 0) -> Arrays:
    """A body of SMPL's format whose joints are near a standing human's, y up as in SMPL's rest pose."""
    rng = np.random.default_rng(seed)
    joints, directions, _ = KINDS[kind]
    rest = generate_clip(0, 6).joints[0][:, [1, 2, 0]]  # left, up, ahead
    rest -= rest[0]
    template = rng.normal(size=(VERTICES, 3))
    template[:22] = rest
    regressor = np.zeros((joints, VERTICES))
    regressor[:22, :22] = np.eye(22)
    regressor[22:, :] = 1.0 / VERTICES
    parents = np.array([2**32 - 1, *PARENTS[1:], *([20] * (joints - 22))], dtype=np.uint32)
    return {
        "v_template": template,
        "shapedirs": 0.002 * rng.normal(size=(VERTICES, 3, directions)),
        "posedirs": 0.01 * rng.normal(size=(VERTICES, 3, 9 * (joints - 1))),
        "J_regressor": regressor,
        "kintree_table": np.stack([parents, np.arange(joints, dtype=np.uint32)]),
        "weights": np.full((VERTICES, joints), 1.0 / joints),
        "f": rng.integers(0, VERTICES, size=(40, 3)).astype(np.uint32),
    }


def motion(kind: str, frames: int = 61, seed: int = 1) -> Arrays:
    """A person who stands, faces some way and moves a little; 120 frames per second."""
    rng = np.random.default_rng(seed)
    wave = np.sin(np.linspace(0.0, 3.0, frames))[:, None]
    poses = 0.2 * wave * rng.normal(size=(1, KINDS[kind][2]))
    upright = Rotation.from_euler("zx", [0.7, np.pi / 2])  # from y up to z up
    poses[:, :3] = (upright * Rotation.from_rotvec(0.1 * wave * [0.0, 1.0, 0.0])).as_rotvec()
    trans = np.column_stack([0.3 * wave[:, 0] + 2.0, wave[:, 0] - 1.0, np.full(frames, 1.1)])
    return {
        "poses": poses,
        "trans": trans,
        "betas": rng.normal(size=16),
        "dmpls": np.zeros((frames, 8)),
        "gender": np.array("male"),
        "mocap_framerate": np.array(120.0),
    }


def naive(model: Arrays, clip: Arrays, coefficients: int) -> np.ndarray:
    """Joints of every frame, one joint after the other."""
    betas = clip["betas"][:coefficients]
    shaped = model["v_template"] + model["shapedirs"][:, :, : len(betas)] @ betas
    rest = (model["J_regressor"] @ shaped)[:22]
    out = np.zeros((len(clip["poses"]), 22, 3))
    for t, pose in enumerate(clip["poses"]):
        turns: list[Rotation] = []
        for joint in range(22):
            local = Rotation.from_rotvec(pose[3 * joint : 3 * joint + 3])
            if joint == 0:
                turns.append(local)
                out[t, 0] = rest[0] + clip["trans"][t]
                continue
            parent = PARENTS[joint]
            turns.append(turns[parent] * local)
            out[t, joint] = out[t, parent] + turns[parent].apply(rest[joint] - rest[parent])
    return out


def save(folder: Path, kind: str, model: Arrays | None = None, gender: str = "MALE") -> Path:
    path = folder / kind / f"{kind.upper()}_{gender}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **(model or body(kind)))  # type: ignore[arg-type]
    return path


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    save(tmp_path, "smplh")
    path = tmp_path / "kick_high_left02_poses.npz"
    np.savez(path, **motion("smplh"))  # type: ignore[arg-type]
    return path


@has_smplx
@pytest.mark.parametrize(("kind", "coefficients"), [("smpl", 10), ("smplh", 16), ("smplx", 10)])
def test_joints_equal_a_naive_walk_along_the_tree(tmp_path: Path, kind: str, coefficients: int) -> None:
    model, values = body(kind), motion(kind)
    got = load_model(save(tmp_path, kind, model)).joints(values["betas"], values["poses"][:, :66], values["trans"])
    np.testing.assert_allclose(got, naive(model, values, coefficients), atol=1e-6)


@has_smplx
@pytest.mark.parametrize("kind", ["smpl", "smplh"])
def test_joints_equal_those_of_smplx(tmp_path: Path, kind: str) -> None:
    """The whole body of the library, vertices included, as a second oracle."""
    import smplx.lbs  # type: ignore[import-not-found]
    import torch

    model, values = body(kind), motion(kind)
    arrays = {
        key: torch.from_numpy(value.astype(np.int64 if key == "kintree_table" else float)) for key, value in model.items()
    }
    parents = arrays["kintree_table"][0].clone()
    parents[0] = -1
    count = model["shapedirs"].shape[2]
    _, joints = smplx.lbs.lbs(
        torch.from_numpy(values["betas"][None, :count]).expand(len(values["poses"]), -1), torch.from_numpy(values["poses"]),
        arrays["v_template"], arrays["shapedirs"], arrays["posedirs"].reshape(3 * VERTICES, -1).T, arrays["J_regressor"],
        parents, arrays["weights"],
    )  # fmt: skip
    got = load_model(save(tmp_path, kind, model)).joints(values["betas"], values["poses"][:, :66], values["trans"])
    np.testing.assert_allclose(got, joints[:, :22].numpy() + values["trans"][:, None], atol=1e-6)


@has_smplx
@pytest.mark.parametrize(("key", "gender"), [("mocap_framerate", "male"), ("mocap_frame_rate", b"male")])
def test_a_clip_is_in_this_projects_axes(tmp_path: Path, key: str, gender: str | bytes) -> None:
    save(tmp_path, "smplh")
    values = motion("smplh")
    values |= {key: values.pop("mocap_framerate"), "gender": np.array(gender)}
    np.savez(tmp_path / "clip.npz", **values)  # type: ignore[arg-type]
    got = load_amass(tmp_path / "clip.npz", tmp_path)
    assert got.fps == 20.0 and got.joints.shape == (11, 22, 3) and got.name == "clip"
    np.testing.assert_allclose(got.joints[0, 0, :2], 0.0, atol=1e-9)
    left = got.joints[0, 1] - got.joints[0, 2] + got.joints[0, 16] - got.joints[0, 17]
    assert left[1] > 0.0 and abs(left[0]) < 1e-9  # looks along x
    assert np.quantile(got.joints[:, [10, 11], 2].min(axis=1), 0.05) == pytest.approx(0.02)
    truth = naive(body("smplh"), values, 16)[::6]
    lengths = lambda joints: np.linalg.norm(joints[:, 1:] - joints[:, list(PARENTS[1:])], axis=-1)  # noqa: E731
    np.testing.assert_allclose(lengths(got.joints), lengths(truth), atol=1e-6)
    assert got.joints[:, 15, 2].min() > 1.0  # the head is up


@has_smplx
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "poses is missing; there: betas"),
        ({"trans": None}, "trans is missing"),
        ({"gender": None}, "gender is missing"),
        ({"mocap_framerate": None}, "mocap_framerate or mocap_frame_rate is missing"),
        ({"poses": np.zeros((61, 66))}, r"poses has shape \(61, 66\); expected \(T, 72 or 156 or 165\)"),
        ({"trans": np.zeros((60, 3))}, r"trans has shape \(60, 3\); expected \(61, 3\)"),
        ({"betas": np.zeros((61, 16))}, r"betas has shape \(61, 16\)"),
        ({"betas": np.zeros(0)}, r"betas has shape \(0,\)"),
        ({"trans": np.full((61, 3), np.nan)}, "trans has values that are not finite"),
        ({"mocap_framerate": np.array(0.0)}, r"frame rate 0\.0; allowed: above 0 and at most 1000"),
        ({"mocap_framerate": np.array(1200.0)}, r"frame rate 1200\.0"),
        ({"mocap_framerate": np.array([1.0, 2.0])}, r"frame rate \[1\.0, 2\.0\]"),
        ({"gender": np.array("other")}, "gender 'other'; allowed: female, male, neutral"),
        ({"gender": np.array("female")}, "no smplh model for gender 'female' .*; there: male"),
        ({"poses": np.array([{}], dtype=object)}, "cannot be read"),
        ({"poses": np.zeros((61, 165))}, "no smplx model for gender 'male' .*; there: none"),
        ({"poses": np.zeros((6, 156)), "trans": np.zeros((6, 3))}, "1 frames; at least 10"),
    ],
)
def test_refuses_bad_clips(clip: Path, change: dict[str, np.ndarray | None], message: str) -> None:
    values = {key: value for key, value in (motion("smplh") | change).items() if value is not None}
    np.savez(clip, **values)  # type: ignore[arg-type]
    with pytest.raises(DatasetError, match=message):
        load_amass(clip, clip.parent)


@has_smplx
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shapedirs": None}, "shapedirs is missing"),
        ({"v_template": np.zeros((VERTICES, 2))}, r"v_template has shape \(60, 2\)"),
        ({"shapedirs": np.zeros((4, 3, 10))}, r"shapedirs has shape \(4, 3, 10\); expected \(60, 3, B\)"),
        ({"J_regressor": np.zeros((20, VERTICES))}, r"J_regressor has shape \(20, 60\); expected \(22 or more, 60\)"),
        ({"kintree_table": np.zeros((2, 21))}, r"kintree_table has shape \(2, 21\)"),
        ({"kintree_table": np.zeros((2, 24))}, r"parents \(0, 0, 0, 0, 0,.*expected SMPL's"),
    ],
)
def test_refuses_bad_models(tmp_path: Path, change: dict[str, np.ndarray | None], message: str) -> None:
    model = {key: value for key, value in (body("smpl") | change).items() if value is not None}
    with pytest.raises(DatasetError, match=message):
        load_model(save(tmp_path, "smpl", model))


def test_files_that_are_not_archives(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"broken")
    np.save(tmp_path / "b.npy", np.zeros(3))
    (tmp_path / "b.npy").rename(tmp_path / "b.npz")
    for name in "ab":
        with pytest.raises(DatasetError, match=f"{name}.npz: cannot be read"):
            load_amass(tmp_path / f"{name}.npz", tmp_path)
    with pytest.raises(DatasetError, match=r"c\.npz: cannot be read"):
        load_amass(tmp_path / "c.npz", tmp_path)


def test_models_are_found_and_pickled_ones_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no smplh model for gender 'male' .*; there: none"):
        find_model(tmp_path, "smplh", "male")
    (tmp_path / "SMPLH_MALE.pkl").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"SMPLH_MALE\.pkl: only \.npz models are read"):
        find_model(tmp_path, "smplh", "male")
    for place in ("SMPLH_MALE.npz", "smplh/male/model.npz", "smplh/SMPLH_MALE.npz"):
        path = tmp_path / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
        assert find_model(tmp_path, "smplh", "male") == path


def test_without_smplx_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "smplx.lbs", None)
    (tmp_path / "a.npz").write_bytes(b"")
    cfg = DataConfig(source="amass", path=str(tmp_path), body_models=str(tmp_path))
    with pytest.raises(DatasetError, match=r"pip install 'proprio-mllm\[motion\]'"):
        clip_ids(cfg, tmp_path)


@has_smplx
def test_a_folder_of_amass_becomes_clips(tmp_path: Path) -> None:
    folder, models = tmp_path / "AMASS", tmp_path / "models"
    save(models, "smplh")
    (folder / "KIT" / "3").mkdir(parents=True)
    for name, seed in (("kick_high02_poses", 1), ("walk_poses", 2)):
        np.savez(folder / "KIT" / "3" / f"{name}.npz", **motion("smplh", 181, seed))  # type: ignore[arg-type]
    (folder / "KIT" / "3" / "walk_poses.txt").write_text("a person walks.#a/DET#0.0#0.0\n")
    (folder / "KIT" / "3" / "bad_poses.npz").write_bytes(b"broken")
    (folder / "KIT" / "3" / "shape.npz").write_bytes(b"no motion")
    (folder / "KIT" / "3" / "male_stagei.npz").write_bytes(b"no motion")
    cfg = DataConfig(source="amass", path=str(folder), body_models=str(models), clips=0, workers=1, robots=("x1",))
    manifest = build_clips(cfg, tmp_path / "clips", None)
    dropped = {name: reason for part in manifest.metadata["parts"].values() for name, _, reason in part["dropped"]}
    assert list(dropped) == ["KIT/3/bad_poses.npz"] and "cannot be read" in dropped["KIT/3/bad_poses.npz"]
    rows = {row["name"]: row for row in ShardReader(tmp_path / "clips", "clips")}
    assert {name: row["captions"] for name, row in rows.items()} == {
        "KIT/3/kick_high02_poses.npz": ["kick high"],
        "KIT/3/walk_poses.npz": ["a person walks."],
    }
    assert all(row["split"] == "train" for row in rows.values())
    with pytest.raises(DatasetError, match="no clip in val"):
        build_clips(DataConfig(**{**vars(cfg), "splits": ("val",)}), tmp_path / "other", None)
    with pytest.raises(DatasetError, match="nowhere: no such folder of body models"):
        clip_ids(DataConfig(**{**vars(cfg), "body_models": "nowhere"}), folder)


def test_a_folder_of_captures(tmp_path: Path) -> None:
    """Joint positions (T, 53, 3) at 120 frames per second, as the climbing clips have them."""
    from data.omomo import _FROM_MOCAP

    human = generate_clip(0, 6).joints
    joints = np.zeros((len(human), 53, 3))
    for target, source in reversed(list(enumerate(_FROM_MOCAP))):
        joints[:, source] = human[:, target]
    joints[:, 3] = human[:, 9]
    folder = tmp_path / "motions"
    folder.mkdir()
    np.save(folder / "stand_still.npy", np.repeat(joints, 6, axis=0).astype(np.float32))
    (folder / "other.txt").write_text("no motion")
    np.save(folder / "bad.npy", np.zeros((3, 22, 3)))
    (folder / "bad.pt").write_bytes(b"no tensor")
    cfg = DataConfig(source="folder", path=str(folder), clips=0, workers=1, robots=("x1",))
    assert [name for name, _ in clip_ids(cfg, folder)] == ["bad.npy", "bad.pt", "stand_still.npy"]
    manifest = build_clips(cfg, tmp_path / "clips", None)
    dropped = {name: reason for part in manifest.metadata["parts"].values() for name, _, reason in part["dropped"]}
    assert "(3, 22, 3)" in dropped["bad.npy"] and "not a readable tensor" in dropped["bad.pt"]
    row = ShardReader(tmp_path / "clips", "clips")[0]
    assert (row["name"], row["captions"]) == ("stand_still.npy", ["stand still"])
    with pytest.raises(DatasetError, match=r"suffix '\.txt'; allowed: \.npy, \.npz, \.pt"):
        load_file(folder / "other.txt")
    with pytest.raises(DatasetError, match="needs a folder of body models"):
        load_file(folder / "a.npz")
    with pytest.raises(DatasetError, match="nowhere: no such folder"):
        clip_ids(cfg, tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("KIT/3/kick_high_left02_poses.npz", "kick high left"),
        ("CMU/01/01_01_poses.npz", "cmu"),
        ("a/Walk-stageii.npz", "walk"),
        ("climb/mocap_climb_seq_0_joint_positions_f900-3700.npy", "mocap climb seq f"),
        ("12.npz", "motion"),
    ],
)
def test_activity(name: str, expected: str) -> None:
    assert activity(name) == expected


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"source": "amass"}, "path is needed: data=amass"),
        ({"source": "amass", "path": "a"}, "body_models is needed"),
        ({"source": "folder"}, "path is needed: data=folder"),
    ],
)
def test_configuration_is_checked(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DataConfig(**values)
