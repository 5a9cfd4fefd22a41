"""Planning in words: rows of household episodes without geometry, physics or pictures.

What to do next follows mostly from the instruction, the log and the names. A pretrained language model reads that; a small one
trained on a few thousand simulated steps does not learn what each refusal asks for. Tasks are drawn from all families of
`sim.tasks.families` in rooms of which half are made up, `sim.collection.text_world` carries the steps out, the expert's own job
planner names the next one, and part of the steps that are taken are mistakes, so that every refusal is followed by what mends
it. Steps that only eyes could justify (a turn towards something unseen, a change of height that nothing has called for yet) are
taken, not recorded.

Rows of `text_planning` shards, and of `goal_questions` shards, which ask whether an instruction has been carried out at a
moment of such an episode. For training without pictures; no result is ever measured here. The paper starts from a pretrained
language model instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from configs.schema.collect import CollectConfig
from data.interface.failures import INVALID_OUTPUT
from data.interface.observation import HistoryItem
from data.interface.steps import PlanStep
from sim.collection.demonstrations import accepted, draw_family
from sim.collection.text_world import TextWorld, feedback_text
from sim.robots.spec import load_robot
from sim.tasks.drafts import Draft, NoDraft, Scene
from sim.tasks.families import draw, family_of
from sim.tasks.sample import rng_for, scene_of

__all__ = [
    "TextEpisode",
    "dagger_of_part",
    "draw_task",
    "goal_question",
    "goal_questions_of_part",
    "play",
    "text_planning_of_part",
]

#: Earlier steps that a row keeps, and steps after which an episode ends.
_HISTORY: Final = 8
_MAX_STEPS: Final = 24
#: Shares of steps that are mistakes, one drawn per episode.
_MISTAKES: Final = (0.1, 0.3, 0.5)
#: Furniture of made-up rooms.
_SURFACES: Final = ("CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser", "Shelf")
_ROOMY: Final = ("CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser")
_CONTAINERS: Final = ("Fridge", "Cabinet", "Drawer", "Microwave")
_SWITCHES: Final = ("Faucet", "StoveKnob", "Microwave", "FloorLamp", "Television", "LightSwitch")
_EXTRAS: Final = ("Sofa", "GarbageCan", "Chair", "TVStand", "Toilet")
#: What a learned planner does at each of several moments (rows without their target); None where it names no step.
Student = Callable[[Sequence[Mapping[str, Any]]], Sequence[PlanStep | None]]


@dataclass(slots=True)
class TextEpisode:
    """One episode.

    Attributes:
        family: the task's family.
        rows: recorded steps, ready for a shard.
        moments: what the robot knows before every step and at the end, as columns of a row without the target.
        success: whether the goals held at the end.
        codes: every outcome code that occurred.
    """

    family: str = ""
    rows: list[dict[str, Any]] = field(default_factory=list)
    moments: list[dict[str, Any]] = field(default_factory=list)
    success: bool = False
    codes: set[str] = field(default_factory=set)


def text_planning_of_part(config: CollectConfig, part: int) -> Iterator[dict[str, Any]]:
    """Rows of one part of an `text_planning` folder; the same for the same configuration, whoever computes it."""
    for index in config.indices(part):
        yield from play(config, index).rows


def play(config: CollectConfig, index: int) -> TextEpisode:
    """Plays one episode with the expert's steps and drawn mistakes.

    Args:
        config: the collection.
        index: number of the episode; names every draw.
    """
    episode = _Episode(config, index, "text_planning")
    while (target := episode.ask()) is not None:
        episode.take(episode.world.mistake(target) if episode.rng.random() < episode.mistakes else target)
    return episode.close()


def dagger_of_part(config: CollectConfig, part: int, student: Student) -> Iterator[dict[str, Any]]:
    """Rows of one part of an `text_planning` folder whose steps a student chose and the expert corrected.

    Args:
        config: the collection; `noise` is the share of steps that the expert takes itself, besides those in which the student
            has no step, ends the task, or does again what has just been refused.
        part: number of the part, whose episodes go side by side.
        student: the learned planner.
    """

    def chosen(episode: _Episode, target: PlanStep, proposed: PlanStep | None) -> PlanStep:
        own = episode.rng.random() >= config.noise
        return (accepted(proposed, episode.last) if own else None) or target

    episodes = [_Episode(config, index, "dagger in text") for index in config.indices(part)]
    for episode in _side_by_side(episodes, student, chosen):
        yield from episode.rows


def _side_by_side(
    episodes: Sequence[_Episode],
    student: Student,
    choose: Callable[[_Episode, PlanStep, PlanStep | None], PlanStep | None],
) -> list[TextEpisode]:
    """Plays episodes to their ends, the student answering for all that still run at once."""
    running = list(episodes)
    while asked := [(episode, target) for episode in running if (target := episode.ask()) is not None]:
        proposals = student([episode.record.moments[-1] for episode, _ in asked])
        for (episode, target), proposed in zip(asked, proposals, strict=True):
            episode.take(choose(episode, target, proposed))
        running = [episode for episode, _ in asked]
    return [episode.close() for episode in episodes]


class _Episode:
    """An episode under way.

    Attributes:
        rng: every draw of the episode, the world's too.
        world: the facts.
        mistakes: share of steps that are mistakes.
        record: what has been recorded.
    """

    def __init__(self, config: CollectConfig, index: int, name: str) -> None:
        self.rng = rng_for(name, config.seed, index)
        draft, scene = draw_task(config.rooms, self.rng)
        robot = config.robots[index % len(config.robots)]
        self.world = TextWorld(draft, scene, load_robot(robot), self.rng)
        hidden = [obj for obj in draft.objects if obj not in self.world.seen]
        instruction = draft.sentences(scene.furniture, self.rng, hidden)[0]
        self._budget = int(np.ceil(1.5 * family_of(draft.family).steps)) + 2 + int(self.rng.choice((0, 0, 5, 10)))
        self._steps = min(self._budget, _MAX_STEPS)
        self.mistakes = float(self.rng.choice(_MISTAKES))
        self.record = TextEpisode(draft.family)
        self._history: list[dict[str, str]] = []
        self._task = {
            "instruction": instruction,
            "robot": robot,
            "category": family_of(draft.family).category,
            "time_limit": self._budget,
            "named": list(draft.focus.values()),
        }

    def ask(self) -> PlanStep | None:
        """Records the moment; the expert's step there, None when the episode is over."""
        number = len(self._history)
        self.record.moments.append(
            {
                **self._task,
                "step": number,
                "visible": list(self.world.visible),
                "known": self.world.known(),
                "history": self._history[-_HISTORY:],
            }
        )
        answer = self.world.answer() if number < self._steps else None
        if answer is None:
            return None
        target, justified = answer
        if justified:
            self.record.rows.append({**self.record.moments[-1], "target": target.to_text()})
        return target

    @property
    def last(self) -> HistoryItem | None:
        """The newest entry of the log."""
        return HistoryItem(**self._history[-1]) if self._history else None

    def take(self, step: PlanStep | None) -> None:
        """Carries a step out; None is a reply that names none."""
        if step is None:
            self._history.append({"step": "", "feedback": INVALID_OUTPUT})
            return
        outcomes = self.world.take(step)
        self.record.codes |= {str(code) for _, code in outcomes}
        self._history.append({"step": step.to_text(), "feedback": feedback_text(outcomes)})

    def close(self) -> TextEpisode:
        """The record, with whether the goals hold."""
        self.record.success = self.world.answer() is None
        return self.record


