"""AI2-THOR-style front end: `event = controller.step(action="Pick", objectId="Mug_1", arm="left")`.

The same session, physics and failure codes as everywhere else, behind the interface that users of AI2-THOR and DualTHOR know.
Action names of both are understood (`sim.aliases`), DualTHOR's `{"actions": [a, b], "executionMode": "parallel"}` included. A
failed action returns an event with `lastActionSuccess` False and an `errorCode`; an unknown action or argument raises
ValueError.

Episode control that is not part of the planner's grammar lives here: Undo, Redo, SaveState, LoadState, Reset,
GetReachablePositions and the privileged TP (teleport), which needs `privileged=True`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from data.records import Action, ActionOutcome, PlanStep
from sim.aliases import to_action
from sim.session import FreePlay, Session, SessionSnapshot, TaskLike

__all__ = ["Controller", "Event"]

#: Arguments of each control action.
_CONTROL: Final[Mapping[str, tuple[str, ...]]] = {
    "Undo": (),
    "Redo": (),
    "SaveState": ("name",),
    "LoadState": ("name",),
    "Reset": ("scene", "seed"),
    "GetReachablePositions": (),
    "TP": ("x", "y", "position", "rotation"),
    "Pass": (),
}
_CONTROL_ALIASES: Final[Mapping[str, str]] = {name.lower(): name for name in _CONTROL} | {
    "resetscene": "Reset",
    "getcurstate": "Pass",
    "teleport": "TP",
    "teleportfull": "TP",
}


@dataclass(frozen=True, slots=True)
class Event:
    """What a controller call returns.

    Attributes:
        metadata: AI2-THOR-style state: lastAction, lastActionSuccess, errorMessage, errorCode, actionReturn, agent, arm,
            inventoryObjects, objects, sceneName, collided, results (one entry per action of a parallel pair).
        frame: (H, W, 3) uint8 head-camera view.
        depth_frame: (H, W) float32 metres.
        instance_segmentation_frame: (H, W, 3) uint8, one colour per object.
        color_to_object_id: object id by colour.
        third_party_camera_frames: views of the cameras that were asked for, in their order.
    """

    metadata: dict[str, Any]
    frame: NDArray[np.uint8]
    depth_frame: NDArray[np.float32]
    instance_segmentation_frame: NDArray[np.uint8]
    color_to_object_id: dict[tuple[int, int, int], str] = field(default_factory=dict)
    third_party_camera_frames: list[NDArray[np.uint8]] = field(default_factory=list)

    @property
    def instance_masks(self) -> dict[str, NDArray[np.bool_]]:
        """(H, W) mask per visible object."""
        frame = self.instance_segmentation_frame
        masks = {name: np.all(frame == color, axis=-1) for color, name in self.color_to_object_id.items()}
        return {name: mask for name, mask in masks.items() if mask.any()}


class Controller:
    """Drives a session action by action.

    Args:
        robot_type: robot name.
        scene: room name.
        width, height: size of the frames; both must agree.
        difficulty: easy, medium, hard or natural.
        seed: key of the trial's luck.
        third_party_cameras: names of `sim.rendering.CAMERAS` drawn with every event.
        privileged: allows TP.
        task: start from a task instead of the room's default.

    Attributes:
        session: what is driven.
        last_event: the latest event.

    Raises:
        ValueError: when width and height differ.
    """

    def __init__(
        self,
        robot_type: str = "h1",
        scene: str = "kitchen_1",
        width: int = 300,
        height: int = 300,
        difficulty: str = "easy",
        seed: int = 0,
        third_party_cameras: Sequence[str] = (),
        privileged: bool = False,
        task: TaskLike | None = None,
    ) -> None:
        if width != height:
            raise ValueError(f"frames are square, got width {width} and height {height}")
        self.session = Session(robot_type, difficulty, width)
        self._size, self._seed = width, seed
        self._cameras, self._privileged = tuple(third_party_cameras), privileged
        self._task: TaskLike = FreePlay(scene) if task is None else task
        self._undo: list[SessionSnapshot] = []
        self._redo: list[SessionSnapshot] = []
        self._saved: dict[str, SessionSnapshot] = {}
        self.last_event = self.reset()

    def reset(self, scene: str | None = None, seed: int | None = None) -> Event:
        """Starts the room, or another one, anew."""
        if scene is not None:
            self._task = FreePlay(scene)
        self._seed = self._seed if seed is None else seed
        self.session.reset(self._task, self._seed)
        self._undo, self._redo, self._saved = [], [], {}
        self.last_event = self._event("Initialize", (), None)
        return self.last_event

    def step(self, action: str | Mapping[str, Any] | None = None, **arguments: Any) -> Event:
        """Executes an action, or two arm actions in parallel or one after the other.

        Args:
            action: an action name, or a mapping with `action` and arguments, or DualTHOR's `{"actions": [a, b],
                "executionMode": "parallel"}`.
            arguments: arguments of the action, see `sim.aliases.ARGUMENTS`.

        Raises:
            ValueError: on an unknown action, argument or execution mode, or TP without privilege.
        """
        call: dict[str, Any] = dict(action) if isinstance(action, Mapping) else {"action": action}
        call |= arguments
        if "actions" in call:
            return self._several(call)
        name = str(call.pop("action", ""))
        control = _CONTROL_ALIASES.get(name.lower())
        if control is not None:
            return self._control(control, call)
        return self._act([PlanStep((to_action(name, call),))], name)

    def stop(self) -> None:
        """Frees the drawing contexts."""
        self.session.close()

    def _several(self, call: Mapping[str, Any]) -> Event:
        mode = call.get("executionMode", "parallel")
        if mode not in ("parallel", "sequential"):
            raise ValueError(f"unknown executionMode {mode!r}; allowed: parallel, sequential")
        unknown = sorted(set(call) - {"actions", "executionMode", "action"})
        if unknown:
            raise ValueError(f"unknown arguments {unknown}; allowed: actions, executionMode")
        actions: list[Action] = []
        for entry in call["actions"]:
            one = dict(entry)
            actions.append(to_action(str(one.pop("action", "")), one))
        steps = [PlanStep(tuple(actions))] if mode == "parallel" else [PlanStep((action,)) for action in actions]
        return self._act(steps, " & ".join(action.name for action in actions))

    def _act(self, steps: Sequence[PlanStep], name: str) -> Event:
        self._undo.append(self.session.snapshot())
        self._redo.clear()
        outcomes: list[ActionOutcome] = []
        for step in steps:
            _, feedback = self.session.step(step)
            outcomes += feedback.outcomes
            if not feedback.success:
                break
        self.last_event = self._event(name, tuple(outcomes), None)
        return self.last_event

    def _control(self, name: str, call: Mapping[str, Any]) -> Event:
        unknown = sorted(set(call) - set(_CONTROL[name]))
        if unknown:
            raise ValueError(f"{name}: unknown arguments {unknown}; allowed: {', '.join(_CONTROL[name]) or 'none'}")
        handlers: Mapping[str, Callable[[Mapping[str, Any]], Any]] = {
            "Undo": lambda _: self._travel(self._undo, self._redo),
            "Redo": lambda _: self._travel(self._redo, self._undo),
            "SaveState": self._save,
            "LoadState": self._load,
            "Reset": lambda c: self.reset(c.get("scene"), c.get("seed")) and None,
            "GetReachablePositions": lambda _: self._reachable(),
            "TP": self._teleport,
            "Pass": lambda _: None,
        }
        result = handlers[name](call)
        self.last_event = self._event(name, (), result)
        return self.last_event

    def _travel(self, source: list[SessionSnapshot], target: list[SessionSnapshot]) -> bool:
        """Moves along the undo history; False when there is nothing to go to."""
        if not source:
            return False
        target.append(self.session.snapshot())
        self.session.restore(source.pop())
        return True

    def _save(self, call: Mapping[str, Any]) -> str:
        name = str(call.get("name", "default"))
        self._saved[name] = self.session.snapshot()
        return name

    def _load(self, call: Mapping[str, Any]) -> str:
        name = str(call.get("name", "default"))
        if name not in self._saved:
            raise ValueError(f"no saved state {name!r}; saved: {', '.join(self._saved) or 'none'}")
        self.session.restore(self._saved[name])
        return name

    def _reachable(self) -> list[dict[str, float]]:
        points = self.session.body.navigation().free_positions()[::9]
        return [{"x": float(x), "y": float(y), "z": 0.0} for x, y in points]

    def _teleport(self, call: Mapping[str, Any]) -> bool:
        if not self._privileged:
            raise ValueError("TP needs Controller(privileged=True), got privileged=False")
        position = call.get("position", {})
        x, y = float(call.get("x", position.get("x", 0.0))), float(call.get("y", position.get("y", 0.0)))
        yaw = float(np.deg2rad(float(call.get("rotation", 0.0))))
        if not self.session.body.navigation().is_free(np.array([x, y])):
            return False
        self._undo.append(self.session.snapshot())
        self.session.teleport(x, y, yaw)
        return True

    def _event(self, name: str, outcomes: tuple[ActionOutcome, ...], result: Any) -> Event:
        session = self.session
        view = session.world.render("head", self._size, self._size, depth=True, segmentation=True)
        assert view.depth is not None and view.segmentation is not None
        failed = [outcome for outcome in outcomes if not outcome.success]
        metadata = session.world.metadata()
        visible = set(session.world.visible_objects(view.segmentation))
        for entry in metadata["objects"]:
            entry["visible"] = entry["objectId"] in visible
        metadata |= {
            "lastAction": name,
            "lastActionSuccess": not failed and result is not False,
            "errorCode": failed[0].code if failed else "",
            "errorMessage": "; ".join(f"{outcome.action.to_text()}: {outcome.message}" for outcome in failed),
            "actionReturn": result,
            "collided": any(outcome.code == "BlockedPath" for outcome in failed),
            "results": [
                {
                    "action": outcome.action.to_text(),
                    "arm": None if outcome.action.arm is None else outcome.action.arm.value,
                    "success": outcome.success,
                    "code": outcome.code,
                    "msg": outcome.message,
                    "contingency": outcome.contingency,
                }
                for outcome in outcomes
            ],
            "arm": {arm.value: {"heldObject": held} for arm, held in session.body.held.items()},
        }
        palette = _palette(len(session.world.objects))
        colors = np.concatenate([palette, np.zeros((2, 3), dtype=np.uint8)])  # -1 nothing, -2 robot: black
        names = list(session.world.objects)
        return Event(
            metadata=metadata,
            frame=view.rgb,
            depth_frame=view.depth,
            instance_segmentation_frame=colors[view.segmentation],
            color_to_object_id={(int(r), int(g), int(b)): names[i] for i, (r, g, b) in enumerate(palette)},
            third_party_camera_frames=[session.world.render(c, self._size, self._size).rgb for c in self._cameras],
        )


def _palette(count: int) -> NDArray[np.uint8]:
    """(count, 3) distinct colours, never black."""
    index = np.arange(1, count + 1)
    return np.stack([(index * 67) % 251 + 1, (index * 131) % 241 + 1, index % 255 + 1], axis=1).astype(np.uint8)
