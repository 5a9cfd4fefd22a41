import dataclasses
from pathlib import Path

import numpy as np
import pytest

from configs.schema.data import DataConfig, GateConfig, ReplayConfig
from data.humanml3d import DatasetError
from data.pipeline import Pictures, build_clips, dataset_folder
from data.shards import ShardError, ShardReader, decode_motion, encode_png
from interface.motion import Motion

CFG = DataConfig(clips=4, part_size=2, workers=1, robots=("x1",))


def picture(motion: Motion, cfg: ReplayConfig, seed: int) -> Pictures | None:
    if motion.name == "000001":
        return None
    size = 4
    return Pictures(
        (encode_png(np.zeros((size, size, 3), dtype=np.uint8)),), (b"\0" * (2 * size * size),), (3,), (np.eye(4),), np.eye(3),
        size, size, "room", seed,
    )  # fmt: skip


def test_writes_clips(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    manifest = build_clips(CFG, tmp_path / "clips", picture, lambda done, total: seen.append((done, total)))
    reader = ShardReader(tmp_path / "clips", "clips")
    assert seen == [(0, 2), (1, 2), (2, 2)]
    assert [row["name"] for row in reader] == ["000000", "000001", "000002", "000003"]
    assert [len(row["images"]) for row in reader] == [1, 0, 1, 1]
    assert decode_motion(reader[0]["motion"]).shape[1] == 48
    assert reader[0]["captions"]
    summary = manifest.metadata["summary"]
    assert (summary["rows"], summary["dropped"], summary["without_pictures"]) == (4, 0, 1)
    assert summary["metrics"]["x1"]["hand_cm"] < 1.0
    # Nothing is computed again.
    assert build_clips(CFG, tmp_path / "clips", picture).rows == 4
    with pytest.raises(ShardError, match="configuration"):
        build_clips(dataclasses.replace(CFG, seed=5), tmp_path / "clips", picture)


def test_resumes(tmp_path: Path) -> None:
    out = tmp_path / "clips"

    def stop(done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_clips(CFG, out, None, stop)
    assert len(ShardReader(out, "clips", allow_partial=True)) == 2
    seen: list[int] = []
    assert build_clips(CFG, out, None, lambda done, total: seen.append(done)).rows == 4
    assert seen == [1, 2]


def test_dropped_clips_have_a_reason(tmp_path: Path) -> None:
    strict = dataclasses.replace(CFG, gates=GateConfig(leg_deg=0.01))
    manifest = build_clips(strict, tmp_path / "clips", None)
    assert manifest.rows == 0
    assert manifest.metadata["summary"]["reasons"] == {"leg_deg": 4}
    names = [entry[0] for part in manifest.metadata["parts"].values() for entry in part["dropped"]]
    assert sorted(names) == ["000000", "000001", "000002", "000003"]


def test_a_folder_in_humanml3ds_format(tmp_path: Path) -> None:
    generated = dataset_folder(CFG, tmp_path / "clips")
    (generated / "new_joints" / "000002.npy").write_bytes(b"broken")
    (generated / "train.txt").write_text("000000\n000002\nM000000\n000003\n")
    other = DataConfig(source="humanml3d", path=str(generated), clips=3, splits=("train",), mirrored=False, workers=1,
                       robots=("h1",), phc_list=True)  # fmt: skip
    manifest = build_clips(other, tmp_path / "real", None)
    assert [row["name"] for row in ShardReader(tmp_path / "real", "clips")] == ["000000", "000003"]
    assert manifest.metadata["summary"]["dropped"] == 1
    with pytest.raises(DatasetError, match="missing"):
        build_clips(dataclasses.replace(other, path=str(tmp_path / "nowhere")), tmp_path / "b", None)
    (generated / "val.txt").write_text("")
    with pytest.raises(DatasetError, match="no clip in val"):
        build_clips(dataclasses.replace(other, splits=("val",)), tmp_path / "c", None)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"source": "humanml3d"}, "path is needed"),
        ({"clips": 0}, "clips 0"),
        ({"robots": ()}, "robots must not be empty"),
        ({"workers": 0}, "workers 0"),
    ],
)
def test_configuration_is_checked(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DataConfig(**values)


@pytest.mark.parametrize(
    ("values", "message"),
    [({"rooms": ()}, "rooms"), ({"pictures_per_s": 0.0}, "pictures_per_s 0.0"), ({"image_size": 0}, "image_size 0")],
)
def test_replay_configuration_is_checked(values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ReplayConfig(**values)


@pytest.mark.slow
def test_ray_writes_what_one_process_writes(tmp_path: Path) -> None:
    serial = build_clips(CFG, tmp_path / "serial", picture)
    cfg = dataclasses.replace(CFG, workers=2, scheduler="ray")
    assert build_clips(cfg, tmp_path / "ray", picture).parts == serial.parts
