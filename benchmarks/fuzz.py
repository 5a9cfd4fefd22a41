"""Random calls of the Controller, a third of them malformed: `python -m benchmarks.fuzz actions=100000 seed=0 [workers=2]`.

Every call must end in a well-formed event or in ValueError. After each one the world is checked: finite physics, every object
there once and within the room, liquid conserved, holders that agree with the grasps, joints within their limits, states within
their ranges. What is wrong is printed with the seed and the number of the call, which reproduce it. Paper: none (engineering).
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from configs.arguments import command, read_arguments
from configs.validate import ConfigError
from data.workers import worker_pool
from interface.actions import ACTIONS, ActionKind
from interface.failures import FAILURES
from robots.spec import available_robots
from sim.interfaces.aliases import ALIASES
from sim.interfaces.controller import Controller, Event
from sim.scene.rooms import room_names

_LOG = logging.getLogger(__name__)

#: What a malformed call puts in place of an argument.
HOSTILE: Final[tuple[Any, ...]] = (
    None, True, float("nan"), float("inf"), -float("inf"), 1e308, -1e308, -1, 0, 10**400, 2**63, -(2**63), 1e-320, "",
    " ", "left ", "middle", "LEFT\x00", "a" * 20000, "Mug_0", "Mug_-1", "Mug_1; DROP TABLE objects",
    "../../etc/passwd", "${jndi:x}", "{{7*7}}", "__class__", "%s%n", "Mug_1\nDone()", "Ｍug_1", "\ud800", "🤖_1",
    b"Mug_1", [], [[]], {}, {"x": {}}, {"x": float("nan"), "y": 0}, [1, 2, 3], {1: 2}, object(), int, 1j, (),
    {"action": "Pick"}, set(),
)  # fmt: skip
_STATES: Final = {"isToggled": bool, "isBroken": bool, "isDirty": bool, "isCooked": bool, "isSliced": bool, "isUsedUp": bool}
_JOINT_SLACK: Final = 0.05
_KEYS: Final = (
    "objects",
    "agent",
    "lastAction",
    "lastActionSuccess",
    "errorCode",
    "failureCode",
    "errorMessage",
    "results",
    "arm",
)
_MAX_SPEED_M_S: Final = 30.0


@dataclass(frozen=True)
class FuzzConfig:
    """How much is tried.

    Attributes:
        actions: calls in all.
        seed: every call is a function of it and of the call's number.
        robots, rooms: in turn; all of them when empty.
        per_world: calls in one world before the next one.
        malformed: share of calls that are malformed, on average.
        workers: processes; 1 stays in this one.
    """

    actions: int = 1000
    seed: int = 0
    robots: tuple[str, ...] = ()
    rooms: tuple[str, ...] = ()
    per_world: int = 200
    malformed: float = 1.0 / 3.0
    workers: int = 1

    def __post_init__(self) -> None:
        for name in ("actions", "per_world", "workers"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if not 0.0 <= self.malformed <= 1.0:
            raise ValueError(f"malformed must be within [0, 1], got {self.malformed}")

    @property
    def worlds(self) -> int:
        """How many worlds that takes."""
        return -(-self.actions // self.per_world)


@dataclass(frozen=True)
class Tally:
    """What became of some calls.

    Attributes:
        calls, malformed: how many were made.
        refused: ended in ValueError.
        failed: ended in an event with a failure code.
        violations: what must not happen, one line each.
    """

    calls: int = 0
    malformed: int = 0
    refused: int = 0
    failed: int = 0
    violations: tuple[str, ...] = ()

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.calls + other.calls,
            self.malformed + other.malformed,
            self.refused + other.refused,
            self.failed + other.failed,
            self.violations + other.violations,
        )


def calls(rng: np.random.Generator, controller: Controller, malformed: float) -> Iterator[tuple[Any, bool]]:
    """An endless stream of calls, each with whether it is malformed.

    Well-formed calls go deep: an arm action is usually on the object that the robot went to last.
    """
    focus = ""
    while True:
        objects = list(controller.session.world.objects)
        if not focus or focus not in objects or rng.random() < 0.35:
            focus = objects[int(rng.integers(len(objects)))]
            call: dict[str, Any] = {"action": "GoTo", "objectId": focus}
        else:
            call = _call(rng, objects, focus)
        bad = bool(rng.random() < malformed)
        yield (_spoil(rng, call) if bad else call), bad


def _call(rng: np.random.Generator, objects: Sequence[str], focus: str) -> dict[str, Any]:
    draw = rng.random()
    if draw < 0.07:
        return _control_call(rng, objects)
    if draw < 0.15:
        return {"actions": [_arm_call(rng, objects, focus, arm) for arm in ("left", "right")], "executionMode": "parallel"}
    names = [name for name, spec in ACTIONS.items() if spec.kind is not ActionKind.EPISODE]
    spec = ACTIONS[names[int(rng.integers(len(names)))]]
    if spec.kind is ActionKind.ARM:
        return _arm_call(rng, objects, focus, "left" if rng.random() < 0.5 else "right", spec.name)
    call: dict[str, Any] = {"action": spec.name}
    if spec.takes_object:
        call["objectId"] = focus if rng.random() < 0.7 else objects[int(rng.integers(len(objects)))]
    if spec.amount is not None and rng.random() < 0.7:
        low, high = spec.amount.low, spec.amount.high
        call["amount"] = float(rng.uniform(low, high if rng.random() < 0.3 else min(high, low + 0.25 * (high - low))))
    return call


def _arm_call(rng: np.random.Generator, objects: Sequence[str], focus: str, arm: str, name: str = "") -> dict[str, Any]:
    if not name:
        names = [action for action, spec in ACTIONS.items() if spec.kind is ActionKind.ARM]
        name = names[int(rng.integers(len(names)))]
    call = {"action": name, "arm": arm}
    if ACTIONS[name].takes_object:
        call["objectId"] = focus if rng.random() < 0.7 else objects[int(rng.integers(len(objects)))]
    return call


def _control_call(rng: np.random.Generator, objects: Sequence[str]) -> dict[str, Any]:
    obj = objects[int(rng.integers(len(objects)))]
    position = {"x": float(rng.uniform(-3, 3)), "y": float(rng.uniform(-3, 3)), "z": float(rng.uniform(0, 1.5))}
    options: tuple[dict[str, Any], ...] = (
        {"action": "Undo"},
        {"action": "Redo"},
        {"action": "SaveState", "name": "a"},
        {"action": "LoadState", "name": "a"},
        {"action": "Pass"},
        {"action": "GetReachablePositions"},
        {"action": "GetInteractablePoses", "objectId": obj, "maxPoses": 5},
        {"action": "TP", "x": position["x"], "y": position["y"], "rotation": float(rng.uniform(-360, 360))},
        {"action": "SetObjectPoses", "objectPoses": [{"objectName": obj, "position": position}]},
    )
    return options[int(rng.integers(len(options)))]


def _spoil(rng: np.random.Generator, call: dict[str, Any]) -> Any:
    """Makes a call malformed: a hostile value, a missing or strange argument, a wrong name, or no mapping at all."""
    value = HOSTILE[int(rng.integers(len(HOSTILE)))]
    kind = int(rng.integers(6))
    keys = sorted(call)
    key = keys[int(rng.integers(len(keys)))]
    if kind <= 1:
        return {**call, key: value}
    if kind == 2:
        return {name: item for name, item in call.items() if name != key}
    if kind == 3:
        return {**call, ("speed", "x" * 300, "objectId", "amount", "arm", "bearing")[int(rng.integers(6))]: value}
    if kind == 4:
        names = sorted(ALIASES)
        return {**call, "action": names[int(rng.integers(len(names)))].title() + "X"}
    return value


def check(controller: Controller, event: Event | None) -> list[str]:
    """What is wrong with the world, or with the event of a call; empty when nothing is."""
    world = controller.session.world
    model, data = world.model, world.data
    wrong: list[str] = []
    if not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
        return ["physics is not finite"]
    if float(np.abs(data.qvel).max()) > _MAX_SPEED_M_S:
        wrong.append(f"something moves at {float(np.abs(data.qvel).max()):.0f} m/s")
    x0, y0, x1, y1 = world.room.bounds
    for name, obj in world.objects.items():
        x, y, z = data.xpos[obj.body_id]
        if not (x0 - 0.3 <= x <= x1 + 0.3 and y0 - 0.3 <= y <= y1 + 0.3 and -0.05 <= z <= 3.5):
            wrong.append(f"{name} is lost at {x:.2f} {y:.2f} {z:.2f}")
        if not -60.0 <= obj.state.temperature <= 300.0:
            wrong.append(f"{name} has {obj.state.temperature} degrees")
    robot = world.robot
    assert robot is not None
    for joint in robot.joints:
        index = int(model.joint(joint).id)
        if model.jnt_limited[index]:
            value = float(data.qpos[model.jnt_qposadr[index]])
            low, high = map(float, model.jnt_range[index])
            slack = _JOINT_SLACK if int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_HINGE) else 0.2 * _JOINT_SLACK
            if not low - slack <= value <= high + slack:
                wrong.append(f"joint {joint} is at {value:.3f}, outside [{low:.3f}, {high:.3f}]")
    if abs(world.liquids.balance_l()) > 1e-6:
        wrong.append(f"liquid is not conserved: {world.liquids.balance_l():+.6f} l")
    wrong += _check_holders(controller)
    return wrong if event is None else wrong + _check_event(controller, event)


def _check_holders(controller: Controller) -> list[str]:
    world = controller.session.world
    wrong: list[str] = []
    for arm in ("left", "right"):
        held = [name for name, obj in world.objects.items() if arm in obj.held_by]
        if len(held) > 1 or bool(held) != world.grasps.constraints.holds(arm):
            wrong.append(
                f"the {arm} hand holds {held}, its constraint is {'on' if world.grasps.constraints.holds(arm) else 'off'}"
            )
    return wrong


def _check_event(controller: Controller, event: Event) -> list[str]:
    metadata: Mapping[str, Any] = event.metadata
    missing = [key for key in _KEYS if key not in metadata]
    if missing:
        return [f"the event lacks {missing}"]
    wrong: list[str] = []
    ids = [entry["objectId"] for entry in metadata["objects"]]
    if ids != list(controller.session.world.objects):
        wrong.append("the event's objects are not the world's")
    for entry in metadata["objects"]:
        for key, kind in _STATES.items():
            if not isinstance(entry[key], kind):
                wrong.append(f"{entry['objectId']}.{key} is {entry[key]!r}")
    known = {code.value for code in FAILURES}
    if metadata["failureCode"] and metadata["failureCode"] not in known:
        wrong.append(f"unknown failure code {metadata['failureCode']!r}")
    action = str(metadata["lastAction"])
    if metadata["failureCode"] in known and action in ACTIONS and metadata["failureCode"] not in ACTIONS[action].codes:
        wrong.append(f"{action} failed with {metadata['failureCode']}, which the table of actions does not list for it")
    if metadata["lastActionSuccess"] and metadata["failureCode"]:
        wrong.append(f"success with code {metadata['failureCode']}")
    if event.frame.dtype != np.uint8 or not np.isfinite(event.depth_frame).all():
        wrong.append("a picture is not as it should be")
    return wrong


def run_world(config: FuzzConfig, index: int) -> Tally:
    """The calls of one world, from the configuration and the world's number alone."""
    rng = np.random.default_rng([config.seed, index])
    robots, rooms = config.robots or available_robots(), config.rooms or room_names()
    robot, room = robots[index % len(robots)], rooms[(index // len(robots)) % len(rooms)]
    difficulty = ("natural", "easy", "hard", "medium")[int(rng.integers(4))]
    controller = Controller(robot, room, 24, 24, difficulty, seed=index, privileged=True, undo_limit=5)
    tally = Tally()
    count = min(config.per_world, config.actions - index * config.per_world)
    for number, (call, bad) in enumerate(calls(rng, controller, config.malformed)):
        if number >= count:
            break
        event, wrong, refused = None, [], False
        try:
            event = controller.step(call)
        except ValueError:
            refused = True
            if not bad and not _may_refuse(call):
                wrong.append("a well-formed call was refused")
        except Exception as error:  # noqa: BLE001  # any other exception is what is being looked for
            wrong.append(f"{type(error).__name__}: {error}")
        wrong += check(controller, event)
        where = f"{robot} in {room}, seed={config.seed} world={index} call={number} {str(call)[:160]!r}"
        failed = event is not None and bool(event.metadata["failureCode"])
        tally += Tally(1, int(bad), int(refused), int(failed), tuple(f"{where}: {what}" for what in wrong))
        if wrong:  # a world that is broken once would report the same again
            controller.reset()
        if controller.session.ended:
            controller.reset()
    controller.stop()
    return tally


def _may_refuse(call: Any) -> bool:
    """Whether a call that follows the rules may be refused all the same: nothing saved, no free place, no possible pair."""
    return "actions" in call or call["action"] in ("LoadState", "SetObjectPoses")


def fuzz(config: FuzzConfig) -> Tally:
    """Makes all calls, with a progress bar."""
    columns = (TextColumn("worlds"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    total = Tally()
    with Progress(*columns) as bar:
        task = bar.add_task("worlds", total=config.worlds)
        for tally in _tallies(config):
            total += tally
            for line in tally.violations:
                bar.console.print(line, markup=False)
            bar.advance(task)
    return total


def _tallies(config: FuzzConfig) -> Iterator[Tally]:
    if config.workers == 1:
        for index in range(config.worlds):
            yield run_world(config, index)
        return
    with worker_pool(config.workers) as pool:
        for future in as_completed([pool.submit(run_world, config, index) for index in range(config.worlds)]):
            yield future.result()


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns 0 when nothing was wrong, 1 when something was, 2 on wrong arguments."""
    started = time.monotonic()
    config = read_arguments(FuzzConfig, arguments)
    robots, rooms = config.robots or available_robots(), config.rooms or room_names()
    for names, known, what in ((robots, available_robots(), "robot"), (rooms, room_names(), "room")):
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ConfigError(f"unknown {what} {unknown[0]!r}; allowed: {', '.join(known)}")
    tally = fuzz(config)
    seconds = time.monotonic() - started
    sys.stdout.write(
        f"{tally.calls} calls in {len(rooms)} rooms with {len(robots)} robots, {tally.malformed} malformed: "
        f"{len(tally.violations)} violations; {tally.refused} refused, {tally.failed} failed with a code; {seconds:.0f} s\n"
    )
    return 1 if tally.violations else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
