"""AI2-THOR's Controller on this simulator: its calls, its frame, its conventions, so that its scripts get through.

    from sim.interfaces.thor import Controller

    controller = Controller(scene="FloorPlan1", gridSize=0.25)
    event = controller.step("PickupObject", objectId=mug["objectId"])

`sim.interfaces.controller` speaks the plan grammar in this project's frame; this front end is for scripts written for AI2-THOR
or ManipulaTHOR. Positions have y up, a rotation of 0 looks along z and grows clockwise, in calls and metadata alike. An agent
there acts on whatever is near and in view; a humanoid has to stand right, so an action whose target is out of reach is preceded
by a walk and a change of pelvis height (`autoApproach=False` leaves that to the script). All objects are known from the start.
An action succeeds by physics or fails with AI2-THOR's error code where it has one; calls that make no sense here are refused
with a reason, see `REFUSED`. Paper: none (engineering).

World frame of the simulator: x, y on the floor, z up. AI2-THOR's: left-handed, x and z on the floor, y up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from interface.actions import ACTIONS, ActionKind
from interface.bodies import DEFAULT_ROBOT, Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.interfaces import controller as own
from sim.interfaces.aliases import ALIASES, number
from sim.interfaces.poses import interactable_poses
from sim.scene.rooms import room_names
from sim.skills.failures import SkillFailure
from sim.skills.navigation import wrap_angle
from sim.skills.reach_map import HandPose
from sim.skills.runner import Skill

Array = NDArray[np.float64]
Event = own.Event

#: Calls of AI2-THOR that are refused, with the reason.
REFUSED: Final[Mapping[str, str]] = {
    "LookUp": "the head cameras of these robots are fixed; the view follows the body's yaw and pelvis height",
    "LookDown": "the head cameras of these robots are fixed; the view follows the body's yaw and pelvis height",
    "ThrowObject": "no robot here throws",
    "PushObject": "no skill pushes a loose object",
    "PullObject": "no skill pulls a loose object",
    "BreakObject": "things break by falling; SetObjectPoses may let one fall",
    "CookObject": "food is cooked by heat: put it on a burner or into the microwave and switch that on",
    "DirtyObject": "objects are dirty from the start or by spilling",
    "RotateWristRelative": "a wrist turns with the grasp that inverse kinematics finds",
    "PausePhysicsAutoSim": "physics runs while an action does",
    "AdvancePhysicsStep": "physics runs while an action does; Pass takes no time",
}
#: Options of AI2-THOR's constructor that are taken and have no use here.
UNUSED: Final = (
    "agentMode", "agentCount", "platform", "server_timeout", "local_executable_path", "branch", "commit_id", "quality",
    "x_display", "gpu_device", "headless", "renderDepthImage", "renderInstanceSegmentation", "renderSemanticSegmentation",
    "renderNormalsImage", "visibilityDistance", "snapToGrid", "makeAgentsVisible", "massThreshold", "port", "host",
    "start_unity", "fastActionEmit", "useMassThreshold",
)  # fmt: skip
#: Kinds of rooms by hundreds of AI2-THOR's floor plans.
_PLANS: Final = {0: "kitchen", 2: "living_room", 3: "bedroom", 4: "bathroom"}
#: Ways of walking up that are tried in turn.
_WAYS: Final[tuple[Mapping[str, float], ...]] = (
    {}, {"bearing": -20.0}, {"bearing": 20.0}, {"amount": 0.5}, {"amount": 0.4}, {"bearing": -45.0}, {"bearing": 45.0},
)  # fmt: skip
#: Codes after which another stance or height may serve.
_PLACE_CODES: Final = (
    FailureCode.TOO_FAR, FailureCode.OBSTRUCTED, FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW,
)  # fmt: skip
#: Step back of a robot that something is in the way of.
_BACK_M: Final = 0.3
#: An arm that MoveArm leaves farther from its target than this has failed.
_ARM_M: Final = 0.02


def to_thor(position: Sequence[float] | Array) -> dict[str, float]:
    """A point of the simulator's frame in AI2-THOR's."""
    return {"x": float(position[0]), "y": float(position[2]), "z": float(position[1])}


def from_thor(position: Mapping[str, Any]) -> Array:
    """A point of AI2-THOR's frame in the simulator's.

    Raises:
        ValueError: when it is not a mapping of three finite numbers.
    """
    if not isinstance(position, Mapping) or not set("xyz") <= set(position):
        raise ValueError(f"position must be a mapping with x, y and z, got {str(position)[:80]!r}")
    return np.array([number("position", axis, position[axis]) for axis in "xzy"])


def yaw_to_thor(yaw_rad: float) -> float:
    """Degrees about AI2-THOR's y axis, in [0, 360), of a heading."""
    return float(np.remainder(90.0 - np.degrees(yaw_rad), 360.0))


