"""Every door, drawer and lid of the ten rooms, opened and shut by both robots: which arm succeeds, and how long it plans.

    python benchmarks/doors.py [--robots h1 x1] [--rooms ROOM ...] [--parts doors drawers lids]

Each door and drawer is shut twice by each arm: once after GoTo and the robot's own Open, once after GoTo when it stands wide
open from the start. Each lid is opened and closed by each arm, from where the one before left it if that succeeded. As a
planner would, the robot changes its height when the failure says so and goes to another distance when it is too far. `shut` is
the share of the range that is left (0: shut), `open` how far a lid is open afterwards, `moved_m` how far its object slid on
the floor or table, `plan_s` the time of the last assessment. The last lines count.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np

from interface.bodies import Arm
from interface.feedback import ActionOutcome
from interface.steps import Action, PlanStep
from sim.scene.catalogue import MovingSpec
from sim.scene.rooms import room_names
from sim.session.session import FreePlay, Session
from sim.skills.failures import SkillFailure

#: What follows the object in GoTo, in turn: distances and bearings.
PLACES = ("", ", 0.45", ", 0.55", ", auto, -20", ", auto, 20", ", 0.4", ", 0.5, -30", ", 0.5, 30", ", 0.6")
#: An object whose lid is moved may slide this far.
STAYS_M = 0.05


def act(session: Session, text: str) -> ActionOutcome:
    """One action of the language."""
    return session.act(PlanStep.parse(text)).outcomes[0]


def reach(session: Session, action: Action, places: tuple[str | None, ...]) -> tuple[str, float]:
    """Does an action from the first place where it is possible; None stands for staying. Returns the code and planning time."""
    refusal: SkillFailure | None = None
    seconds = 0.0
    for place in places:
        if place is not None:
            act(session, f"GoTo({action.object_id}{place})")
        for _ in range(4):
            started = time.perf_counter()
            refusal = session.assess(action)
            seconds = time.perf_counter() - started
            if refusal is None:
                outcome = session.act(PlanStep((action,))).outcomes[0]
                return "ok" if outcome.success else str(outcome.code), seconds
            change = refusal.margins.get("height_m")
            if change is None:
                break
            act(session, f"{'MoveUp' if change > 0 else 'MoveDown'}({max(abs(change), 0.03):.2f})")
    return str(refusal.code if refusal is not None else "none"), seconds


def objs(session: Session, part: str) -> list[str]:
    """Objects of the running episode with a door, a drawer or a lid."""
    return [name for name, obj in session.world.objects.items() if any(_part(m) == part for m in obj.type.moving)]


def _part(moving: MovingSpec) -> str:
    return "drawers" if moving.joint == "slide" else "lids" if moving.is_lid else "doors"


def try_door(session: Session, room: str, door: str) -> list[bool]:
    """Prints one line per way of opening and arm; returns which of them succeeded."""
    done: list[bool] = []
    for way in ("opened by the robot", "open from the start"):
        session.reset(FreePlay(room, states={door: {"isOpen": True}} if way == "open from the start" else {}), 0)
        places: tuple[str | None, ...] = PLACES[:3]
        if way == "opened by the robot":
            codes = [reach(session, Action("Open", arm=arm, object_id=door), PLACES)[0] for arm in _until_open(session, door)]
            if not session.world.objects[door].is_open:
                print(f"{session.robot.name:5}{room:15}{door:17}{way:21}-     not opened: {codes[-1]}", flush=True)
                continue
            places = (None, *places)
        start = session.snapshot()
        for arm in Arm:
            session.restore(start)
            code, seconds = reach(session, Action("Close", arm=arm, object_id=door), places)
            left = session.world.objects[door].openness
            code = "ok" if code == "AlreadyInState" and left < 0.06 else code  # the body brushed it shut on the way
            done.append(code == "ok")
            line = (
                f"{session.robot.name:5}{room:15}{door:17}{way:21}{arm.value:6}{code:15}shut {left:.2f}  plan_s {seconds:.2f}"
            )
            print(line, flush=True)
    return done


def try_lid(session: Session, room: str, name: str) -> list[bool]:
    """Prints one line per arm and verb; returns which of them succeeded and left the object in its place."""
    done: list[bool] = []
    for arm in Arm:
        session.reset(FreePlay(room), 0)
        obj = session.world.objects[name]
        for verb in ("Close", "Open") if obj.is_open else ("Open", "Close"):
            if obj.is_open != (verb == "Close"):  # the verb before failed
                session.reset(FreePlay(room, states={name: {"isOpen": verb == "Close"}}), 0)
                obj = session.world.objects[name]
            place, carriers = session.world.poses.pose(name)[:3, 3], session.world.containment.parents(name)
            code, seconds = reach(session, Action(verb, arm=arm, object_id=name), (None, *PLACES[:5]))
            moved = float(np.linalg.norm(session.world.poses.pose(name)[:2, 3] - place[:2]))
            stays = session.world.containment.parents(name) == carriers and moved < STAYS_M
            done.append(code == "ok" and stays)
            line = (
                f"{session.robot.name:5}{room:15}{name:17}{verb:7}{arm.value:6}{code:15}open {obj.openness:.2f}  "
                f"moved_m {moved:.3f}{'' if stays else ' !'}  plan_s {seconds:.2f}"
            )
            print(line, flush=True)
    return done


def _until_open(session: Session, door: str) -> Iterator[Arm]:
    for arm in Arm:
        if not session.world.objects[door].is_open:
            yield arm


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--robots", nargs="+", default=["h1", "x1"])
    parser.add_argument("--rooms", nargs="+", default=list(room_names()))
    parser.add_argument("--parts", nargs="+", default=["doors", "drawers", "lids"], choices=["doors", "drawers", "lids"])
    arguments = parser.parse_args()
    totals: list[str] = []
    for robot in arguments.robots:
        session = Session(robot, image_size=0, all_known=True)
        for part in arguments.parts:
            done: list[bool] = []
            for room in arguments.rooms:
                session.reset(FreePlay(room), 0)
                for name in objs(session, part):
                    done += (try_lid if part == "lids" else try_door)(session, room, name)
            totals.append(f"{robot:5}{part:8}{sum(done)} of {len(done)}")
        session.close()
    print("\n".join(totals))


if __name__ == "__main__":
    main()
