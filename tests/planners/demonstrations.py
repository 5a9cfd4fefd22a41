"""Demonstrations in the shards' own format, of a few tasks that can be told apart."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data.shards import ShardWriter, encode_png
from interface.steps import PlanStep

FURNITURE = ("CounterTop_1", "Drawer_1", "Fridge_1", "LightSwitch_1")


@dataclass(frozen=True)
class Act:
    """A step: what the expert chose, what was in view, and what was done and with which code if that is not the same."""

    target: str
    visible: tuple[str, ...] = FURNITURE
    done: str = ""
    code: str = "ok"


@dataclass(frozen=True)
class Demo:
    """An episode; its view is grey of this brightness, the brighter the later."""

    task: str
    robot: str
    category: str
    instruction: str
    acts: tuple[Act, ...]
    grey: int = 60
    room: str = "kitchen_1"


PICK = Demo(
    "train_pick_100001",
    "h1",
    "single",
    "Pick up the mug from the counter.",
    (Act("GoTo(CounterTop_1)"), Act("Pick(left, Mug_1)", ("CounterTop_1", "Mug_1"))),
)
STOW = Demo(
    "train_stow_100002",
    "x1",
    "single",
    "Put the phone from the counter in the drawer.",
    (
        Act("GoTo(CellPhone_1)", ("CounterTop_1", "CellPhone_1")),
        Act("Pick(right, CellPhone_1)", ("CounterTop_1", "CellPhone_1"), code="TooFar"),
        Act("Pick(right, CellPhone_1)", ("CounterTop_1", "CellPhone_1")),
        Act("GoTo(Drawer_1)"),
        Act("Open(left, Drawer_1)", ("Drawer_1",)),
        Act("Place(right, Drawer_1)", ("Drawer_1",)),
    ),
    120,
)
SLICE = Demo(
    "train_slice_100003",
    "h1",
    "essential",
    "Cut the bread into slices.",
    (
        Act("GoTo(Knife_1)", ("CounterTop_1", "Knife_1")),
        Act("Pick(right, Knife_1)", ("CounterTop_1", "Knife_1", "Bread_1")),
        Act("Hold(left, Bread_1)", ("CounterTop_1", "Bread_1")),
        Act("Slice(right, Bread_1)", ("CounterTop_1", "Bread_1")),
    ),
    200,
)
LAMP = Demo(
    "train_toggle_on_100004",
    "x1",
    "single",
    "Switch the desk lamp on.",
    (Act("GoTo(DeskLamp_1)", ("DeskLamp_1",)), Act("ToggleOn(left, DeskLamp_1)", ("DeskLamp_1",))),
    240,
    "living_room_1",
)
DEMOS = (PICK, STOW, SLICE, LAMP)


def rows_of(demo: Demo, split: str = "train") -> list[dict[str, Any]]:
    """A shard's rows of an episode."""
    rows: list[dict[str, Any]] = []
    log: list[dict[str, str]] = []
    known = dict.fromkeys(FURNITURE)
    for number, act in enumerate(demo.acts):
        known |= dict.fromkeys(act.visible)
        image = np.full((28, 28, 3), demo.grey, np.uint8)
        image[: 2 + number, :, 0] = 255
        rows.append(
            {
                "episode": f"{demo.task}_{demo.robot}_0",
                "task": demo.task,
                "split": split,
                "category": demo.category,
                "robot": demo.robot,
                "room": demo.room,
                "step": number,
                "time_limit": 12,
                "instruction": demo.instruction,
                "image": encode_png(image),
                "intrinsics": np.eye(3).ravel(),
                "camera_in_pelvis": np.eye(4).ravel(),
                "height": 28,
                "width": 28,
                "motion": np.zeros(64 * 48, np.float32),
                "key_bodies": np.zeros(42, np.float32),
                "visible": list(act.visible),
                "known": list(known),
                "history": list(log),
                "target": act.target,
                "privileged": json.dumps({"secret": "of the simulator"}),
            }
        )
        done = PlanStep.parse(act.done or act.target)
        log.append({"step": done.to_text(), "feedback": "; ".join(f"{one.to_text()} {act.code}" for one in done.actions)})
    return rows


def write_demos(folder: Path, demos: Sequence[Demo] = DEMOS, split: str = "train") -> Path:
    """A complete shard folder."""
    writer = ShardWriter(folder, "demos", "test")
    writer.write(0, [row for demo in demos for row in rows_of(demo, split)])
    writer.finish({})
    return folder