def yaw_from_thor(rotation: Any) -> float:
    """Heading (rad) of an agent's rotation: degrees, or a mapping with y.

    Raises:
        ValueError: when it is neither, or tilts the agent.
    """
    if isinstance(rotation, Mapping):
        if any(abs(number("rotation", axis, rotation.get(axis, 0.0))) > 1e-6 for axis in "xz"):
            raise ValueError(f"an agent stands upright: rotation {dict(rotation)} must be about y only")
        rotation = rotation.get("y", 0.0)
    return wrap_angle(float(np.radians(90.0 - np.remainder(number("rotation", "y", rotation), 360.0))))


def rotation_to_thor(rotation: Array) -> dict[str, float]:
    """Euler angles of Unity (degrees about z, x, y, in that order) of a (3, 3) rotation."""
    swapped = rotation[np.ix_((0, 2, 1), (0, 2, 1))]
    x = np.arcsin(np.clip(-swapped[1, 2], -1.0, 1.0))
    y, z = np.arctan2(swapped[0, 2], swapped[2, 2]), np.arctan2(swapped[1, 0], swapped[1, 1])
    return {name: float(np.remainder(np.degrees(angle), 360.0)) for name, angle in zip("xyz", (x, y, z), strict=True)}


def _matrix_from_thor(rotation: Mapping[str, Any]) -> Array:
    """(3, 3) rotation in the simulator's frame of Unity's Euler angles."""
    x, y, z = (np.radians(number("rotation", axis, rotation.get(axis, 0.0))) for axis in "xyz")
    rx = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    ry = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    rz = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return (ry @ rx @ rz)[np.ix_((0, 2, 1), (0, 2, 1))]


