"""Turns drafts into tasks: positions of objects, the robot's start, wording, time limit; samples training tasks without end.

A training task is a function of its seed, its room and nothing else. Benchmark tasks come from the same code with other seeds:
`TRAIN_SEEDS` and `BENCHMARK_SEEDS` do not meet, and every draw is keyed by the seed and the split, so no training task
repeats a benchmark task's stream. Start poses, pelvis heights, objects, distractors and wordings all vary.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from configs.schema.collect import TRAIN_ROOMS
from interface.bodies import PAPER_ROBOTS
from robots.build_solver import robot_kit
from robots.spec import load_robot
from sim.scene.catalogue import ObjectType, load_catalogue
from sim.scene.rooms import Furniture, load_room, room_names
from sim.skills.navigation import NavigationMap, Rectangle
from sim.skills.obstacles import navigation_map
from sim.skills.reach_map import reach_maps
from sim.tasks.drafts import Draft, NoDraft, Scene
from sim.tasks.families import CATEGORIES, FAMILIES, draw, family_of
from sim.tasks.task import Placement, Start, Task
from sim.world.placement import OVERHANG_SHARE, fits_on
from sim.world.world import World, WorldError

ROOMS: Final = room_names()
#: Movable types that occur in no training task.
UNSEEN_TYPES: Final = ("Kettle", "Tomato", "Pan", "WineBottle", "AlarmClock", "Vase", "HandTowel", "PepperShaker")
#: Seeds of the benchmark's draws; training seeds start where they end.
BENCHMARK_SEEDS: Final = range(0, 100_000)
TRAIN_SEEDS: Final = range(100_000, 2**31)

#: Types that tasks have carried with both hands.
BIG_TYPES: Final = ("Box", "HousePlant", "Pot", "Toaster", "Microwave", "CoffeeMachine", "LaundryHamper", "GarbageCan")
#: Those that stand with a short side to the front, because the shorter robot's arms do not get around the long one.
_TURNED: Final = ("Pot", "Toaster")
_SURFACE_TYPES: Final = (
    "CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser", "TVStand", "Shelf", "Bed", "Sofa", "Chair",
)  # fmt: skip
#: What only serves as a place to put things.
_PLACE_TYPES: Final = ("SinkBasin", "BathtubBasin", "GarbageCan", "StoveBurner", "Toilet")
#: A television leaves no room for hands on its stand.
_NO_TARGET_TYPES: Final = ("TVStand",)
#: Targets with room for several things and hands.
_ROOMY_TYPES: Final = (
    "CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser", "Bed", "Sofa", "SinkBasin", "BathtubBasin",
)  # fmt: skip
_CONTAINER_TYPES: Final = ("Fridge", "Cabinet", "Drawer", "Microwave")
_LID_TYPES: Final = ("Toilet",)
_SWITCH_TYPES: Final = (
    "Faucet", "StoveKnob", "Microwave", "FloorLamp", "Television", "LightSwitch", "CoffeeMachine", "Toaster",
)  # fmt: skip
_HEIGHT_GRID_M: Final = 0.05
_START_CLEARANCE_M: Final = 0.05
#: An object farther away than this, or farther off the heading, does not count as seen at the start.
_SEEN_DISTANCE_M: Final = (0.6, 2.0)
_SEEN_BEARING_RAD: Final = np.deg2rad(25.0)
_ATTEMPTS: Final = 60
#: Depth from the edge of a surface within which tasks put objects: the shorter robot's arms do not reach farther.
_EDGE_BAND_M: Final = 0.16
#: Free distance between two objects of a task: a hand fits between.
_HAND_GAP_M: Final = 0.09
_REACH_MARGIN_M: Final = 0.02
#: A surface so near to a switch or handle, and another switch so near, serve the other hand at the same time.
_NEAR_M: Final = 0.45
_PAIR_M: Final = 0.7
#: Least distance between a switch or handle and an object beside it.
_BESIDE_M: Final = 0.2
_SPOTS: Final = 6
_SMALL_RADIUS_M: Final = 0.06


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
    targets = (*(name for name in surfaces if kinds[name].name not in _NO_TARGET_TYPES), *of(_PLACE_TYPES))

    def table(wanted: Callable[[ObjectType], bool], places: Sequence[str]) -> dict[str, tuple[str, ...]]:
        rows: dict[str, tuple[str, ...]] = {}
        for kind in catalogue.types.values():
            fits = tuple(place for place in places if fits_on(kind, kinds[place]))
            if wanted(kind) and layout.category in kind.rooms and fits:
                rows[kind.name] = fits
        return rows

    boxes = {item.id: _footprint(item, kinds[item.id]) for item in layout.furniture}
    active, near = (*containers, *of(_SWITCH_TYPES)), {}
    for name in active:
        here = np.asarray(next(item.xy for item in layout.furniture if item.id == name))
        gaps = {other: float(boxes[other].distance(here[None])[0]) for other in (*surfaces, *active) if other != name}
        near[name] = tuple(other for other, gap in gaps.items() if gap <= (_NEAR_M if other in surfaces else _PAIR_M))
    heaters = {furniture: switch for switch, furniture in layout.links.items() if kinds[furniture].has("heat_source")}
    return Scene(
        room=room,
        furniture=ids,
        surfaces=surfaces,
        targets=targets,
        containers=containers,
        switches=of(_SWITCH_TYPES),
        small=table(lambda kind: kind.pickupable, (*surfaces, *of(_PLACE_TYPES), *containers)),
        big=table(_takes_two_hands, tuple(name for name in targets if name in surfaces)),
        lids=of(_LID_TYPES),
        basins={tap: basin for tap, basin in layout.links.items() if kinds[tap].name == "Faucet"},
        heaters=heaters | {name: name for name in ids if kinds[name].name == "Microwave"},
        near=near,
        roomy=tuple(name for name in targets if kinds[name].name in _ROOMY_TYPES),
    )


def _footprint(item: Furniture, kind: ObjectType) -> Rectangle:
    """Rectangle on the floor below a piece of furniture."""
    return Rectangle(item.xy, (kind.size[0] / 2.0, kind.size[1] / 2.0), float(np.deg2rad(item.yaw_deg)))


def _takes_two_hands(kind: ObjectType) -> bool:
    """Whether tasks have a type carried with both hands: what needs them and can stand on furniture, and pots when full."""
    return kind.name in BIG_TYPES


def sample_task(
    seed: int,
    room: str | None = None,
    family: str | None = None,
    source: str = "train",
    robots: Sequence[str] = PAPER_ROBOTS,
) -> Task:
    """A task drawn from a seed.

    Args:
        seed: one of `TRAIN_SEEDS` or `BENCHMARK_SEEDS`, whichever belongs to the source.
        room: a room; drawn from those of the source when None.
        family: a name of `sim.tasks.families.FAMILIES`; drawn when None (category and room once, the family until it fits).
        source: `train` or `benchmark`. Training tasks keep to `TRAIN_ROOMS` and do without `UNSEEN_TYPES`.
        robots: robots that have to reach everything the task is about.

    Raises:
        ValueError: when the seed belongs to another source, or nothing suitable was drawn.
    """
    seeds = {"train": TRAIN_SEEDS, "benchmark": BENCHMARK_SEEDS}.get(source)
    if seeds is None or seed not in seeds:
        raise ValueError(f"seed {seed} is not a {source} seed; allowed: train {TRAIN_SEEDS}, benchmark {BENCHMARK_SEEDS}")
    without = UNSEEN_TYPES if source == "train" else ()
    fixed = rng_for("task", source, seed)
    wanted = str(fixed.choice(TRAIN_ROOMS if source == "train" else ROOMS))
    category = str(fixed.choice(CATEGORIES))
    families = [name for name, kind in FAMILIES.items() if kind.category == category]
    for attempt in range(_ATTEMPTS):
        rng = rng_for("task", source, seed, attempt)
        another = str(rng.choice(TRAIN_ROOMS if source == "train" else ROOMS))
        where = room or (wanted if attempt < _ATTEMPTS // 2 else another)  # so that rooms and categories stay balanced
        what = family or str(rng.choice(families))
        try:
            draft = draw(what, scene_of(where), rng, without=without)
            return settle(draft, f"{source}_{what}_{seed}", seed, source, rng, robots)
        except (NoDraft, WorldError):
            if room is not None and family is not None and attempt == _ATTEMPTS - 1:
                raise
    raise ValueError(f"no task of family {family!r} in room {room!r} from seed {seed} in {_ATTEMPTS} attempts")


def settle(
    draft: Draft, task_id: str, seed: int, source: str, rng: np.random.Generator, robots: Sequence[str] = PAPER_ROBOTS
) -> Task:
    """Gives a draft positions, a start, words and a time limit.

    Raises:
        WorldError: when the objects do not fit, or one of the robots cannot reach what it has to touch from anywhere.
    """
    scene = scene_of(draft.room)
    empty = _empty_world(draft.room)
    spots = _spots(empty, draft, rng)
    placements = tuple(
        Placement(
            name, name.rsplit("_", 1)[0], carrier, (round(float(spots[name][0]), 3), round(float(spots[name][1]), 3)),
            _yaw_deg(rng, empty, name, carrier), draft.object_states.get(name, {}),
        )
        for name, carrier in draft.objects.items()
    )  # fmt: skip
    world = World(None, draft.room, placements, states=draft.states, seed=seed % 2**31, settle_s=0.05)
    points = {name: _hand_points(world, name, draft, rng) for name in draft.focus.values()}
    for name in robots:
        navigation = navigation_map(world, load_robot(name).footprint_radius_m)
        for object_id, choices in points.items():
            if not any(_in_reach(name, navigation, point) for point in choices):
                where = choices[0].round(2) if choices else "its spots, which are taken,"
                raise WorldError(f"{name} does not reach {object_id} at {where} in {draft.room}")
    positions = {name: world.poses.center(name)[:2] for name in world.objects}
    if source == "train":
        radius = max(load_robot(name).footprint_radius_m for name in robots)
        first = next(iter(draft.objects)) if "a" not in draft.focus else draft.focus["a"]
        start = _draw_start(navigation_map(world, radius + _START_CLEARANCE_M), positions[first], rng)
    else:
        start = room_start(draft.room)
    hidden = [name for name, carrier in draft.objects.items() if not _in_view(start, positions[name], draft, carrier)]
    sentences = draft.sentences(scene.furniture, rng, hidden)
    family = family_of(draft.family)
    return Task(
        id=task_id,
        room=draft.room,
        category=family.category,
        family=draft.family,
        instruction=sentences[0],
        paraphrases=sentences[1:4],
        start=start,
        placements=placements,
        states=draft.states,
        goals=tuple(draft.goals),
        time_limit=int(np.ceil(1.5 * family.steps)) + 2,
        split="train" if source == "train" else _novelty(draft),
        seed=seed,
    )


def _novelty(draft: Draft) -> Literal["seen", "unseen"]:
    """Whether the room, or an object that the task is about, occurs in no training task."""
    named = {name for goal in draft.goals for name in goal.involved(draft.objects)} | set(draft.focus.values())
    kinds = {name.rsplit("_", 1)[0] for name in named}
    return "unseen" if draft.room not in TRAIN_ROOMS or kinds & set(UNSEEN_TYPES) else "seen"


@functools.cache
def room_start(room: str) -> Start:
    """Where every benchmark task of a room starts: fixed within a room, heights vary between rooms."""
    x, y, yaw_deg = load_room(room).start
    share = float(rng_for("start", room).choice((0.0, 0.5, 1.0)))
    return Start(x, y, yaw_deg, {name: start_height_m(name, share) for name in PAPER_ROBOTS})


@functools.cache
def _empty_world(room: str) -> World:
    return World(None, room, (), settle_s=0.005)


def _spots(empty: World, draft: Draft, rng: np.random.Generator) -> dict[str, NDArray[np.float64]]:
    """A place for every object near the reachable edge of its carrier, with room for a hand between neighbours.

    Raises:
        WorldError: when a carrier is too full.
    """
    catalogue = load_catalogue()
    spots: dict[str, NDArray[np.float64]] = {}
    taken: list[tuple[NDArray[np.float64], float, str]] = []
    spots_gap = 0.0
    for name, carrier in draft.objects.items():
        kind = catalogue.get(name.rsplit("_", 1)[0])
        radius, depth = float(np.hypot(kind.size[0], kind.size[1])) / 2.0, min(kind.size[0], kind.size[1])
        narrow = (max(kind.size[0], kind.size[1]) if kind.name in _TURNED else depth) / 2.0
        if kind.name in BIG_TYPES:
            narrow *= OVERHANG_SHARE
        band = narrow + 0.06 if kind.name in BIG_TYPES else max(_EDGE_BAND_M, narrow + 0.05)
        other = draft.beside.get(name)
        anchor = None if other is None else spots[other][:2] if other in spots else empty.poses.pose(other)[:2, 3]
        for _ in range(12):
            spot = empty.containment.free_spot(
                carrier, narrow, height_m=kind.size[2], rng=rng, band_m=band, gap_m=0.04, through_doors=True
            )
            if spot is None or any(
                there == carrier and float(np.linalg.norm(spot[:2] - place)) <= radius + size + _HAND_GAP_M
                for place, size, there in taken
            ):
                continue
            gap = 0.0 if anchor is None else float(np.linalg.norm(spot[:2] - anchor))
            if name not in spots or (anchor is not None and _BESIDE_M + radius < gap < spots_gap):
                spots[name], spots_gap = spot, gap
            if anchor is None:
                break
        if name in spots:
            taken.append((spots[name][:2], radius, carrier))
        if name not in spots:
            raise WorldError(f"no room for {name} on {carrier} in {draft.room}")
    return spots


def _hand_points(world: World, object_id: str, draft: Draft, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Where a hand has to get to for an object of the task: one of these points will do."""
    obj = world.object(object_id)
    goal = next((goal for goal in draft.goals if goal.object_id == object_id), None)
    if obj.movable and not (obj.moving and goal is not None and goal.kind in ("open", "closed")):
        return [world.poses.center(object_id)]
    if goal is not None and goal.kind.startswith("toggled"):
        return [world.poses.toggle_point(object_id)]
    if obj.moving:
        return [world.poses.handle(object_id)]
    spots = [world.containment.free_spot(object_id, _SMALL_RADIUS_M, rng=rng, band_m=_EDGE_BAND_M) for _ in range(_SPOTS)]
    return [spot + (0.0, 0.0, 0.05) for spot in spots if spot is not None]


