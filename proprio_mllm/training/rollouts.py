"""SELU's trajectories: what a rollout row holds, how a collector writes one and how training reads it back.

A collector runs the actor in the simulator and writes one `rollouts` row per episode with `rollout_row`: one image, motion
and camera per step and one more for the end. `steps` is JSON, a list with one entry per observation:
`{"step", "feedback", "ok", "visible", "known"}`; the last entry has an empty step. `privileged` may hold
`{"relations": {"held": [ids], "open": [...], "on Table_1": [...]}}`, the simulator's truth at the end: audits read it, and the
labelled ablation `truth=oracle`, nothing else.

Shape letters: T frames, F motion features, K key bodies.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from configs.schema.execution import Execution
from data.motion import KEY_BODY_COUNT
from data.shards import ShardReader, decode_motion, decode_png, encode_png
from interface.observation import Camera, HistoryItem, Observation
from interface.sightings import Shown
from proprio_mllm.model.batch import View


@dataclass(frozen=True, slots=True)
class RolloutRequest:
    """What a collector is asked for.

    Attributes:
        model: folder of the actor, as `building.save_model` wrote it; its first adapter is the actor's.
        folder: shard folder to write, kind `rollouts`.
        episodes: number of episodes.
        seed: of the sampled tasks, the world and the actor's draws.
        temperature: of the actor.
        config_hash: hash to store in the shard's manifest.
        execution: who runs them.
    """

    model: Path
    folder: Path
    episodes: int
    seed: int
    temperature: float
    config_hash: str
    execution: Execution = field(default_factory=Execution)


@dataclass(frozen=True, slots=True)
class DaggerRequest:
    """What is asked of whoever lets a model act and has its teacher correct it.

    Attributes:
        model: folder of the model that acts.
        folder: shard folder to write, kind `demos`.
        episodes: number of episodes.
        seed: of tasks and draws.
        teacher_share: share of the steps that the teacher takes itself.
        image_size: side of the pictures, pixels.
        config_hash: hash to store in the shard's manifest.
        foreseen: whether the right step is the one that the reach test foresees.
    """

    model: Path
    folder: Path
    episodes: int
    seed: int
    teacher_share: float
    image_size: int
    config_hash: str
    foreseen: bool = False


class RolloutCollector(Protocol):
    """Runs the actor in the simulator; given to training by the entry point, which may import both."""

    def __call__(self, request: RolloutRequest) -> None:
        """Writes a complete shard folder; continues an interrupted one."""
        ...


@dataclass(frozen=True, slots=True)
class Moment:
    """One observation of a rollout, with the steps charged before it, and the step that follows; the last has an empty step."""

    number: int
    step: str
    feedback: str
    ok: bool
    visible: tuple[str, ...]
    known: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Rollout:
    """One episode. Images are decoded by `view`; `success` and `relations` are for audits."""

    episode: str
    robot: str
    category: str
    instruction: str
    time_limit: int
    moments: tuple[Moment, ...]
    motions: tuple[NDArray[np.float32], ...]
    success: bool
    relations: Mapping[str, Sequence[str]] | None
    row: Mapping[str, Any]

    @property
    def length(self) -> int:
        """Number of steps taken."""
        return len(self.moments) - 1

    def history(self, index: int) -> list[HistoryItem]:
        """Steps before observation `index`."""
        return [HistoryItem(moment.step, moment.feedback) for moment in self.moments[:index]]

    def shown(self, index: int, goal: str) -> list[Shown]:
        """What a planner with a goal would have seen, up to observation `index`."""
        history = tuple(self.history(index))
        return [
            Shown(goal, self.robot, moment.visible, moment.known, history[:at])
            for at, moment in enumerate(self.moments[: index + 1])
        ]

    def view(self, index: int) -> View:
        """The head-camera view of observation `index`."""
        row = self.row
        camera = Camera(
            np.asarray(row["intrinsics"], dtype=np.float64).reshape(3, 3),
            np.asarray(row["cameras_in_pelvis"][index], dtype=np.float64).reshape(4, 4),
            int(row["height"]),
            int(row["width"]),
        )
        bodies = np.asarray(row["key_bodies"][index], dtype=np.float64).reshape(KEY_BODY_COUNT, 3)
        return View(decode_png(row["images"][index]), camera, bodies)

    def receptacles(self, last: int | None = None) -> list[str]:
        """Targets of the placing actions before observation `last`, newest first."""
        found: list[str] = []
        for moment in self.moments[:last]:
            for call in moment.step.split("&"):
                name, _, rest = call.strip().partition("(")
                if name in ("Place", "PlaceBoth"):
                    found.append(rest.rstrip(")").split(",")[-1].strip())
        return list(dict.fromkeys(reversed(found)))


def rollout_row(
    episode: str,
    task: str,
    category: str,
    room: str,
    seed: int,
    difficulty: str,
    observations: Sequence[Observation],
    steps: Sequence[tuple[str, str, bool]],
    success: bool,
    relations: Mapping[str, Sequence[str]] | None = None,
    split: str = "train",
) -> dict[str, Any]:
    """A `rollouts` row.

    Args:
        episode: unique name.
        task: task id.
        category: task category.
        room: room name.
        seed: episode seed.
        difficulty: contingency level.
        observations: one per step and one for the end.
        steps: (plan text or the invalid reply, feedback text, whether every action succeeded) per step.
        success: simulator's verdict, for audits.
        relations: simulator's truth at the end by relation, for audits.
        split: task split; training refuses benchmark tasks.

    Raises:
        ValueError: when the numbers of observations and steps do not fit.
    """
    if len(observations) != len(steps) + 1:
        raise ValueError(f"{len(steps)} steps need {len(steps) + 1} observations, got {len(observations)}")
    moments = [
        {
            "number": o.step,
            "step": text,
            "feedback": feedback,
            "ok": ok,
            "visible": list(o.visible_objects),
            "known": list(o.known_objects),
        }
        for o, (text, feedback, ok) in zip(observations, [*steps, ("", "", True)], strict=True)
    ]
    first = observations[0]
    return {
        "episode": episode,
        "task": task,
        "split": split,
        "category": category,
        "robot": first.robot,
        "room": room,
        "seed": seed,
        "instruction": first.instruction,
        "difficulty": difficulty,
        "time_limit": first.time_limit,
        "steps": json.dumps(moments),
        "images": [encode_png(o.image) for o in observations],
        "motions": [o.proprioception.motion.ravel() for o in observations],
        "intrinsics": first.camera.intrinsics.ravel(),
        "cameras_in_pelvis": [o.camera.camera_in_pelvis.ravel() for o in observations],
        "key_bodies": [np.asarray(o.proprioception.key_bodies_in_pelvis).ravel() for o in observations],
        "height": first.camera.height,
        "width": first.camera.width,
        "success": success,
        "privileged": json.dumps({"relations": {k: list(v) for k, v in relations.items()}} if relations is not None else {}),
    }


def read_rollouts(folder: Path) -> list[Rollout]:
    """All episodes of a shard folder.

    Raises:
        ValueError: on a task that is not of the training split, such as one of the benchmark.
    """
    found: list[Rollout] = []
    for row in ShardReader(folder, "rollouts"):
        if row["split"] != "train":
            raise ValueError(f"{folder}: episode {row['episode']!r} is of split {row['split']!r}; training takes only 'train'")
        moments = tuple(
            Moment(m["number"], m["step"], m["feedback"], bool(m["ok"]), tuple(m["visible"]), tuple(m["known"]))
            for m in json.loads(row["steps"])
        )
        truth = json.loads(row["privileged"] or "{}").get("relations")
        motions = tuple(decode_motion(motion) for motion in row["motions"])
        found.append(
            Rollout(
                row["episode"],
                row["robot"],
                row["category"],
                row["instruction"],
                int(row["time_limit"]),
                moments,
                motions,
                bool(row["success"]),
                truth,
                row,
            )
        )
    return found