class Controller(own.Stopped):
    """AI2-THOR's controller.

    Args:
        scene: `FloorPlan1` and so on, for rooms of that kind in turn, or a room of ours.
        robot_type: robot name.
        width: of the frames, pixels.
        height: of the frames, pixels.
        gridSize: default length of a step, and grid of GetReachablePositions, metres.
        rotateStepDegrees: default turn.
        autoApproach: whether an action walks up to what is out of reach, and changes the pelvis height.
        difficulty: easy, medium, hard or natural.
        seed: key of the contingencies.
        fieldOfView: of the head camera, vertical, degrees; the robot's own when it is None.
        options: those of `UNUSED`, which have no use here.

    Attributes:
        last_event: the latest event.

    Raises:
        ValueError: on an unknown scene, robot or option.
    """

    def __init__(
        self,
        scene: str = "FloorPlan1",
        robot_type: str = DEFAULT_ROBOT,
        width: int = 300,
        height: int = 300,
        gridSize: float = 0.25,
        rotateStepDegrees: float = 90.0,
        autoApproach: bool = True,
        difficulty: str = "easy",
        seed: int = 0,
        fieldOfView: float | None = None,
        **options: Any,
    ) -> None:
        unknown = sorted(set(options) - set(UNUSED))
        if unknown:
            raise ValueError(f"unknown option {unknown[0]!r}; allowed: {', '.join(UNUSED)}")
        fov = None if fieldOfView is None else number("Controller", "fieldOfView", fieldOfView)
        self._grid_m, self._turn_deg = number("Controller", "gridSize", gridSize), float(rotateStepDegrees)
        self._approach = autoApproach
        self._cameras: list[tuple[Array, float]] = []
        self._own = own.Controller(
            robot_type, _room(scene), width, height, difficulty=difficulty, seed=seed, privileged=True, all_known=True,
            field_of_view=fov,
        )  # fmt: skip
        self._shape = (height, width)
        self.last_event = self._turned(self._own.last_event)

    @property
    def session(self) -> Any:
        """The session that is driven."""
        return self._own.session

    def reset(self, scene: str | None = None, **options: Any) -> Event:
        """Starts the scene, or another one, anew.

        Raises:
            ValueError: on an unknown scene or option.
        """
        seed = options.pop("seed", None)
        unknown = sorted(set(options) - set(UNUSED) - {"gridSize"})
        if unknown:
            raise ValueError(f"unknown option {unknown[0]!r}; allowed: gridSize, seed, {', '.join(UNUSED)}")
        self._grid_m = number("reset", "gridSize", options.get("gridSize", self._grid_m))
        self._cameras = []
        self.last_event = self._turned(self._own.reset(None if scene is None else _room(scene), seed))
        return self.last_event

    def stop(self) -> None:
        """Frees the drawing contexts."""
        self._own.stop()

    def step(self, action: str | Mapping[str, Any] | None = None, raise_for_failure: bool = False, **arguments: Any) -> Event:
        """Executes one of AI2-THOR's actions.

        Args:
            action: its name, or a mapping with `action` and arguments.
            raise_for_failure: whether an action that fails raises an error.
            arguments: of the action.

        Raises:
            ValueError: on an unknown action or argument, or one of another type.
            RuntimeError: as `raise_for_failure` says.
        """
        call: dict[str, Any] = dict(action) if isinstance(action, Mapping) else {"action": action}
        event = self._step(call | arguments)
        return event.raise_for_failure() if raise_for_failure else event

    def _step(self, call: dict[str, Any]) -> Event:
        name = str(call.pop("action", ""))[:80]
        call.pop("agentId", None)
        if name in REFUSED:
            return self._failed(name, f"{name}: {REFUSED[name]}")
        handler = self._handlers().get(name)
        self.last_event = self._turned(handler(call) if handler is not None else self._act(name, call))
        self.last_event.metadata["lastAction"] = name
        return self.last_event

    # ---- actions that this front end gives a meaning

    def _handlers(self) -> Mapping[str, Callable[[dict[str, Any]], Event]]:
        return {
            "Initialize": lambda call: self.reset(**call) and self._own.last_event,
            "Reset": lambda call: self.reset(**call) and self._own.last_event,
            "Teleport": self._teleport,
            "TeleportFull": self._teleport,
            "Rotate": lambda call: self._teleport({"rotation": call.pop("rotation", 0.0), **call}),  # to a heading
            "Done": lambda _: self._own.step("Pass"),  # the plan grammar's ends the episode
            "Crouch": lambda _: self._to_height(self.session.robot.pelvis_height_range_m[0]),
            "Stand": lambda _: self._to_height(self.session.robot.standing_pelvis_height_m),
            "GetReachablePositions": self._reachable,
            "GetInteractablePoses": self._interactable,
            "AddThirdPartyCamera": self._add_camera,
            "UpdateThirdPartyCamera": self._update_camera,
            "DropHandObject": self._drop,
            "ReleaseObject": self._drop,
            "MoveArm": self._move_arm,
            "MoveArmRelative": self._move_arm_relative,
            "MoveArmBase": self._move_arm_base,
            "MoveArmBaseUp": lambda call: self._by_height(call, 1.0),
            "MoveArmBaseDown": lambda call: self._by_height(call, -1.0),
            "MoveAgent": self._move_agent,
            "RotateAgent": self._rotate_agent,
            "SetObjectPoses": self._set_poses,
        }

    def _act(self, name: str, call: dict[str, Any]) -> Event:
        """An action of the plan grammar, preceded by what brings its object within reach."""
        target = ALIASES.get(name.lower())
        if target is None:  # control actions, and what nobody knows
            return self._own.step(name, **call)
        spec = ACTIONS[target]
        force = bool(call.pop("forceAction", False))
        for key in ("standing", "horizon", "forceVisible", "placeStationary", "manualInteract", "fillLiquid", "speed"):
            call.pop(key, None)
        opened = call.pop("openness", None)
        if spec.kind is ActionKind.BODY and spec.amounts and target != "GoTo":
            turns = spec.amounts[0].unit == "deg"
            if not {"moveMagnitude", "degrees", "amount", "magnitude"} & set(call):
                call["degrees" if turns else "moveMagnitude"] = self._turn_deg if turns else self._grid_m
            return self._own.step(target, **call)
        if opened is not None and target == "Open":
            return self._open_by(call, number(name, "openness", opened), force)
        choices = self._choices(target, call)
        if force and choices[0].object_id is not None:
            action = self._stand_before(choices)
        else:
            action = self._walk_up(choices) if self._approach and spec.takes_object else self._possible(choices)
        return self._own.step(action.name, **_arguments(action))

    def _choices(self, target: str, call: Mapping[str, Any]) -> list[Action]:
        """The action with each arm that may do it: the one asked for, those that hold what it needs, or the free ones."""
        keys = ("receptacleObjectId", "objectId", "objectID") if target.startswith("Place") else ("objectId", "objectID")
        object_id = next((str(call[key]) for key in keys if call.get(key)), None)
        unknown = sorted(set(call) - {*keys, "receptacleObjectId", "objectId", "objectID", "arm"})
        if unknown:
            raise ValueError(f"{target}: unknown arguments {unknown}; allowed: objectId, receptacleObjectId, arm, forceAction")
        spec, held = ACTIONS[target], self.session.body.hands.held
        if target == "Pick" and object_id is None:
            object_id = self._nearest()
        if spec.kind is not ActionKind.ARM:
            return [Action(target, object_id=object_id)]
        if target == "Place" and self.session.body.hands.lifted is not None:
            return [Action("PlaceBoth", object_id=object_id)]
        known = object_id in self.session.world.objects
        if target == "Pick" and known and self.session.world.containment.needs_two_hands(object_id):
            return [Action("Lift", object_id=object_id)]
        if call.get("arm"):
            return [Action(target, arm=_arm(call), object_id=object_id)]
        busy = spec.tool is not None or spec.name in ("Place", "Release")
        arms = [arm for arm in (Arm.RIGHT, Arm.LEFT) if (held[arm] is not None) == busy] or [Arm.RIGHT]
        return [Action(target, arm=arm, object_id=object_id) for arm in arms]

    def _possible(self, choices: Sequence[Action]) -> Action:
        """The first action that would be tried as things are, else the first."""
        return next((action for action in choices if self.session.assess(action) is None), choices[0])

    def _nearest(self) -> str:
        """What lies nearest to a free hand, as ManipulaTHOR's PickupObject without an object takes it."""
        session = self.session
        loose = [name for name, obj in session.world.objects.items() if obj.type.pickupable and not obj.held_by]
        hands = [session.body.arms.hand_pose(arm)[0] for arm, held in session.body.hands.held.items() if held is None]
        if not loose or not hands:
            raise ValueError("PickupObject: no objectId, and no loose object or no free hand")
        return min(loose, key=lambda name: min(float(np.linalg.norm(session.world.poses.center(name) - h)) for h in hands))

    def _walk_up(self, choices: Sequence[Action]) -> Action:
        """Brings the target of an action within reach where walking and another pelvis height do that; which arm then."""
        ways = iter(_WAYS)
        for _ in range(2 * len(_WAYS)):
            refused = [self.session.assess(action) for action in choices]
            possible = self._possible(choices)
            if None in refused or all(one is not None and one.code not in _PLACE_CODES for one in refused):
                return possible
            height = next((one.margins["height_m"] for one in refused if one is not None and "height_m" in one.margins), None)
            if height is not None:
                before = self.session.body.posture.pelvis_height_m
                self._to_height(before + height)
                if abs(self.session.body.posture.pelvis_height_m - before) > 0.01:
                    continue
            way = next(ways, None)
            if way is None:
                break
            event = self._own.step({"action": "GoTo", "objectId": choices[0].object_id, **way})
            if event.metadata["failureCode"] == FailureCode.BLOCKED_PATH:  # room to turn in
                self._own.step("MoveBack", amount=_BACK_M)
                self._own.step({"action": "GoTo", "objectId": choices[0].object_id, **way})
        return self._possible(choices)

    def _stand_before(self, choices: Sequence[Action]) -> Action:
        """AI2-THOR's forceAction: the robot is put where it reaches the object; the action itself is physics as ever."""
        before = self.session.snapshot()
        for pose in (None, *interactable_poses(self.session.body, str(choices[0].object_id), 24)):
            if pose is not None:
                self.session.teleport(pose.x_m, pose.y_m, float(np.radians(pose.yaw_deg)), pose.pelvis_height_m)
            action = self._possible(choices)
            if self.session.assess(action) is None:
                return action
        self.session.restore(before)
        return choices[0]

    def _open_by(self, call: Mapping[str, Any], openness: float, force: bool) -> Event:
        action = self._choices("Open", call)[0]
        item = self.session.world.object(str(action.object_id))
        if force:
            if not item.moving or not 0.0 <= openness <= 1.0:
                return self._failed("OpenObject", f"{action.object_id} cannot be opened by {openness:g}")
            self.session.world.doors.put(item, openness)
            return self._own.step("Pass")
        if openness < 1.0:
            return self._failed(
                "OpenObject", f"a hand opens as far as the skill does; openness {openness:g} needs forceAction=True"
            )
        return self._act("OpenObject", dict(call))

    def _drop(self, call: dict[str, Any]) -> Event:
        held = self.session.body.hands.held
        arm = call.get("arm") or next((arm.value for arm in (Arm.RIGHT, Arm.LEFT) if held[arm] is not None), Arm.RIGHT.value)
        return self._own.step("Release", arm=arm)

    def _to_height(self, height_m: float) -> Event:
        """Changes the pelvis height, as far as the robot's range goes."""
        low, high = self.session.robot.pelvis_height_range_m
        change = float(np.clip(height_m, low, high)) - self.session.body.posture.pelvis_height_m
        if abs(change) < 0.01:
            return self._own.step("Pass")
        return self._own.step("MoveUp" if change > 0.0 else "MoveDown", amount=round(abs(change), 3))

    def _by_height(self, call: Mapping[str, Any], sign: float) -> Event:
        distance = number("MoveArmBase", "distance", call.get("distance", 0.1))
        return self._to_height(self.session.body.posture.pelvis_height_m + sign * distance)

    def _move_arm_base(self, call: Mapping[str, Any]) -> Event:
        """MoveArmBase(y): 0 is the lowest, 1 the highest; the shoulders go with the pelvis here."""
        share = number("MoveArmBase", "y", call.get("y", 0.5))
        low, high = self.session.robot.pelvis_height_range_m
        return self._to_height(low + float(np.clip(share, 0.0, 1.0)) * (high - low))

    def _move_agent(self, call: dict[str, Any]) -> Event:
        ahead, right = (number("MoveAgent", key, call.get(key, 0.0)) for key in ("ahead", "right"))
        event = self._own.step("Pass")
        for length, ways in ((ahead, ("MoveAhead", "MoveBack")), (right, ("MoveRight", "MoveLeft"))):
            if abs(length) > 0.01 and event.metadata["lastActionSuccess"]:
                event = self._own.step(ways[0] if length > 0.0 else ways[1], amount=abs(length))
        return event

    def _rotate_agent(self, call: dict[str, Any]) -> Event:
        degrees = number("RotateAgent", "degrees", call.get("degrees", self._turn_deg))
        return self._own.step("RotateRight" if degrees > 0.0 else "RotateLeft", degrees=abs(degrees))

    # ---- places

    def _teleport(self, call: dict[str, Any]) -> Event:
        unknown = sorted(set(call) - {"position", "rotation", "horizon", "standing", "x", "y", "z", "forceAction"})
        if unknown:
            raise ValueError(f"Teleport: unknown arguments {unknown}; allowed: position, rotation, horizon, standing, x, y, z")
        session = self.session
        now = session.world.servos.base_pose
        place = to_thor((now[0], now[1], now[2])) | {axis: call[axis] for axis in "xyz" if axis in call}
        point = from_thor(call.get("position", place))
        yaw = yaw_from_thor(call["rotation"]) if call.get("rotation") is not None else float(now[3])
        seen = float(self._own.last_event.metadata["agent"]["cameraHorizon"])
        wanted = number("Teleport", "horizon", call["horizon"]) if call.get("horizon") is not None else seen
        if session.body.hands.at_furniture() or not session.body.workspace.navigation().is_free(point[:2]):
            return self._failed("Teleport", f"the robot cannot stand at {to_thor(point)}")
        event = self._own.step("TP", x=float(point[0]), y=float(point[1]), rotation=float(np.degrees(yaw)))
        if call.get("standing") is not None and event.metadata["lastActionSuccess"]:
            low, high = session.robot.pelvis_height_range_m
            event = self._to_height(high if call["standing"] else low)
        if abs(wanted - seen) > 1.0:
            event.metadata["errorMessage"] = f"horizon {wanted:g} has no effect: the head camera is fixed at {seen:.0f}"
        return event

    def _reachable(self, call: dict[str, Any]) -> Event:
        """Free places that the robot can walk to, on a grid through where it stands."""
        grid_m = number("GetReachablePositions", "gridSize", call.get("gridSize", self._grid_m))
        if not 0.02 <= grid_m <= 2.0:
            raise ValueError(f"GetReachablePositions: gridSize {grid_m:g} outside 0.02..2")
        body = self.session.body
        navigation, base = body.workspace.navigation(), self.session.world.servos.base_pose
        x0, y0, x1, y1 = self.session.world.room.bounds
        xs, ys = (
            start + grid_m * np.arange(np.ceil((low - start) / grid_m), np.floor((high - start) / grid_m) + 1)
            for start, low, high in ((base[0], x0, x1), (base[1], y0, y1))
        )
        points = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        free = points[[navigation.is_free(point) for point in points]]
        costs = navigation.ways(body.posture.stance().position).costs_m(free)
        event = self._own.step("Pass")
        event.metadata["actionReturn"] = [to_thor((x, y, base[2])) for x, y in free[np.isfinite(costs)]]
        return event

    def _interactable(self, call: dict[str, Any]) -> Event:
        event = self._own.step("GetInteractablePoses", objectId=call.get("objectId", ""), maxPoses=call.get("maxPoses", 100))
        event.metadata["actionReturn"] = [
            {
                **to_thor((pose["x"], pose["y"], pose["z"])),
                "rotation": yaw_to_thor(float(np.radians(pose["rotation"]))),
                "horizon": event.metadata["agent"]["cameraHorizon"],
                "standing": pose["standing"],
            }
            for pose in event.metadata["actionReturn"]
        ]
        return event

    def _set_poses(self, call: dict[str, Any]) -> Event:
        entries = call.get("objectPoses")
        if not isinstance(entries, Sequence) or isinstance(entries, str) or not all(isinstance(e, Mapping) for e in entries):
            raise ValueError(f"SetObjectPoses: objectPoses must be a list of mappings, got {str(entries)[:80]!r}")
        turned = []
        for entry in entries:
            x, y, z = from_thor(entry.get("position", {}))
            matrix = _matrix_from_thor(entry.get("rotation") or {})
            angles = (
                np.arctan2(matrix[2, 1], matrix[2, 2]),
                np.arcsin(np.clip(-matrix[2, 0], -1.0, 1.0)),
                np.arctan2(matrix[1, 0], matrix[0, 0]),
            )
            rotation = dict(zip("xyz", map(float, np.degrees(angles)), strict=True))
            turned.append(dict(entry) | {"position": {"x": x, "y": y, "z": z}, "rotation": rotation})
        return self._own.step("SetObjectPoses", objectPoses=turned)

    # ---- arms

    def _move_arm(self, call: dict[str, Any]) -> Event:
        """MoveArm(position, coordinateSpace): the hand to a point by inverse kinematics; world, armBase or wrist."""
        space = str(call.get("coordinateSpace", "armBase"))
        arm = _arm(call)
        body, point = self.session.body, from_thor(call.get("position", {}))
        hand, _ = body.arms.hand_pose(arm)
        origins = {"world": None, "armBase": body.posture.shoulder(arm), "wrist": hand}
        if space not in origins:
            raise ValueError(f"MoveArm: coordinateSpace {space!r}; allowed: {', '.join(origins)}")
        origin = origins[space]
        if origin is not None:  # x right, z ahead of the agent
            point = origin + body.posture.turn_to_world(np.array([point[1], -point[0], point[2]]))
        return self._hand_to(arm, point)

    def _move_arm_relative(self, call: dict[str, Any]) -> Event:
        offset = call.get("offset") or {axis: call.get(axis, 0.0) for axis in "xyz"}
        return self._move_arm({"position": offset, "coordinateSpace": "wrist", "arm": call.get("arm", Arm.RIGHT.value)})

    def _hand_to(self, arm: Arm, point: Array) -> Event:
        session = self.session
        goal = session.body.ik.solve(arm, HandPose(point), start=session.body.arms.commanded(arm))
        if goal.error_m > _ARM_M or not session.body.probe.free(arm, [goal.q]):
            goal = session.body.ik.solve(arm, HandPose(point))
        if goal.error_m > _ARM_M:
            return self._failed("MoveArm", f"{to_thor(point)} is {goal.error_m:.2f} m out of the {arm.value} arm's reach")
        if not session.body.probe.free(arm, [goal.q]):
            return self._failed("MoveArm", f"the {arm.value} arm would be in something at {to_thor(point)}")

        def motion() -> Skill:
            yield from session.body.arms.move(arm, [goal.q], speed=0.6)
            if float(np.linalg.norm(session.body.arms.hand_pose(arm)[0] - point)) > 2.0 * _ARM_M:
                raise SkillFailure(FailureCode.OBSTRUCTED)

        feedback = session.perform([(Action("ResetArm", arm=arm), motion())], "MoveArm")
        if not feedback.success:
            return self._failed("MoveArm", f"the {arm.value} arm ran into something before {to_thor(point)}")
        return self._own.step("Pass")

    # ---- cameras

    def _add_camera(self, call: dict[str, Any]) -> Event:
        self._cameras.append(self._camera(call, None))
        event = self._own.step("Pass")
        event.metadata["actionReturn"] = len(self._cameras) - 1
        return event

    def _update_camera(self, call: dict[str, Any]) -> Event:
        index = int(number("UpdateThirdPartyCamera", "thirdPartyCameraId", call.pop("thirdPartyCameraId", 0)))
        if not 0 <= index < len(self._cameras):
            raise ValueError(f"UpdateThirdPartyCamera: there is no camera {index}; there are {len(self._cameras)}")
        self._cameras[index] = self._camera(call, self._cameras[index])
        return self._own.step("Pass")

    def _camera(self, call: Mapping[str, Any], before: tuple[Array, float] | None) -> tuple[Array, float]:
        """Pose (4, 4), x right, y down, z forward, and vertical field of view of a camera that is asked for."""
        unknown = sorted(set(call) - {"position", "rotation", "fieldOfView", "skyboxColor"})
        if unknown:
            raise ValueError(f"camera: unknown arguments {unknown}; allowed: position, rotation, fieldOfView, skyboxColor")
        pose, fovy = (np.eye(4), 90.0) if before is None else (before[0].copy(), before[1])
        if "position" in call:
            pose[:3, 3] = from_thor(call["position"])
        if "rotation" in call or before is None:
            turn = _matrix_from_thor(call.get("rotation") or {})  # of x right, y ahead, z up
            pose[:3, :3] = np.column_stack([turn[:, 0], -turn[:, 2], turn[:, 1]])
        fovy = number("camera", "fieldOfView", call.get("fieldOfView", fovy))
        if not 1.0 <= fovy <= 170.0:
            raise ValueError(f"camera: fieldOfView {fovy:g} outside 1..170")
        return pose, fovy

    # ---- what comes back

    def _failed(self, name: str, message: str) -> Event:
        event = self._own.step("Pass")
        told = {"lastAction": name, "lastActionSuccess": False, "errorMessage": message, "errorCode": "NotAvailable"}
        event.metadata.update(told)
        self.last_event = self._turned(event)
        return self.last_event

    def _turned(self, event: Event) -> Event:
        """An event in AI2-THOR's frame, with the frames of the cameras that were added."""
        metadata = event.metadata
        if metadata.get("coordinateFrame") == "AI2-THOR":
            return event
        world = self.session.world
        for entry in metadata["objects"]:
            rotation = world.poses.pose(entry["objectId"])[:3, :3]
            entry["rotation"] = rotation_to_thor(rotation)
            for key in ("position", "center"):
                entry[key] = _swapped(entry[key])
            entry["axisAlignedBoundingBox"] = {key: _swapped(value) for key, value in entry["axisAlignedBoundingBox"].items()}
            corners = entry["objectOrientedBoundingBox"]["cornerPoints"]
            entry["objectOrientedBoundingBox"] = {"cornerPoints": [[x, z, y] for x, y, z in corners]}
        agent = metadata["agent"]
        agent["position"] = _swapped(agent["position"])
        agent["rotation"] = {"x": 0.0, "y": yaw_to_thor(float(world.servos.base_pose[3])), "z": 0.0}
        metadata["sceneBounds"] = {key: _swapped(value) for key, value in metadata["sceneBounds"].items()}
        metadata["coordinateFrame"] = "AI2-THOR"
        for index, (pose, fovy) in enumerate(self._cameras):
            event.third_party_camera_frames.append(world.cameras.render_from(pose, fovy, *self._shape))
            metadata.setdefault("thirdPartyCameras", []).append(
                {"thirdPartyCameraId": index, "position": to_thor(pose[:3, 3]), "fieldOfView": fovy}
            )
        return event