@functools.cache
def _reach_limit_m(robot: str, level_cm: int) -> float:
    """Farthest horizontal distance from the pelvis at which some arm at some pelvis height reaches a level straight ahead."""
    kit = robot_kit(robot)
    maps = reach_maps(kit)
    low, high = kit.spec.pelvis_height_range_m
    best = 0.0
    for height in np.linspace(low, high, 6):
        pitch = kit.crouches.pitch(float(height))
        c, s = np.cos(pitch), np.sin(pitch)
        upright = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        for distance in np.arange(0.3, 0.9, 0.02):
            if distance > best and maps["right"].contains(upright @ np.array([distance, -0.05, level_cm / 100.0 - height])):
                best = float(distance)
    return best


def _in_reach(robot: str, navigation: NavigationMap, point: NDArray[np.float64]) -> bool:
    """Whether the robot can stand somewhere from where an arm gets to a point."""
    free = navigation.free_positions()
    gap = float(np.linalg.norm(free - point[:2], axis=1).min())
    return gap <= _reach_limit_m(robot, round(float(point[2]) * 20.0) * 5) - _REACH_MARGIN_M


def _yaw_deg(rng: np.random.Generator, empty: World, name: str, carrier: str) -> float:
    """Small objects stand roughly square to the furniture; big ones square to it, within reach."""
    rotation = empty.poses.pose(carrier)[:2, :2]
    along = float(np.rad2deg(np.arctan2(rotation[1, 0], rotation[0, 0])))
    kind = name.rsplit("_", 1)[0]
    if kind in BIG_TYPES:
        return along + (90.0 if kind in _TURNED else 0.0)
    return along + float(rng.choice((0.0, 90.0, 180.0, 270.0))) + float(rng.integers(-3, 4)) * 5.0


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
    return Start(round(float(x), 3), round(float(y), 3), yaw_deg, {name: start_height_m(name, share) for name in PAPER_ROBOTS})


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
