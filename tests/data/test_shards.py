import json
from pathlib import Path

import numpy as np
import pytest

from data.motion import N_FEATURES
from data.shards import (
    Manifest,
    ShardError,
    ShardReader,
    ShardWriter,
    config_hash,
    decode_depth,
    decode_motion,
    decode_png,
    decode_segmentation,
    encode_png,
)

H, W = 6, 8


def view(seed: int) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    return {
        "image": encode_png(rng.integers(0, 255, (H, W, 3), dtype=np.uint8)),
        "depth": rng.random((H, W)).astype("<f2").tobytes(),
        "segmentation": np.full((H, W), -1, dtype="<i2").tobytes(),
        "height": H,
        "width": W,
        "intrinsics": np.eye(3),
        "camera_in_pelvis": np.eye(4),
        "robot": "h1",
        "room": "kitchen_1",
        "seed": seed,
        "motion": rng.random((64, N_FEATURES)).astype(np.float32),
        "objects": "[]",
    }


def write(folder: Path, parts: int = 2) -> ShardWriter:
    writer = ShardWriter(folder, "views", "abc")
    for index in writer.missing(parts):
        writer.write(index, [view(10 * index + i) for i in range(3)])
    return writer


def test_round_trip(tmp_path: Path) -> None:
    write(tmp_path).finish({"type_names": ["Mug"]})
    reader = ShardReader(tmp_path, "views")
    assert len(reader) == 6
    assert reader.manifest.metadata == {"type_names": ["Mug"]}
    expected = view(11)
    row = reader[4]
    assert row["seed"] == 11
    np.testing.assert_array_equal(decode_motion(row["motion"]), expected["motion"])
    assert decode_png(row["image"]).shape == (H, W, 3)
    assert decode_depth(row["depth"], H, W).shape == (H, W)
    assert (decode_segmentation(row["segmentation"], H, W) == -1).all()
    np.testing.assert_array_equal(np.reshape(row["camera_in_pelvis"], (4, 4)), np.eye(4))
    assert reader.column("seed") == [0, 1, 2, 10, 11, 12]
    assert [r["seed"] for r in reader[1:3]] == [1, 2]


def test_png_is_lossless() -> None:
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    np.testing.assert_array_equal(decode_png(encode_png(image)), image)


def test_resumes_missing_parts(tmp_path: Path) -> None:
    write(tmp_path, parts=1)
    with pytest.raises(ShardError, match="not finished"):
        ShardReader(tmp_path, "views")
    assert len(ShardReader(tmp_path, "views", allow_partial=True)) == 3
    again = ShardWriter(tmp_path, "views", "abc")
    assert again.missing(2) == [1]


def test_corrupted_part_is_named_and_rewritten(tmp_path: Path) -> None:
    write(tmp_path).finish()
    path = tmp_path / "part-00001.arrow"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ShardError, match=r"part-00001\.arrow: differs"):
        ShardReader(tmp_path, "views")
    assert ShardWriter(tmp_path, "views", "abc").missing(2) == [1]


def test_missing_file_is_named(tmp_path: Path) -> None:
    write(tmp_path).finish()
    (tmp_path / "part-00000.arrow").unlink()
    with pytest.raises(ShardError, match=r"part-00000\.arrow: listed"):
        ShardReader(tmp_path, "views")


def test_unknown_version_kind_and_manifest(tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="no such file"):
        Manifest.load(tmp_path)
    write(tmp_path).finish()
    with pytest.raises(ShardError, match="expected 'clips'"):
        ShardReader(tmp_path, "clips")
    path = tmp_path / "manifest.json"
    raw = json.loads(path.read_text())
    path.write_text(json.dumps({**raw, "schema_version": 99}))
    with pytest.raises(ShardError, match="version 99 is unknown"):
        ShardReader(tmp_path, "views")
    path.write_text(json.dumps({**raw, "kind": "soup"}))
    with pytest.raises(ShardError, match="'soup' is unknown"):
        ShardReader(tmp_path, "views")
    path.write_text("{")
    with pytest.raises(ShardError, match="not a shard manifest"):
        ShardReader(tmp_path, "views")
    with pytest.raises(ShardError, match="'soup' is unknown"):
        ShardWriter(tmp_path, "soup", "abc")


def test_other_configuration(tmp_path: Path) -> None:
    write(tmp_path).finish()
    with pytest.raises(ShardError, match="configuration abc"):
        ShardWriter(tmp_path, "views", "other")
    assert ShardWriter(tmp_path, "views", "other", overwrite=True).missing(2) == [0, 1]


def test_row_with_wrong_columns(tmp_path: Path) -> None:
    writer = ShardWriter(tmp_path, "views", "abc")
    row = view(0)
    row["colour"] = row.pop("room")
    with pytest.raises(ShardError, match=r"missing \['room'\], unknown \['colour'\]"):
        writer.write(0, [row])
    assert not list(tmp_path.glob("*part*"))


def test_empty_part(tmp_path: Path) -> None:
    writer = ShardWriter(tmp_path, "demos", "abc")
    writer.write(0, [])
    writer.finish()
    assert len(ShardReader(tmp_path, "demos")) == 0


def test_config_hash() -> None:
    assert config_hash({"a": 1, "b": 2}) == config_hash({"b": 2, "a": 1})
    assert config_hash({"a": 1}) != config_hash({"a": 2})


def test_motion_length() -> None:
    with pytest.raises(ValueError, match="motion of 5 numbers"):
        decode_motion(np.zeros(5))
