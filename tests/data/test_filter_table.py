"""What the filters dropped, as a table."""

import dataclasses
from pathlib import Path

import pytest

from configs.schema.data import DataConfig, GateConfig
from data.filter import reason_group
from data.filter_table import list_counts, main, shard_counts
from data.generator import write_dataset
from data.humanml3d import load_clip
from data.pipeline import build_clips
from data.shards import Manifest, ShardError

ALL = [f"{number:06d}" for number in range(14616)]


def test_phc_list_leaves_11955_clips() -> None:
    counts = list_counts(ALL)
    assert counts["clips"] == 14616
    assert (counts["kept"], counts["whole"], counts["truncated"]) == (11955, 11642, 313)
    dropped = {name: number for name, number in counts.items() if name.startswith("PHC list")}
    assert sum(dropped.values()) == 14616 - 11955
    assert dropped["PHC list: no_amass_key"] == 1191
    assert dropped["PHC list: sitting"] == 441 + 74
    assert list_counts(f"M{name}" for name in ALL) == counts


def test_table_of_a_humanml3d_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("texts", "new_joints"):
        (tmp_path / name).mkdir()
    (tmp_path / "train.txt").write_text("\n".join(ALL))
    (tmp_path / "val.txt").write_text("\n".join(f"M{name}" for name in ALL[:3]))
    (tmp_path / "test.txt").write_text("")
    assert main([str(tmp_path)]) == 0
    lines = [line.replace("│", " ").split() for line in capsys.readouterr().out.splitlines()]
    assert ["in", "the", "lists", "14,616", "3"] in lines
    assert ["kept", "11,955", "2"] in lines
    assert ["of", "these", "whole", "11,642", "2"] in lines


def test_table_of_shards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_dataset(tmp_path / "motions", 8, 0)
    ids = ["000000", "000001", "000002", "000003", "000006", "000007"]  # the list drops 1 and cuts 6 after frame 109
    (folder / "train.txt").write_text("\n".join(ids))
    (folder / "new_joints" / "000002.npy").write_bytes(b"broken")
    gates = GateConfig(leg_deg=0.01)
    cfg = DataConfig(source="humanml3d", path=str(folder), clips=0, splits=("train",), phc_list=True, workers=1, part_size=2)
    cfg = dataclasses.replace(cfg, gates=gates, robots=("x1",))
    manifest = build_clips(cfg, tmp_path / "clips", None)
    cut = len(load_clip(folder, "000006").joints) > 109
    assert shard_counts(manifest)[""] == {
        "clips": 6, "unusable": 1, "PHC list: no_amass_key": 1, "retargeted": 4, "truncated": int(cut),
    }  # fmt: skip
    assert shard_counts(manifest)["x1"] == {"leg_deg": 4, "kept": 0}
    assert main([str(tmp_path / "clips")]) == 0
    lines = [line.replace("│", " ").split() for line in capsys.readouterr().out.splitlines()]
    assert ["dropped", "by", "gate:", "leg_deg", "4"] in lines
    assert ["kept", "0"] in lines
    assert manifest.metadata["summary"]["reasons"] == {"leg_deg": 4, "unusable": 1, "PHC list: no_amass_key": 1}


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage: python -m proprio_mllm report filter" in capsys.readouterr().err
    assert main([str(tmp_path)]) == 1
    assert "new_joints" in capsys.readouterr().err
    with pytest.raises(ShardError, match="'views' without counts"):
        shard_counts(Manifest("views", "x", True, {}, {}))
    with pytest.raises(ShardError, match="'clips' without counts"):
        shard_counts(Manifest("clips", "x", True, {}, {"parts": {"0": {"dropped": [], "metrics": {}}}}))


@pytest.mark.parametrize(
    ("robot", "reason", "group"),
    [
        ("", "PHC list: airborne", "PHC list: airborne"),
        ("", "starts 0.20 m above the floor", "automatic rule"),
        ("", "both feet above 0.2 m for 40 frames", "automatic rule"),
        ("", "000002: 3 frames; at least 10 are needed", "unusable"),
        ("h1", "self_pct 12.00 over 10", "self_pct"),
        ("h1", "pelvis below 0.5 of standing for 1.0 s", "low_pelvis"),
    ],
)
def test_reason_groups(robot: str, reason: str, group: str) -> None:
    assert reason_group(robot, reason) == group
