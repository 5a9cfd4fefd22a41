"""Columns of each kind of shard; changing them means a new `data.shards.SCHEMA_VERSION`.

Paper: none (engineering). `views`: posed views with truth for the point map and dense pretraining. `clips`: motion with
captions and replayed views, stage 2. `demos`: steps of a teacher. `rollouts`: SELU's trajectories, one row per episode, stage
3; images, motions and cameras have one entry per step and one for the end. `privileged` is for audits only: no loss or prompt
may read it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import datasets

_TEXT, _INT, _FLOAT, _BYTES = (datasets.Value(name) for name in ("string", "int32", "float32", "binary"))


def _list(of: Any) -> Any:
    return datasets.List(of)


#: Columns of each kind. Motions are flat (T·F,) float32; `decode_motion` restores them.
KINDS: Final[Mapping[str, Mapping[str, Any]]] = {
    "views": {
        "image": _BYTES,
        "depth": _BYTES,
        "segmentation": _BYTES,
        "height": _INT,
        "width": _INT,
        "intrinsics": _list(_FLOAT),
        "camera_in_pelvis": _list(_FLOAT),
        "robot": _TEXT,
        "room": _TEXT,
        "seed": datasets.Value("int64"),
        "motion": _list(_FLOAT),
        "objects": _TEXT,
    },
    "clips": {
        "name": _TEXT,
        "robot": _TEXT,
        "motion": _list(_FLOAT),
        "captions": _list(_TEXT),
        "images": _list(_BYTES),
        "depths": _list(_BYTES),
        "height": _INT,
        "width": _INT,
        "image_frames": _list(_INT),
        "intrinsics": _list(_FLOAT),
        "cameras_in_pelvis": _list(_list(_FLOAT)),
        "room": _TEXT,
        "seed": datasets.Value("int64"),
        "split": _TEXT,
    },
    "demos": {
        "episode": _TEXT,
        "task": _TEXT,
        "split": _TEXT,
        "category": _TEXT,
        "robot": _TEXT,
        "room": _TEXT,
        "step": _INT,
        "time_limit": _INT,
        "instruction": _TEXT,
        "image": _BYTES,
        "intrinsics": _list(_FLOAT),
        "camera_in_pelvis": _list(_FLOAT),
        "height": _INT,
        "width": _INT,
        "motion": _list(_FLOAT),
        "key_bodies": _list(_FLOAT),
        "visible": _list(_TEXT),
        "known": _list(_TEXT),
        "history": _list({"step": _TEXT, "feedback": _TEXT}),
        "target": _TEXT,
        "privileged": _TEXT,
    },
    "rollouts": {
        "episode": _TEXT,
        "task": _TEXT,
        "split": _TEXT,
        "category": _TEXT,
        "robot": _TEXT,
        "room": _TEXT,
        "seed": datasets.Value("int64"),
        "instruction": _TEXT,
        "difficulty": _TEXT,
        "time_limit": _INT,
        "steps": _TEXT,
        "images": _list(_BYTES),
        "motions": _list(_list(_FLOAT)),
        "intrinsics": _list(_FLOAT),
        "cameras_in_pelvis": _list(_list(_FLOAT)),
        "key_bodies": _list(_list(_FLOAT)),
        "height": _INT,
        "width": _INT,
        "success": datasets.Value("bool"),
        "privileged": _TEXT,
    },
}
