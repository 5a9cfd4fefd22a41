"""Turns drafts into tasks: positions of objects, the robot's start, wording, budget; and samples training tasks without end.

A training task is a function of its seed, its room and nothing else. Benchmark tasks come from the same code with other seeds:
`TRAIN_SEEDS` and `BENCHMARK_SEEDS` do not meet, and every draw is keyed by the seed and the split, so no training task
repeats a benchmark task's stream. Start poses, pelvis heights, objects, distractors and wordings all vary.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim.catalogue import ObjectType, load_catalogue
from sim.navigation import NavigationMap
from sim.robots.spec import load_robot
from sim.rooms import load_room
from sim.skills.obstacles import navigation_map
from sim.tasks.drafts import FAMILIES, Draft, NoDraft, Scene, category_of, draw
from sim.tasks.task import Placement, Start, Task
from sim.world import World, WorldError

__all__ = ["BENCHMARK_SEEDS", "ROBOTS", "ROOMS", "TRAIN_SEEDS", "rng_for", "sample_task", "scene_of", "settle"]

ROOMS: Final = ("kitchen_1", "living_room_1")
ROBOTS: Final = ("h1", "x1")
#: Seeds of the benchmark's draws; training seeds start where they end.
BENCHMARK_SEEDS: Final = range(0, 100_000)
TRAIN_SEEDS: Final = range(100_000, 2**31)

#: Types that tasks move with one hand. Flat cutlery is left out: fingers of this size do not pick it up from a table.
_SMALL_TYPES: Final = (
    "Mug", "Cup", "Bowl", "Bottle", "WineBottle", "Apple", "Tomato", "Potato", "Bread", "Lettuce", "SaltShaker",
    "PepperShaker", "PaperTowelRoll", "Kettle", "SoapBottle", "Book", "RemoteControl", "TissueBox", "Vase", "AlarmClock",
    "Pillow", "WateringCan",
)  # fmt: skip
#: Types that tasks carry with both hands.
_BIG_TYPES: Final = ("Box", "HousePlant", "Pot")
_SURFACE_TYPES: Final = ("CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser", "TVStand", "Shelf", "Sofa")
_CONTAINER_TYPES: Final = ("Fridge", "Cabinet", "Drawer", "Microwave")
_SWITCH_TYPES: Final = ("Faucet", "StoveKnob", "Microwave", "FloorLamp", "Television", "LightSwitch")

#: Steps that a family usually takes; a training task's budget is drawn around it.
_TYPICAL_STEPS: Final[Mapping[str, int]] = {
    "pick": 4, "place": 8, "open": 3, "close": 3, "toggle_on": 3, "toggle_off": 3, "transport_two": 10, "transport_each": 14,
    "pick_and_toggle_on": 7, "pick_and_toggle_off": 7, "pick_and_open": 7, "fetch": 9, "fetch_hold": 5, "stow": 9,
    "stow_close": 11, "lift": 4, "carry": 7, "hold_two": 7, "carry_and_toggle": 10, "carry_and_place": 13,
}  # fmt: skip
_HEIGHT_GRID_M: Final = 0.05
_START_CLEARANCE_M: Final = 0.05
#: An object farther away than this, or farther off the heading, does not count as seen at the start.
_SEEN_DISTANCE_M: Final = (0.6, 2.0)
_SEEN_BEARING_RAD: Final = np.deg2rad(25.0)
_ATTEMPTS: Final = 40


def rng_for(*key: object) -> np.random.Generator:
    """A random stream named by its key (hashed, independent of the process)."""
    digest = hashlib.sha256("/".join(map(str, key)).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))


@functools.cache
def scene_of(room: str) -> Scene:
    """What a room offers to tasks, read from its layout and the catalogue."""
    layout, catalogue = load_room(room), load_catalogue()
    ids = tuple(item.id for item in layout.furniture)
    kinds = {item.id: catalogue.get(item.type_name) for item in layout.furniture}

    def of(types: Sequence[str]) -> tuple[str, ...]:
        return tuple(name for name in ids if kinds[name].name in types)

    surfaces, containers = of(_SURFACE_TYPES), of(_CONTAINER_TYPES)

    def table(types: Sequence[str], places: Sequence[str]) -> dict[str, tuple[str, ...]]:
        rows: dict[str, tuple[str, ...]] = {}
        for name in types:
            kind = catalogue.get(name)
            fits = tuple(place for place in places if _fits(kind, kinds[place]))
            if layout.category in kind.rooms and fits:
                rows[name] = fits
        return rows

    return Scene(
        room=room,
        furniture=ids,
        surfaces=surfaces,
        containers=containers,
        switches=of(_SWITCH_TYPES),
        small=table(_SMALL_TYPES, (*surfaces, *containers)),
        big=table(_BIG_TYPES, surfaces),
    )


def _fits(kind: ObjectType, place: ObjectType) -> bool:
    """Whether an object can stand on a surface of a type, in any orientation, with its whole footprint."""
    radius, height = float(np.hypot(kind.size[0], kind.size[1])) / 2.0, kind.size[2]
    surfaces = [*place.surfaces, *(surface for moving in place.moving for surface in moving.surfaces)]
    return any(min(s.rect[2], s.rect[3]) / 2.0 >= radius and (s.clearance >= height or not s.inside) for s in surfaces)


def sample_task(seed: int, room: str | None = None, family: str | None = None, split: str = "train") -> Task:
    """A task drawn from a seed.

    Args:
        seed: one of `TRAIN_SEEDS` or `BENCHMARK_SEEDS`, whichever belongs to the split.
        room: one of `ROOMS`; drawn when None.
        family: a name of `sim.tasks.drafts.FAMILIES`; drawn when None (category first, then family).
        split: `train` or `benchmark`.

    Raises:
        ValueError: when the seed belongs to another split, or nothing suitable was drawn.
    """
    seeds = {"train": TRAIN_SEEDS, "benchmark": BENCHMARK_SEEDS}.get(split)
    if seeds is None or seed not in seeds:
        raise ValueError(f"seed {seed} is not a {split} seed; allowed: train {TRAIN_SEEDS}, benchmark {BENCHMARK_SEEDS}")
    for attempt in range(_ATTEMPTS):
        rng = rng_for("task", split, seed, attempt)
        where = room or str(rng.choice(ROOMS))
        what = family or str(rng.choice(FAMILIES[str(rng.choice(list(FAMILIES)))]))
        try:
            draft = draw(what, scene_of(where), rng)
            return settle(draft, f"{split}_{what}_{seed}", seed, split, rng)
        except (NoDraft, WorldError):
            if room is not None and family is not None and attempt == _ATTEMPTS - 1:
                raise
    raise ValueError(f"no task of family {family!r} in room {room!r} from seed {seed} in {_ATTEMPTS} attempts")


def settle(draft: Draft, task_id: str, seed: int, split: str, rng: np.random.Generator) -> Task:
    """Gives a draft positions, a start, words and a budget.

    Raises:
        WorldError: when the objects do not fit.
    """
    scene = scene_of(draft.room)
    wishes = [
        Placement(name, name.rsplit("_", 1)[0], carrier, yaw_deg=_yaw_deg(rng), state=draft.object_states.get(name, {}))
        for name, carrier in draft.objects.items()
    ]
    world = World(None, draft.room, wishes, states=draft.states, seed=int(rng.integers(2**31)), settle_s=0.05)
    positions = {name: world.pose(name)[:2, 3] for name in world.objects}
    placements = tuple(
        replace(wish, xy=(round(float(positions[wish.object_id][0]), 3), round(float(positions[wish.object_id][1]), 3)))
        for wish in wishes
    )
    radius = max(load_robot(name).footprint_radius_m for name in ROBOTS)
    focus = [positions[name] for name in draft.focus.values()]
    start = _draw_start(navigation_map(world, radius + _START_CLEARANCE_M), focus[0], rng)
    hidden = [name for name, carrier in draft.objects.items() if not _in_view(start, positions[name], draft, carrier)]
    sentences = draft.sentences(scene.furniture, rng, hidden)
    typical = _TYPICAL_STEPS[draft.family]
    return Task(
        id=task_id,
        room=draft.room,
        category=category_of(draft.family),  # type: ignore[arg-type]
        family=draft.family,
        instruction=sentences[0],
        paraphrases=sentences[1:4],
        start=start,
        placements=placements,
        states=draft.states,
        goals=tuple(draft.goals),
        step_budget=int(np.ceil(1.5 * typical)) + 2,
        split=split,  # type: ignore[arg-type]
        seed=seed,
    )


def _yaw_deg(rng: np.random.Generator) -> float:
    """Objects stand roughly square to the furniture, as people put them."""
    return float(rng.choice((0.0, 90.0, 180.0, 270.0))) + float(rng.integers(-3, 4)) * 5.0


def _draw_start(navigation: NavigationMap, target: NDArray[np.float64], rng: np.random.Generator) -> Start:
    """A free base pose, half of the time near the first object and facing it, and a pelvis height per robot."""
    free = navigation.free_positions()
    facing = rng.random() < 0.5
    if facing:
        gaps = np.linalg.norm(free - target, axis=1)
        near = free[(gaps > 0.7) & (gaps < 1.9)]
        free = near if len(near) else free
    x, y = free[int(rng.integers(len(free)))]
    yaw_deg = float(rng.integers(-36, 36)) * 5.0
    if facing:
        exact = np.rad2deg(np.arctan2(target[1] - y, target[0] - x))
        yaw_deg = float(np.round((exact + rng.uniform(-20.0, 20.0)) / 5.0) * 5.0)
    share = float(rng.choice((0.0, 0.5, 1.0)))
    return Start(round(float(x), 3), round(float(y), 3), yaw_deg, {name: start_height_m(name, share) for name in ROBOTS})


def start_height_m(robot: str, share: float) -> float:
    """A pelvis height between crouched (share 0) and standing (1), on a grid of 5 cm below standing."""
    spec = load_robot(robot)
    low, high = spec.pelvis_height_range_m
    steps = round((1.0 - share) * (high - low) / _HEIGHT_GRID_M - 1e-6)
    return round(max(low, high - steps * _HEIGHT_GRID_M), 3)


def _in_view(start: Start, position: NDArray[np.float64], draft: Draft, carrier: str) -> bool:
    """Whether an object is in front of the robot at the start and near enough to be made out in a small image."""
    if draft.states.get(carrier, {}).get("isOpen") is False:
        return False
    delta = position - (start.x_m, start.y_m)
    distance = float(np.hypot(*delta))
    bearing = (np.arctan2(delta[1], delta[0]) - np.deg2rad(start.yaw_deg) + np.pi) % (2.0 * np.pi) - np.pi
    return _SEEN_DISTANCE_M[0] <= distance <= _SEEN_DISTANCE_M[1] and abs(float(bearing)) <= _SEEN_BEARING_RAD
