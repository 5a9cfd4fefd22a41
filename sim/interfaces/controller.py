"""AI2-THOR-style front end: `event = controller.step(action="Pick", objectId="Mug_1", arm="left")`.

The same session, physics and failure codes as everywhere else, behind the interface that users of AI2-THOR and DualTHOR know.
Action names of both are understood (`sim.interfaces.aliases`), DualTHOR's `{"actions": [a, b], "executionMode": "parallel"}`
included. A failed action returns an event with `lastActionSuccess` False, an `errorCode` of AI2-THOR where it has one, and our
`failureCode`; an unknown action or argument raises ValueError and changes nothing. Scripts written for DualTHOR's own
Controller use `sim.interfaces.dualthor`.

Episode control that is not part of the planner's grammar lives here: Undo, Redo, SaveState, LoadState, Reset,
GetReachablePositions, and with `privileged=True` what looks at the state or changes it by hand: TP (teleport),
GetInteractablePoses, SetObjectPoses, InitialRandomSpawn.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from interface.bodies import DEFAULT_ROBOT
from interface.failures import FailureCode
from interface.feedback import ActionOutcome
from interface.steps import Action, PlanStep
from sim.interfaces.aliases import number, to_action
from sim.interfaces.metadata import world_metadata
from sim.interfaces.poses import interactable_poses, random_placements, set_object_poses
from sim.scene.rooms import load_room
from sim.session.session import FreePlay, Session, SessionSnapshot, TaskLike
from sim.session.undo import UndoHistory
from sim.skills.navigation import wrap_angle
from sim.world.rendering import MAX_SIZE

#: AI2-THOR's error code for ours; a code that is not here has no counterpart and is reported as it is.
THOR_CODES: Final[Mapping[str, str]] = {
    FailureCode.OBJECT_NOT_KNOWN: "ObjectNotVisible",
    FailureCode.HAND_OCCUPIED: "InventoryFull",
    FailureCode.BOTH_HANDS_BUSY: "InventoryFull",
    FailureCode.HAND_EMPTY: "ObjectNotInInventory",
    FailureCode.NOT_PICKUPABLE: "ObjectNotPickupable",
    FailureCode.NOT_LIFTABLE: "ObjectNotPickupable",
    FailureCode.NEEDS_TWO_HANDS: "ObjectNotPickupable",
    FailureCode.TOO_HEAVY: "ObjectNotPickupable",
    FailureCode.NOT_RECEPTACLE: "ObjectNotAllowedInReceptacle",
    FailureCode.RECEPTACLE_CLOSED: "ReceptacleNotOpen",
    FailureCode.RECEPTACLE_FULL: "ReceptacleFull",
}
#: States that are kept at a time; each takes about two megabytes.
_MOST_SAVED: Final = 100
#: Actions that need `privileged=True`.
_PRIVILEGED: Final = ("TP", "GetInteractablePoses", "SetObjectPoses", "InitialRandomSpawn")
_MAX_POSES: Final = 1000

#: Arguments of each control action.
_CONTROL: Final[Mapping[str, tuple[str, ...]]] = {
    "Undo": (),
    "Redo": (),
    "SaveState": ("name",),
    "LoadState": ("name",),
    "Reset": ("scene", "seed"),
    "GetReachablePositions": (),
    "GetInteractablePoses": ("objectId", "maxPoses"),
    "SetObjectPoses": ("objectPoses",),
    "InitialRandomSpawn": ("randomSeed", "excludedReceptacles", "excludedObjectIds"),
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

    def __repr__(self) -> str:
        """What was done, what became of it, what the hands hold and what is in view."""
        told = self.metadata
        held = ", ".join(f"{arm} {hand['heldObject'] or 'empty'}" for arm, hand in told.get("arm", {}).items())
        seen = [entry["objectId"] for entry in told.get("objects", ()) if entry.get("visible")]
        lines = (
            f"Event of {told.get('lastAction')}: {'ok' if told.get('lastActionSuccess') else told.get('errorMessage')}",
            f"hands: {held}",
            f"in view: {', '.join(seen) or 'nothing'}",
            f"frame {self.frame.shape}, metadata: {', '.join(told)}",
        )
        return "\n".join(textwrap.shorten(line, 240, placeholder=" …") for line in lines)

    def raise_for_failure(self) -> Event:
        """The event itself, when its action succeeded.

        Raises:
            RuntimeError: otherwise, with code and reason.
        """
        if not self.metadata["lastActionSuccess"]:
            told = self.metadata
            raise RuntimeError(f"{told['lastAction']}: {told.get('failureCode') or 'failed'}: {told.get('errorMessage', '')}")
        return self

    @property
    def cv2img(self) -> NDArray[np.uint8]:
        """(H, W, 3) frame, blue first, as OpenCV has it."""
        return np.ascontiguousarray(self.frame[..., ::-1])

    @property
    def object_id_to_color(self) -> dict[str, tuple[int, int, int]]:
        """Colour of each object in the segmentation."""
        return {name: color for color, name in self.color_to_object_id.items()}

    @property
    def instance_detections2D(self) -> dict[str, tuple[int, int, int, int]]:  # noqa: N802 - AI2-THOR's name
        """Box of each visible object: left, top, right, bottom, pixels, the last two beyond it."""
        found = {name: np.argwhere(mask) for name, mask in self.instance_masks.items()}
        return {
            name: (int(at[:, 1].min()), int(at[:, 0].min()), int(at[:, 1].max()) + 1, int(at[:, 0].max()) + 1)
            for name, at in found.items()
        }

    @property
    def instance_masks(self) -> dict[str, NDArray[np.bool_]]:
        """(H, W) mask per visible object."""
        frame = self.instance_segmentation_frame
        masks = {name: np.all(frame == color, axis=-1) for color, name in self.color_to_object_id.items()}
        return {name: mask for name, mask in masks.items() if mask.any()}


class Stopped:
    """A controller that a `with` block stops."""

    def __enter__(self) -> Self:
        """The controller."""
        return self

    def __exit__(self, *error: object) -> None:
        """Stops it."""
        self.stop()

    def stop(self) -> None:
        """Frees what it holds."""
        raise NotImplementedError


class Controller(Stopped):
    """Drives a session action by action.

    Args:
        robot_type: robot name.
        scene: room name.
        width: of the frames, pixels.
        height: likewise.
        difficulty: easy, medium, hard or natural.
        seed: key of the trial's contingencies.
        third_party_cameras: names of `sim.world.rendering.CAMERAS` drawn with every event.
        privileged: allows TP, GetInteractablePoses, SetObjectPoses and InitialRandomSpawn.
        task: start from a task instead of the room's default.
        contingency: name of the outcome distributions (`configs/contingency`, or one's own assets).
        all_known: whether actions may name any object, seen or not.
        undo_limit: how many steps Undo goes back; each takes about a megabyte.
        field_of_view: of the head camera, vertical, degrees; the robot's own when it is None.

    Attributes:
        session: what is driven.
        last_event: the latest event.

    Raises:
        ValueError: on a frame without pixels, or larger than 1280, or a field of view outside 1..170.
    """

    def __init__(
        self,
        robot_type: str = DEFAULT_ROBOT,
        scene: str = "kitchen_1",
        width: int = 300,
        height: int = 300,
        difficulty: str = "easy",
        seed: int = 0,
        third_party_cameras: Sequence[str] = (),
        privileged: bool = False,
        task: TaskLike | None = None,
        undo_limit: int = 100,
        contingency: str = "default",
        all_known: bool = False,
        field_of_view: float | None = None,
    ) -> None:
        for side, value in (("width", width), ("height", height)):
            if not 1 <= value <= MAX_SIZE:
                raise ValueError(f"{side} {value} outside 1..{MAX_SIZE}")
        if field_of_view is not None and not 1.0 <= field_of_view <= 170.0:
            raise ValueError(f"field_of_view {field_of_view:g} outside 1..170")
        self._fov = field_of_view
        self.session = Session(robot_type, difficulty, min(width, height), contingency, all_known=all_known)
        self._shape, self._seed = (height, width), seed
        self._cameras, self._privileged = tuple(third_party_cameras), privileged
        self._task: TaskLike = FreePlay(scene) if task is None else task
        self._history = UndoHistory(undo_limit)
        self._saved: dict[str, SessionSnapshot] = {}
        self.last_event = self.reset()

    def reset(self, scene: str | None = None, seed: int | None = None) -> Event:
        """Starts the room, or another one, anew; what was saved or could be undone is forgotten.

        Raises:
            ValueError: on an unknown room or a seed that is no integer; nothing changes then.
        """
        if scene is not None:
            self._task = FreePlay(load_room(str(scene)).name)
        if seed is not None:
            self._seed = _integer("Reset", "seed", seed)
        self._restart(self._task)
        self.last_event = self._event("Initialize", (), None)
        return self.last_event

    def _restart(self, task: TaskLike) -> None:
        self.session.reset(task, self._seed)
        if self._fov is not None:
            self.session.world.model.camera(self.session.robot.head_camera).fovy = self._fov
        self._history.clear()
        self._saved = {}

    def step(self, action: str | Mapping[str, Any] | None = None, raise_for_failure: bool = False, **arguments: Any) -> Event:
        """Executes an action, or two arm actions in parallel or one after the other.

        Args:
            action: an action name, or a mapping with `action` and arguments, or DualTHOR's `{"actions": [a, b],
                "executionMode": "parallel"}`.
            raise_for_failure: whether an action that fails raises an error.
            arguments: arguments of the action, see `sim.interfaces.aliases.ARGUMENTS`.

        Raises:
            ValueError: on an unknown action, argument or execution mode, or TP without privilege.
            RuntimeError: as `raise_for_failure` says.
        """
        call: dict[str, Any] = dict(action) if isinstance(action, Mapping) else {"action": action}
        event = self._step(call | arguments)
        return event.raise_for_failure() if raise_for_failure else event

    def _step(self, call: dict[str, Any]) -> Event:
        if "actions" in call:
            return self._several(call)
        name = str(call.pop("action", ""))[:80]
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
        entries = call["actions"]
        if not isinstance(entries, Sequence) or isinstance(entries, str) or not 1 <= len(entries) <= 2:
            raise ValueError(f"actions must be a list of one or two actions, got {str(entries)[:80]!r}")
        actions: list[Action] = []
        for entry in entries:
            if not isinstance(entry, Mapping):
                raise ValueError(f"an action is a mapping with the key action, got {str(entry)[:80]!r}")
            one = dict(entry)
            actions.append(to_action(str(one.pop("action", "")), one))
        steps = [PlanStep(tuple(actions))] if mode == "parallel" else [PlanStep((action,)) for action in actions]
        return self._act(steps, " & ".join(action.name for action in actions))

    def _act(self, steps: Sequence[PlanStep], name: str) -> Event:
        before = self.session.snapshot()
        outcomes: list[ActionOutcome] = []
        for step in steps:
            _, feedback = self.session.step(step)
            if not outcomes:  # a step after the end is none
                self._history.add(before)
            outcomes += feedback.outcomes
            if not feedback.success:
                break
        self.last_event = self._event(name, tuple(outcomes), None)
        return self.last_event

    def _control(self, name: str, call: Mapping[str, Any]) -> Event:
        unknown = sorted(map(str, set(call) - set(_CONTROL[name])))
        if unknown:
            raise ValueError(f"{name}: unknown arguments {unknown}; allowed: {', '.join(_CONTROL[name]) or 'none'}")
        if name in _PRIVILEGED and not self._privileged:
            raise ValueError(f"{name} needs Controller(privileged=True), got privileged=False")
        handlers: Mapping[str, Callable[[Mapping[str, Any]], Any]] = {
            "Undo": lambda _: self._history.undo(self.session),
            "Redo": lambda _: self._history.redo(self.session),
            "SaveState": self._save,
            "LoadState": self._load,
            "Reset": lambda c: self.reset(c.get("scene"), c.get("seed")) and None,
            "GetReachablePositions": lambda _: self._reachable(),
            "GetInteractablePoses": self._interactable,
            "SetObjectPoses": self._set_poses,
            "InitialRandomSpawn": self._spawn,
            "TP": self._teleport,
            "Pass": lambda _: None,
        }
        result = handlers[name](call)
        self.last_event = self._event(name, (), result)
        return self.last_event

    def _save(self, call: Mapping[str, Any]) -> str:
        name = str(call.get("name", "default"))
        if name not in self._saved and len(self._saved) >= _MOST_SAVED:
            raise ValueError(f"SaveState: {_MOST_SAVED} states are saved, no more are kept; Reset forgets them")
        self._saved[name] = self.session.snapshot()
        return name

    def _load(self, call: Mapping[str, Any]) -> str:
        name = str(call.get("name", "default"))
        if name not in self._saved:
            raise ValueError(f"no saved state {name!r}; saved: {', '.join(self._saved) or 'none'}")
        self.session.restore(self._saved[name])
        return name

    def _reachable(self) -> list[dict[str, float]]:
        points = self.session.body.workspace.navigation().free_positions()[::9]
        return [{"x": float(x), "y": float(y), "z": 0.0} for x, y in points]

    def _interactable(self, call: Mapping[str, Any]) -> list[dict[str, Any]]:
        name = str(call.get("objectId", ""))
        self.session.world.object(name)
        limit = _integer("GetInteractablePoses", "maxPoses", call.get("maxPoses", 100))
        if not 1 <= limit <= _MAX_POSES:
            raise ValueError(f"GetInteractablePoses: maxPoses {limit} outside 1..{_MAX_POSES}")
        standing = self.session.robot.standing_pelvis_height_m
        return [
            {
                "x": pose.x_m,
                "y": pose.y_m,
                "z": pose.pelvis_height_m,
                "rotation": pose.yaw_deg,
                "standing": pose.pelvis_height_m > standing - 0.05,
                "arms": list(pose.arms),
            }
            for pose in interactable_poses(self.session.body, name, limit)
        ]

    def _set_poses(self, call: Mapping[str, Any]) -> bool:
        poses = call.get("objectPoses")
        if not isinstance(poses, Sequence) or isinstance(poses, str):
            raise ValueError(f"SetObjectPoses: objectPoses must be a list of mappings, got {str(poses)[:80]!r}")
        before = self.session.snapshot()
        set_object_poses(self.session.world, poses)
        self._history.add(before)
        return True

    def _spawn(self, call: Mapping[str, Any]) -> list[dict[str, str]]:
        seed = _integer("InitialRandomSpawn", "randomSeed", call.get("randomSeed", 0))
        lists: list[tuple[str, ...]] = []
        for key in ("excludedReceptacles", "excludedObjectIds"):
            names = call.get(key, ())
            if not isinstance(names, Sequence) or isinstance(names, str):
                raise ValueError(f"InitialRandomSpawn: {key} must be a list of ids or types, got {str(names)[:80]!r}")
            lists.append(tuple(map(str, names)))
        placements = random_placements(
            self._task.room, np.random.default_rng(seed), excluded_receptacles=lists[0], excluded_objects=lists[1]
        )
        self._restart(FreePlay(self._task.room, placements=placements, seed=seed))
        return [{"objectId": placement.object_id, "receptacle": placement.receptacle} for placement in placements]

    def _teleport(self, call: Mapping[str, Any]) -> bool:
        position, rotation = call.get("position", {}), call.get("rotation", 0.0)
        if not isinstance(position, Mapping):
            raise ValueError(f"TP: position must be a mapping with x and y, got {str(position)[:80]!r}")
        x, y = (number("TP", axis, call.get(axis, position.get(axis, 0.0))) for axis in "xy")
        if isinstance(rotation, Mapping):  # degrees about each axis, z up
            if rotation.get("x") or rotation.get("y"):
                raise ValueError(
                    f"TP: rotation {dict(rotation)} must be about z, which is up here; sim.interfaces.thor has y up"
                )
            rotation = rotation.get("z", 0.0)
        yaw = wrap_angle(float(np.deg2rad(np.remainder(number("TP", "rotation", rotation), 360.0))))
        body = self.session.body
        if body.hands.at_furniture() or not body.workspace.navigation().is_free(np.array([x, y])):
            return False
        self._history.add(self.session.snapshot())
        self.session.teleport(x, y, yaw)
        return True

    def _event(self, name: str, outcomes: tuple[ActionOutcome, ...], result: Any) -> Event:
        session = self.session
        view = session.world.cameras.render("head", *self._shape, depth=True, segmentation=True)
        assert view.depth is not None and view.segmentation is not None
        failed = [outcome for outcome in outcomes if not outcome.success]
        metadata = world_metadata(session.world)
        visible = set(session.world.cameras.visible_objects(self._shape[1] / self._shape[0]))
        for entry in metadata["objects"]:
            entry["visible"] = entry["objectId"] in visible
            entry["obstructed"] = not entry["visible"]
        metadata |= {
            "lastAction": name,
            "lastActionSuccess": not failed and result is not False,
            "errorCode": THOR_CODES.get(failed[0].code, failed[0].code) if failed else "",
            "failureCode": failed[0].code if failed else "",
            "failureCategory": failed[0].category.value if failed and failed[0].category else "",
            "margins": dict(failed[0].margins) if failed else {},
            "errorMessage": "; ".join(f"{outcome.action.to_text()}: {outcome.message}" for outcome in failed),
            "actionReturn": result,
            "screenWidth": self._shape[1],
            "screenHeight": self._shape[0],
            "fov": float(session.world.model.camera(session.robot.head_camera).fovy[0]),
            "collided": any(outcome.code == FailureCode.BLOCKED_PATH for outcome in failed),
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
            "arm": {arm.value: {"heldObject": held} for arm, held in session.body.hands.held.items()},
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
            third_party_camera_frames=[session.world.cameras.render(c, *self._shape).rgb for c in self._cameras],
        )


def _integer(action: str, key: str, value: Any) -> int:
    """A whole number of a call that fits a seed."""
    found = number(action, key, value)
    if found != int(found) or not 0 <= found < 2**63:
        raise ValueError(f"{action}: {key} must be an integer from 0, got {str(value)[:80]}")
    return int(value)


def _palette(count: int) -> NDArray[np.uint8]:
    """(count, 3) distinct colours, never black."""
    index = np.arange(1, count + 1)
    return np.stack([(index * 67) % 251 + 1, (index * 131) % 241 + 1, index % 255 + 1], axis=1).astype(np.uint8)
