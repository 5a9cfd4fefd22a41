"""DualTHOR's own Controller, on this simulator: its calls, its object ids, its replies.

A script written for DualTHOR's `controller.Controller` runs with its import and start lines changed:

    from sim.interfaces.dualthor import Controller

    controller = Controller(robot_type="h1", scene="kitchen")

What DualTHOR's constructor takes for Unity (`config_path`, `start_unity_exe`, `host`, `port`) is accepted and has no use here.
A step returns `{success, imgpath, msg, sceneState}`, or `results` in place of `msg` for two actions; ids have DualTHOR's form
(`Kitchen_Mug_01`). As there, all objects are known from the start and `tp` brings the robot to a place from which the object is
within reach. Unlike there: actions succeed by physics only, an action without an arm takes the one that can do it, and what
goes wrong is a reply that says so, never an exception. Left out: `break`, which DualTHOR's tasks name and its actions lack, is
refused here too.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import imageio.v3 as iio
import numpy as np

from interface.bodies import PAPER_ROBOTS, Arm
from interface.failures import FailureCode
from interface.feedback import ActionOutcome
from interface.steps import Action, PlanStep
from sim.interfaces.aliases import to_action
from sim.interfaces.controller import Stopped
from sim.interfaces.metadata import world_metadata
from sim.interfaces.poses import interactable_poses
from sim.session.session import FreePlay, Session, SessionSnapshot
from sim.skills.locomotion import best_stance

#: Rooms of ours for DualTHOR's scene names; the names of ours are allowed too.
SCENES: Final[Mapping[str, str]] = {
    "kitchen": "kitchen_2",
    "bedroom": "bedroom_1",
    "bathroom": "bathroom_1",
    "livingroom": "living_room_1",
    "livingroom2": "living_room_2",
}
_PREFIX: Final[Mapping[str, str]] = {
    "kitchen": "Kitchen",
    "bedroom": "Bedroom",
    "bathroom": "Bathroom",
    "living_room": "LivingRoom",
}
_ID = re.compile(r"^(?:[A-Za-z]+_)?([A-Za-z]+)_0*([1-9][0-9]*)$")
_REACHABLE_STRIDE: Final = 9
#: Places that `tp` tries, and refusals that another place may mend.
_PLACES: Final = 40
_REACH_CODES: Final = (FailureCode.TOO_FAR, FailureCode.OBSTRUCTED, FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW)

Reply = dict[str, Any]


class Controller(Stopped):
    """DualTHOR's controller.

    Args:
        config_path, host, port, start_unity_exe: DualTHOR's, without use.
        robot_type: `h1` or `x1`.
        scene: DualTHOR's scene name, or a room of ours.
        difficulty: easy, medium, hard or natural; DualTHOR's rates are `natural`.
        seed: key of the contingencies.
        image_folder: where a picture is written after every step; None writes none.
        image_size: its side, pixels.

    Raises:
        ValueError: on an unknown scene or robot.
    """

    def __init__(
        self,
        config_path: str = "config.json",
        start_unity_exe: bool = True,
        robot_type: str = PAPER_ROBOTS[1],
        scene: str = "kitchen",
        host: str = "localhost",
        port: int = 5678,
        *,
        difficulty: str = "easy",
        seed: int = 0,
        image_folder: str | Path | None = None,
        image_size: int = 300,
    ) -> None:
        del config_path, start_unity_exe, host, port
        self._difficulty, self._seed, self._size = difficulty, seed, image_size
        self._folder = None if image_folder is None else Path(image_folder)
        self._states: list[SessionSnapshot] = []
        self._at = 0
        self._last: tuple[str, bool, str] = ("", True, "")
        self._open(robot_type, scene)

    def _open(self, robot_type: str, scene: str) -> None:
        self.session = Session(robot_type, self._difficulty, image_size=0, all_known=True)
        self._scene = scene
        self.session.reset(FreePlay(SCENES.get(scene, scene)), self._seed)
        self._states, self._at = [self.session.snapshot()], 0

    # ---- DualTHOR's calls

    def start(self) -> None:
        """Nothing to start: the simulator runs in this process."""

    def stop(self) -> None:
        """Frees the drawing contexts."""
        self.session.close()

    def step(self, action: str | Mapping[str, Any] = "", **arguments: Any) -> Reply:
        """Executes one action, or two of them as `actions=[...]` with `executionMode` parallel or sequential."""
        call: dict[str, Any] = dict(action) if isinstance(action, Mapping) else {"action": action}
        call |= arguments
        call.pop("successRate", None)  # contingencies decide that here
        try:
            if "actions" in call:
                return self._several(call)
            return self._single(call)
        except ValueError as error:
            return self._reply(str(call.get("action", "")), False, str(error))

    def reset_environment(self) -> Reply:
        """Starts the scene anew."""
        self._open(self.session.robot.name, self._scene)
        return self._reply("resetscene", True, "")

    def reset_scene(self, scene: str, robottype: str = PAPER_ROBOTS[1]) -> Reply:
        """Starts another scene, with another robot."""
        self._open(robottype, scene)
        return self._reply("resetscene", True, "")

    def undo_last_action(self) -> Reply:
        """Goes back one state."""
        return self.step("undo")

    def redo_last_action(self) -> Reply:
        """Goes forward again."""
        return self.step("redo")

    # ---- inside

    def _single(self, call: dict[str, Any]) -> Reply:
        name = str(call.pop("action")).lower()
        if name in ("undo", "redo", "loadstate"):
            return self._travel(name, call)
        if name in ("getcurstate", "resetscene", "resetpose") and not call:
            if name == "resetscene":
                return self.reset_environment()
            if name == "resetpose":
                return self._run([PlanStep.parse("ResetArm(left) & ResetArm(right)")], name)
            return self._reply(name, True, "")
        if name == "tp":
            return self._teleport(call)
        return self._run([self._plan([self._translate(name, call)])], name)

    def _several(self, call: dict[str, Any]) -> Reply:
        mode, entries = call.get("executionMode", "parallel"), call["actions"]
        if mode not in ("parallel", "sequential"):
            raise ValueError(f"unknown executionMode {mode!r}; allowed: parallel, sequential")
        if not isinstance(entries, Sequence) or isinstance(entries, str) or not all(isinstance(e, Mapping) for e in entries):
            raise ValueError(f"actions must be a list of mappings, got {str(entries)[:80]!r}")
        texts = []
        for entry in entries:
            one = dict(entry)
            one.pop("successRate", None)
            texts.append(self._translate(str(one.pop("action", "")).lower(), one))
        steps = [self._plan(texts)] if mode == "parallel" else [self._plan([text]) for text in texts]
        return self._run(steps, " & ".join(str(entry.get("action", "")) for entry in entries), results=True)

    def _plan(self, texts: Sequence[str]) -> PlanStep:
        return PlanStep.parse(" & ".join(texts))

    def _translate(self, name: str, arguments: Mapping[str, Any]) -> str:
        """An action of the grammar for one of DualTHOR's; an arm that is not named is the one that can do it."""
        values = {
            key: self._own_id(value) if key in ("objectID", "objectId", "container") else value
            for key, value in arguments.items()
        }
        if name == "toggle":
            target = str(values.get("objectID", values.get("objectId", "")))
            on = target in self.session.world.objects and self.session.world.objects[target].state.isToggled
            name = "toggleoff" if on else "toggleon"
        wanted = values.get("arm")
        if wanted is not None:
            values["arm"] = str(wanted).lower()
        action = to_action(name, values)
        if action.arm is not None and wanted is None and self.session.assess(action) is not None:
            other = to_action(name, values | {"arm": Arm.LEFT.value})
            action = other if self.session.assess(other) is None else action
        return action.to_text()

    def _run(self, steps: Sequence[PlanStep], name: str, results: bool = False) -> Reply:
        outcomes: list[ActionOutcome] = []
        for step in steps:
            outcomes += self.session.act(step).outcomes
            if not outcomes[-1].success:
                break
        self._remember()
        bad = [outcome for outcome in outcomes if not outcome.success]
        message = "; ".join(f"{outcome.code}: {outcome.message}" for outcome in bad)
        reply = self._reply(name, not bad, message)
        if results:
            del reply["msg"]
            reply["results"] = [
                {
                    "success": outcome.success,
                    "msg": f"{outcome.code}: {outcome.message}" if outcome.code else "",
                    "arm": "" if outcome.action.arm is None else outcome.action.arm.value,
                    "action": outcome.action.name.lower(),
                }
                for outcome in outcomes
            ]
        return reply

    def _teleport(self, call: Mapping[str, Any]) -> Reply:
        name = self._own_id(call.get("objectID", call.get("objectId", "")))
        world, body = self.session.world, self.session.body
        if name not in world.objects:
            raise ValueError(f"unknown object {call.get('objectID')!r} in {world.room.name}")
        point = body.objects.interaction_point(name)
        best = best_stance(
            body.workspace.navigation(),
            body.posture.stance(),
            point[:2],
            body.workspace.comfortable_distance_m(),
            None,
            0.0,
            body.objects.faces_rad(name),
            body.fits,
        )
        places: list[tuple[float, float, float, float | None]] = []
        if best is not None:
            stance = best[0]
            within = [h for h in body.ik.heights() if any(body.ik.within(arm, point, h, stance) for arm in Arm)]
            places += [(stance.x, stance.y, stance.yaw_rad, height) for height in sorted(within, reverse=True)[::2]]
        near = best[0].position if best is not None else point[:2]
        poses = interactable_poses(body, name, limit=1000)  # nearer than is comfortable, or from another side
        poses.sort(key=lambda pose: float(np.hypot(pose.x_m - near[0], pose.y_m - near[1])))
        places += [(pose.x_m, pose.y_m, float(np.radians(pose.yaw_deg)), pose.pelvis_height_m) for pose in poses]
        before = self.session.snapshot()
        for place in places[:_PLACES]:
            self.session.teleport(*place)
            if self._serves(name):
                return self._arrived()
        self.session.restore(before)
        return self._reply("tp", False, f"nowhere near {call.get('objectID')} could an arm do anything with it")

    def _serves(self, name: str) -> bool:
        """Whether what can be done with an object is within an arm's reach from here."""
        obj = self.session.world.objects[name]
        verbs = ["Pick"] * obj.type.pickupable + ["ToggleOff" if obj.state.isToggled else "ToggleOn"] * (obj.toggle_site >= 0)
        verbs += ["Close" if obj.is_open else "Open"] * bool(obj.moving)
        actions = [Action(verb, arm=arm, object_id=name) for verb in verbs for arm in Arm]
        actions += [Action("Lift", object_id=name)] * (obj.movable and not obj.type.pickupable)
        refused = [self.session.assess(action, diagnose=False) for action in actions]
        return not actions or any(one is None or one.code not in _REACH_CODES for one in refused)

    def _arrived(self) -> Reply:
        self._remember()
        return self._reply("tp", True, "")

    def _travel(self, name: str, call: Mapping[str, Any]) -> Reply:
        if name == "loadstate":
            wanted = str(call.get("stateID", ""))
            if not wanted.isdigit() or int(wanted) >= len(self._states):
                raise ValueError(f"no state {wanted!r}; there are 0 to {len(self._states) - 1}")
            self._at = int(wanted)
        else:
            to = self._at + (1 if name == "redo" else -1)
            if not 0 <= to < len(self._states):
                return self._reply(name, False, f"nothing to {name}")
            self._at = to
        self.session.restore(self._states[self._at])
        return self._reply(name, True, "")

    def _remember(self) -> None:
        del self._states[self._at + 1 :]
        self._states.append(self.session.snapshot())
        self._at = len(self._states) - 1

    def _own_id(self, value: Any) -> str:
        """Our id for DualTHOR's (`Kitchen_Mug_01` is `Mug_1`); anything else as it is."""
        match = _ID.match(str(value))
        return str(value)[:48] if match is None else f"{match.group(1)}_{match.group(2)}"

    def _their_id(self, object_id: str) -> str:
        kind, number = object_id.rsplit("_", 1)
        category = self.session.world.room.category
        return f"{_PREFIX.get(category, category.title())}_{kind}_{int(number):02d}"

    def _reply(self, name: str, success: bool, message: str) -> Reply:
        self._last = (name, success, message)
        path = ""
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            file = self._folder / f"step_{self.session.stats.steps:05d}_{self._at:05d}.png"
            iio.imwrite(file, self.session.world.cameras.render("head", self._size, self._size).rgb)
            path = str(file)
        return {"success": success, "imgpath": path, "msg": message, "sceneState": self._scene_state()}

    def _scene_state(self) -> Reply:
        session = self.session
        metadata = world_metadata(session.world)
        visible = set(session.world.cameras.visible_objects())
        for entry in metadata["objects"]:
            entry["visible"] = entry["objectId"] in visible
            for key in ("parentReceptacles", "receptacleObjectIds"):
                entry[key] = [self._their_id(name) for name in entry[key]]
            entry["objectId"] = self._their_id(entry["objectId"])
        agent = metadata["agent"]
        name, success, message = self._last
        points = session.body.workspace.navigation().free_positions()[::_REACHABLE_STRIDE]
        return {
            "id": str(self._at),
            "objects": metadata["objects"],
            "agent": {
                "name": agent["name"],
                "position": agent["position"],
                "rotation": agent["rotation"],
                "lastAction": name,
                "lastActionSuccess": success,
                "errorMessage": message,
                "jointAngles": agent["jointAngles"],
                "gripperAngles": agent["handOpening"],
            },
            "reachablePositions": [{"x": float(x), "y": float(y), "z": 0.0} for x, y in points],
        }