def _swapped(values: Mapping[str, float]) -> dict[str, float]:
    return {"x": values["x"], "y": values["z"], "z": values["y"]}


def _arm(call: Mapping[str, Any]) -> Arm:
    """The arm of a call, the right one by default.

    Raises:
        ValueError: when it is neither.
    """
    word = str(call.get("arm") or Arm.RIGHT.value).lower()
    if word not in tuple(Arm):
        raise ValueError(f"arm {call['arm']!r} is not left or right")
    return Arm(word)


def _arguments(action: Action) -> dict[str, Any]:
    found: dict[str, Any] = {} if action.object_id is None else {"objectId": action.object_id}
    return found if action.arm is None else found | {"arm": action.arm.value}


def _room(scene: str) -> str:
    """Our room for a floor plan of AI2-THOR.

    Raises:
        ValueError: on a scene of neither.
    """
    if scene in room_names():
        return scene
    text = scene.removeprefix("FloorPlan").removesuffix("_physics")
    if scene.startswith("FloorPlan") and text.isdigit() and int(text) // 100 in _PLANS and 1 <= int(text) % 100 <= 30:
        rooms = [name for name in room_names() if name.startswith(_PLANS[int(text) // 100])]
        return rooms[(int(text) % 100 - 1) % len(rooms)]
    raise ValueError(f"unknown scene {scene!r}; allowed: FloorPlan1-30, 201-230, 301-330, 401-430, {', '.join(room_names())}")