def goal_questions_of_part(config: CollectConfig, part: int) -> Iterator[dict[str, Any]]:
    """Rows of one part of a `goal_questions` folder: one question of each episode."""
    for index in config.indices(part):
        yield goal_question(config, index)


def goal_question(config: CollectConfig, index: int) -> dict[str, Any]:
    """Whether the instruction has been carried out: half of the answers are yes.

    A no is about the moment before the last step, an earlier one, the end of an episode that failed, or the end of one that did
    something else.
    """
    rng = rng_for("goal_questions", config.seed, index)
    episode = play(config, index)
    end = episode.moments[-1]
    if not episode.success:
        return {**end, "target": "no"}
    if rng.random() < 0.5:
        return {**end, "target": "yes"}
    if rng.random() < 0.2:
        other, scene = draw_task(config.rooms, rng)
        instruction = other.sentences(scene.furniture, rng)[0]
        target = "no" if instruction != end["instruction"] else "yes"
        return {**end, "instruction": instruction, "named": list(other.focus.values()), "target": target}
    earlier = episode.moments[:-1]
    if not earlier:
        return {**end, "target": "yes"}
    before = earlier[-1] if rng.random() < 0.5 else earlier[int(rng.integers(len(earlier)))]
    return {**before, "target": "no"}


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
