"""Tasks for episodes in words: of all families of `sim.tasks.families`, in rooms of which half are made up.

`sim.collection.text_world` carries the steps out. For training without pictures; no result is ever measured here. The paper
starts from a pretrained language model instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from sim.collection.demonstrations import draw_family
from sim.tasks.drafts import Draft, NoDraft, Scene
from sim.tasks.families import draw
from sim.tasks.sample import scene_of

#: Furniture of made-up rooms.
_SURFACES: Final = ("CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser", "Shelf")
_ROOMY: Final = ("CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser")
_CONTAINERS: Final = ("Fridge", "Cabinet", "Drawer", "Microwave")
_SWITCHES: Final = ("Faucet", "StoveKnob", "Microwave", "FloorLamp", "Television", "LightSwitch")
_EXTRAS: Final = ("Sofa", "GarbageCan", "Chair", "TVStand", "Toilet")


def draw_task(rooms: Sequence[str], rng: np.random.Generator) -> tuple[Draft, Scene]:
    """A task in one of some rooms or in a made-up one."""
    while True:
        scene = scene_of(str(rng.choice(rooms))) if rng.random() < 0.5 else _made_up(rng)
        family = draw_family(rng)
        try:
            return draw(family, scene, rng), scene
        except NoDraft:
            continue


def _made_up(rng: np.random.Generator) -> Scene:
    """Furniture of a room that nobody built; things of the kitchen and of the living room fit everywhere."""

    def some(types: Sequence[str], least: int, most: int) -> list[str]:
        chosen = rng.permutation(len(types))[: int(rng.integers(least, most + 1))]
        return [f"{types[i]}_{n + 1}" for i in chosen for n in range(1 + int(rng.random() < 0.35))]

    surfaces, containers = some(_SURFACES, 3, 5), some(_CONTAINERS, 1, 3)
    microwaves = [name for name in containers if name.startswith("Microwave")]
    switches = list(dict.fromkeys([*some(_SWITCHES, 1, 3), *microwaves]))
    containers = list(dict.fromkeys([*containers, *(name for name in switches if name.startswith("Microwave"))]))
    basins = {name: f"SinkBasin_{number + 1}" for number, name in enumerate(n for n in switches if n.startswith("Faucet"))}
    extras = some(_EXTRAS, 0, 3)
    furniture = list(dict.fromkeys([*surfaces, *containers, *switches, *basins.values(), *extras]))
    order = [furniture[i] for i in rng.permutation(len(furniture))]
    both = [scene_of(name) for name in ("kitchen_1", "living_room_1")]
    active = (*containers, *switches)
    return Scene(
        room="made_up",
        furniture=tuple(order),
        surfaces=tuple(surfaces),
        targets=(*surfaces, *basins.values()),
        containers=tuple(containers),
        switches=tuple(switches),
        small={kind: (*surfaces, *containers, *basins.values()) for scene in both for kind in scene.small},
        big={kind: tuple(surfaces) for scene in both for kind in scene.big},
        lids=tuple(name for name in extras if name.startswith("Toilet")),
        basins=basins,
        heaters={name: name for name in microwaves},
        near={name: tuple(other for other in (*surfaces, *active) if other != name and rng.random() < 0.5) for name in active},
        roomy=tuple(name for name in surfaces if name.rsplit("_", 1)[0] in _ROOMY),
    )
