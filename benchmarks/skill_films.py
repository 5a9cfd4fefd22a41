"""Films each skill by each robot, with a strip of stills: `python -m benchmarks.skill_films [folder] [scene ...]`.

Where only the pelvis height is wrong for a step it is put right first, as the failure's margin says. Not part of any
experiment.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from interface.failures import FailureCode
from interface.steps import PlanStep
from robots.spec import available_robots
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.tools.video import VideoRecorder
from sim.world.world import World

_TABLE: Final = "DiningTable_1"
#: Stills of a strip, evenly over the film, and control ticks between those that are taken.
_STILLS: Final = 9
_STRIDE: Final = 20


@dataclass(frozen=True)
class Scene:
    """What is filmed: objects, states of furniture, and steps, in which `{arm}` is the arm of `arms` or the right one."""

    steps: tuple[str, ...]
    placements: tuple[ObjectPlacement, ...] | None = None
    states: Mapping[str, Mapping[str, bool | float | str]] = field(default_factory=dict)
    room: str = "kitchen_1"
    arms: Mapping[str, str] = field(default_factory=dict)


def _on(name: str, x: float, y: float, **state: bool | float | str) -> ObjectPlacement:
    return ObjectPlacement(name, _TABLE, (x, y), state=state)


SCENES: Final[Mapping[str, Scene]] = {
    "walk": Scene(
        ("MoveAhead(0.6)", "MoveLeft(0.4)", "RotateRight(120)", "MoveBack(0.3)", "MoveDown(0.15)", "MoveUp(0.15)"), ()
    ),
    "pick_place": Scene(("GoTo(Bottle_1)", "Pick(left, Bottle_1)", f"GoTo({_TABLE})", f"Place(left, {_TABLE})")),
    "both_arms": Scene(
        ("GoTo(Cup_1, auto, 15)", "Pick(left, Cup_1) & Pick(right, Mug_1)", "ResetArm(left) & ResetArm(right)"),
        (_on("Mug_1", 1.5, -0.83), _on("Cup_1", 1.78, -0.83)),
    ),
    "open_door": Scene(("GoTo(Microwave_1)", "Open(left, Microwave_1)"), ()),
    "close_door": Scene(("GoTo(Cabinet_1)", "Close(right, Cabinet_1)"), (), {"Cabinet_1": {"isOpen": True}}),
    "open_lid": Scene(("GoTo(LaundryHamper_1)", "Open(right, LaundryHamper_1)"), room="bedroom_1"),
    "close_lid": Scene(("GoTo(Book_1)", "Close(right, Book_1)"), (_on("Book_1", 1.6, -0.85, isOpen=True),)),
    "open_drawer": Scene(("GoTo(Drawer_1)", "Open(right, Drawer_1)"), ()),
    "close_drawer": Scene(("GoTo(Drawer_1, auto, -25)", "Close(right, Drawer_1)"), (), {"Drawer_1": {"isOpen": True}}),
    "toggle": Scene(("GoTo(StoveKnob_1)", "ToggleOn(left, StoveKnob_1)", "ToggleOff(left, StoveKnob_1)"), ()),
    "hold_release": Scene(("GoTo(Cup_1)", "Hold(right, Cup_1)", "Release(right)"), (_on("Cup_1", 1.5, -0.85),)),
    "slice": Scene(
        ("GoTo(Knife_1)", "Pick(left, Knife_1)", "GoTo(Apple_1)", "Hold(right, Apple_1)", "Slice(left, Apple_1)"),
        (_on("Knife_1", 1.5, -0.78), _on("Apple_1", 1.8, -0.8)),
    ),
    "clean": Scene(
        ("GoTo(DishSponge_1)", "Pick(right, DishSponge_1)", "GoTo(Bowl_1)", "Hold(left, Bowl_1)", "Clean(right, Bowl_1)"),
        (_on("DishSponge_1", 1.5, -0.76), _on("Bowl_1", 1.85, -0.8, isDirty=True)),
    ),
    "use_up": Scene(("GoTo(PaperTowelRoll_1)", "UseUp(right, PaperTowelRoll_1)"), (_on("PaperTowelRoll_1", 1.5, -0.88),)),
    "pour": Scene(
        ("GoTo(Cup_1)", "Pick(right, Cup_1)", "GoTo(Bowl_1)", "Pour(right, Bowl_1)"),
        (_on("Cup_1", 1.5, -0.85, fillLiquid="wine"), _on("Bowl_1", 1.8, -0.8)),
    ),
    "fill": Scene(
        ("GoTo(Mug_1)", "Pick({arm}, Mug_1)", "GoTo(Faucet_1)", "Fill({arm}, Faucet_1)"),
        (ObjectPlacement("Mug_1", "CounterTop_1", (-0.6, 2.1)),),
        {"Faucet_1": {"isToggled": True}},
        "kitchen_2",
        {"x1": "left"},
    ),
    "lift": Scene(
        ("GoTo(Box_1)", "Lift(Box_1)", "MoveUp(0.18)", "GoTo(Desk_1)", "PlaceBoth(Desk_1)"),
        (ObjectPlacement("Box_1", "CoffeeTable_1", (0.0, -0.56)),),
        {},
        "living_room_1",
    ),
}


def film(name: str, robot: str, folder: Path, size: int = 360) -> bool:
    """Films one scene, `NAME_ROBOT.mp4`, with a strip of stills, `NAME_ROBOT.png`; whether every step succeeded in the end."""
    scene = SCENES[name]
    session = Session(robot, image_size=0, all_known=True)
    session.reset(FreePlay(scene.room, name.replace("_", " "), placements=scene.placements, states=scene.states), 0)
    stills: list[NDArray[np.uint8]] = []
    fine, ticks = True, 0

    def watch(world: World, _text: str) -> None:
        nonlocal ticks
        ticks += 1
        if ticks % _STRIDE == 0:
            stills.append(np.concatenate([world.cameras.render(camera, 240, 240).rgb for camera in ("left", "head")], axis=0))

    session.watchers.append(watch)
    with VideoRecorder(session, folder / f"{name}_{robot}.mp4", ("behind", "left", "head"), size) as video:
        for text in scene.steps:
            fine &= _act(session, text.format(arm=scene.arms.get(robot, "right")), video)
    session.close()
    chosen = np.linspace(0, len(stills) - 1, min(_STILLS, len(stills))).round().astype(int)
    iio.imwrite(folder / f"{name}_{robot}.png", np.concatenate([stills[index] for index in chosen], axis=1))
    return fine


def _act(session: Session, text: str, video: VideoRecorder) -> bool:
    feedback = session.act(PlanStep.parse(text))
    video.hold(0.4, feedback.to_text())
    outcome = feedback.outcomes[0]
    if outcome.code not in (FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW):
        return feedback.success
    change = outcome.margins["height_m"]
    session.act(PlanStep.parse(f"Move{'Down' if change < 0 else 'Up'}({max(abs(change), 0.01):.3f})"))
    feedback = session.act(PlanStep.parse(text))
    video.hold(0.4, feedback.to_text())
    return feedback.success


def main(folder: Path, names: Sequence[str] = tuple(SCENES)) -> int:
    """Films every scene with every robot and says what succeeded; returns how many did not."""
    failures = 0
    for name in names:
        for robot in available_robots():
            fine = film(name, robot, folder)
            failures += not fine
            sys.stdout.write(f"{folder / f'{name}_{robot}.mp4'}: {'all steps' if fine else 'a step failed'}\n")
            sys.stdout.flush()
    return failures


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m benchmarks.skill_films", description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=Path("outputs/films"))
    parser.add_argument("scene", nargs="*", help=f"of {', '.join(SCENES)}; all by default")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.scene if name not in SCENES]
    if unknown:
        parser.error(f"there is no scene {unknown[0]!r}; allowed: {', '.join(SCENES)}")
    main(arguments.folder, arguments.scene or tuple(SCENES))
