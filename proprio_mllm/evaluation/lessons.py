"""Lessons: whole episodes in words with a teacher's answer at every step, right or wrong steps taken.

The teacher is the scripted planner: what it answers is a function of what it is shown, in the text world as in the simulator,
so a model that sees the same can learn it. Part of the steps that are taken are mistakes; the teacher's answer to what
follows from them is what is learnt. Episodes are made in the text world, or read from logs of the simulator, which are told
in the same words. In half of the episodes some object types bear made-up names, in the instruction and in their ids, so that
things are named by reading and not by heart. Half of the episodes reflect on every failure, the others on none. In some the
log tells failures as one bit, to teacher and learner alike. A fourth walk to what no arm has tried is not learnt, since
planners do not say it (`Belief.walked_enough`).

This is the bridge that `train.py` wires: training asks for the episode of a seed and knows neither worlds nor planners.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from configs.schema.collect import TRAIN_ROOMS
from data.shards import ShardReader
from interface.actions import ACTIONS
from interface.bodies import PAPER_ROBOTS
from interface.failures import FAILURES
from interface.observation import HistoryItem
from interface.sightings import Shown, Sightings
from interface.steps import Action, PlanStep
from proprio_mllm.evaluation.showing import as_bit
from proprio_mllm.model.wording import (
    ID_NUMBERS,
    MARKERS,
    PLACE_SCALES,
    WordEpisode,
    WordTurn,
    answer_words,
    id_words,
    log_words,
    number_words,
    prefix_words,
    reflection_words,
    state_words,
    text_words,
)
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from proprio_mllm.training.sources import held_out
from robots.spec import load_robot
from sim.collection.demonstrations import MISTAKES
from sim.collection.text_tasks import draw_task
from sim.collection.text_world import TextWorld, feedback_text
from sim.scene.catalogue import load_catalogue
from sim.tasks.instructions import ORDINALS, TEMPLATES, natural_name, plural
from sim.tasks.sample import rng_for

_MAX_STEPS: Final = 40
#: How often an instruction says where a thing is that is in view; the simulator's do, where a robot sees more than was thought.
_TOLD_IN_VIEW: Final = 0.3
_RENAMED: Final = 0.5
#: Share of episodes that reflect, and of those in which a log has `Failed` in place of every failure code.
_REFLECTING: Final = 0.5
_AS_BIT: Final = 0.1
#: Share of episodes whose log lacks its first steps, as that of a long one does (`proprio_mllm.model.observing`).
_LATE: Final = 0.1
_MOST_RENAMED: Final = 5
_SYLLABLES: Final = ("ba", "do", "fi", "gu", "ka", "lo", "mi", "nu", "pe", "ra", "so", "tu", "va", "wo", "xi", "zu")
#: Numbers of instructions; counts of things.
_COUNTS: Final = ("two", "three", "four")


class WordsOnly:
    """An episode of the text world under way.

    Args:
        seed: names every draw; negative ones are never trained on.
        rooms: rooms that half of the episodes are in; the others are in made-up ones.
        robots: robots, one drawn.

    Attributes:
        task: the draft.
        world: what is so.
        rng: draws of the world, and of whoever plays it.
        robot: the robot.
    """

    def __init__(self, seed: int, rooms: Sequence[str] = TRAIN_ROOMS, robots: Sequence[str] = PAPER_ROBOTS) -> None:
        self.rng = rng_for("lesson in words", seed)
        self.task, self.scene = draw_task(rooms, self.rng)
        self.robot = str(self.rng.choice(robots))
        self.world = TextWorld(self.task, self.scene, load_robot(self.robot), self.rng)
        told = rng_for("where it is", seed)
        hidden = [name for name in self.task.objects if name not in self.world.seen or told.random() < _TOLD_IN_VIEW]
        self._instruction = self.task.sentences(self.scene.furniture, self.rng, hidden)[0]
        order = self.rng.permutation(len(self.scene.furniture))
        self._furniture = tuple(self.scene.furniture[int(index)] for index in order)
        self._history: list[HistoryItem] = []

    @property
    def steps(self) -> int:
        """Steps that were taken."""
        return len(self._history)

    def shown(self) -> Shown:
        """What a planner sees."""
        known = (*self._furniture, *(name for name in self.world.facts.objs if name in self.world.seen))
        return Shown(self._instruction, self.robot, tuple(self.world.visible), known, tuple(self._history))

    def take(self, step: PlanStep) -> None:
        """Carries a step out."""
        self._history.append(HistoryItem(step.to_text(), feedback_text(self.world.take(step))))


class Lessons:
    """The source of episodes that `train.py` hands to training.

    Args:
        robots: robots that act in them.
    """

    def __init__(self, robots: Sequence[str] = PAPER_ROBOTS) -> None:
        self._robots = tuple(robots)

    def words(self) -> tuple[str, ...]:
        """Every word but made-up names: markers, the grammar of actions, all types of the catalogue, all wordings of tasks."""
        types = list(load_catalogue().types)
        names = [word for name in types for word in (*id_words(f"{name}_1")[:-1], *text_words(natural_name(name)))]
        spoken = [
            word for sentences in TEMPLATES.values() for text in sentences for word in text_words(re.sub(r"\{\w+\}", " ", text))
        ]
        other = [*ORDINALS, *_COUNTS, "a", "an", "the", "in", "on", "from", "off"]
        codes = [str(code) for code in FAILURES]
        numbers = (*number_words(), *itertools.chain.from_iterable(PLACE_SCALES))
        words = (*MARKERS, *self._robots, *ACTIONS, *codes, *ID_NUMBERS, *numbers, *names, *spoken, *other)
        return tuple(dict.fromkeys(words))

    def episode(self, seed: int) -> WordEpisode:
        """The episode of a seed in the text world, with the teacher's answers; some steps that are taken are mistakes."""
        episode = WordsOnly(seed, robots=self._robots)
        rng, world = episode.rng, episode.world
        task = episode.task
        things = dict.fromkeys((*task.objects, *task.objects.values(), *episode.scene.furniture))
        names = _new_names(tuple(things), set(task.objects), rng)
        reflects, bits = (bool(one) for one in rng.random(2) < (_REFLECTING, _AS_BIT))
        teacher, record = ScriptedPlanner(), _Record(names, reflects)
        mistakes = float(rng.choice(MISTAKES))
        while episode.steps < _MAX_STEPS:
            shown = _in_bits(episode.shown()) if bits else episode.shown()
            if world.done():
                record.look(shown, PlanStep((Action("Done"),)), "Done", "")
                break
            step, job = teacher.decide(shown)
            if job is None:  # it gives up
                break
            record.look(shown, step, job.verb, job.target)
            episode.take(world.mistake(step) if rng.random() < mistakes else step)
        return _from_late(record.episode(), rng)

    def logged(self, folder: Path) -> Callable[[int], WordEpisode]:
        """Episodes of the simulator with the teacher's answers, each drawn with a seed; those of negative seeds are held out.

        Args:
            folder: `demos` shards of episodes from their start to their end.

        Raises:
            data.shards.ShardError: when they cannot be read.
        """
        logs = _logs(folder)
        apart = {name for name in logs if held_out(name)} or set(list(logs)[:1])
        train, test = ([log for name, log in logs.items() if (name in apart) is wanted] for wanted in (False, True))

        def episode(seed: int) -> WordEpisode:
            rng, some = rng_for("lesson of a log", seed), test if seed < 0 else train
            looks, done = some[int(rng.integers(len(some)))]
            known = looks[-1].known_objects
            names = _new_names(known, set(known) - set(looks[0].known_objects), rng)
            reflects, bits = (bool(one) for one in rng.random(2) < (_REFLECTING, _AS_BIT))
            return _from_late(_of_log([_in_bits(one) for one in looks] if bits else looks, done, names, reflects), rng)

        return episode

    def told(self, folder: Path) -> tuple[WordEpisode, ...]:
        """All episodes of a folder in order and with their own names; a turn is a row, whose target is its answer's step."""
        reader, targets = ShardReader(folder, "demos"), dict[str, list[PlanStep]]()
        for episode, target in zip(reader.column("episode"), reader.column("target"), strict=True):
            targets.setdefault(episode, []).append(PlanStep.parse(target))
        logs = enumerate(_logs(folder).items())
        return tuple(_of_log(looks, done, {}, number % 2 == 0, targets[name]) for number, (name, (looks, done)) in logs)


def _from_late(episode: WordEpisode, rng: np.random.Generator) -> WordEpisode:
    """Some episodes from a later step on, told as if it were the first; the others as they are."""
    late, share = rng.random(2)
    first = int(share * len(episode.turns)) if late < _LATE else 0
    return replace(episode, turns=episode.turns[first:])


def _in_bits(shown: Shown) -> Shown:
    return replace(shown, history=tuple(map(as_bit, shown.history)))


def _of_log(
    looks: Sequence[Shown], done: bool, names: Mapping[str, str], reflects: bool, targets: Sequence[PlanStep] | None = None
) -> WordEpisode:
    """The episode in which a planner was shown this, and whose goals were met at its end or not, under other names.

    Its steps are `targets`, or what the teacher says to what was shown.
    """
    teacher, record = ScriptedPlanner(), _Record(names, reflects)
    for number, shown in enumerate(looks):
        step, job = teacher.decide(shown)
        if done and number + 1 == len(looks):
            record.look(shown, PlanStep((Action("Done"),)), "Done", "")
        elif job is not None:
            tries = any(action.spec.arms for action in step.actions)
            record.look(shown, step if targets is None else targets[number], job.verb, job.target, tries)
        else:  # it gives up
            break
    return record.episode()


def _logs(folder: Path) -> dict[str, tuple[list[Shown], bool]]:
    """Episodes of the simulator by name: what was shown before every step, and whether the goals were met at the end."""
    reader = ShardReader(folder, "demos")
    columns = [reader.column(name) for name in ("episode", "instruction", "robot", "visible", "known", "history", "target")]
    episodes: dict[str, list[Shown]] = {}
    done: dict[str, bool] = {}
    for episode, instruction, robot, visible, known, history, target in zip(*columns, strict=True):
        items = tuple(HistoryItem(**item) for item in history)
        episodes.setdefault(episode, []).append(Shown(instruction, robot, tuple(visible), tuple(known), items))
        done[episode] = target == "Done()"
    return {name: (looks, done[name]) for name, looks in episodes.items()}


class _Record:
    """Writes an episode down in words, under other names and with reflections where wanted."""

    def __init__(self, names: Mapping[str, str], reflects: bool) -> None:
        self._names, self._reflects = names, reflects
        self._sightings = Sightings()
        self._prefix: tuple[str, ...] = ()
        self._turns: list[WordTurn] = []

    def look(self, shown: Shown, step: PlanStep, verb: str, target: str | None, tries: bool = False) -> None:
        """A moment and the teacher's answer; `tries` as in `WordTurn`."""
        shown = self._renamed(shown)
        self._sightings.look(shown)
        if not self._turns:
            self._prefix = prefix_words(shown)
        else:
            taken = log_words(shown.history[-1:], self._sightings.new)
            self._turns[-1] = replace(self._turns[-1], taken=taken)
        actions = tuple(
            one if one.object_id is None else replace(one, object_id=self._id(one.object_id)) for one in step.actions
        )
        belief, answer = self._sightings.belief, tuple[str, ...]()
        if not any(map(belief.walked_enough, actions)):
            reflection = reflection_words(belief.failed, PlanStep(actions)) if self._reflects else ()
            answer = answer_words(verb, self._id(target) if target else target, PlanStep(actions), reflection)
        self._turns.append(WordTurn(state_words(self._sightings, self._reflects), answer, (), tries))

    def episode(self) -> WordEpisode:
        """What was written."""
        return WordEpisode(self._prefix, tuple(self._turns))

    def _id(self, object_id: str) -> str:
        name, _, number = object_id.rpartition("_")
        return f"{self._names.get(name, name)}_{number}"

    def _renamed(self, shown: Shown) -> Shown:
        if not self._names:
            return shown
        pattern, types = _names_pattern()

        def other(match: re.Match[str]) -> str:
            kind, many = types[match[0].lower()]
            if kind not in self._names:
                return match[0]
            return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", self._names[kind]).lower() + ("s" if many else "")

        history = tuple(HistoryItem(self._ids(item.step), self._ids(item.feedback)) for item in shown.history)
        return Shown(
            pattern.sub(other, shown.instruction),
            shown.robot,
            tuple(map(self._id, shown.visible_objects)),
            tuple(map(self._id, shown.known_objects)),
            history,
        )

    def _ids(self, text: str) -> str:
        return re.sub(r"[A-Za-z0-9]+_\d+", lambda match: self._id(match[0]), text)


@functools.cache
def _names_pattern() -> tuple[re.Pattern[str], dict[str, tuple[str, bool]]]:
    """Finds the names of types in an instruction; the type of each name, and whether it is a plural."""
    types: dict[str, tuple[str, bool]] = {}
    for name in load_catalogue().types:
        types[natural_name(name).lower()] = (name, False)
        types[plural(name, 2).removeprefix("two ").lower()] = (name, True)
    longest = sorted(types, key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(longest)})\b", re.IGNORECASE), types


def _new_names(ids: Sequence[str], often: Set[str], rng: np.random.Generator) -> dict[str, str]:
    """Made-up names of some types of some ids, of one or two words, more often of some; none in half of the episodes."""
    if rng.random() >= _RENAMED:
        return {}
    types = list(dict.fromkeys(name.rsplit("_", 1)[0] for name in ids))
    weights = np.array([3.0 if any(name.startswith(f"{kind}_") for name in often) else 1.0 for kind in types])
    count = min(int(rng.integers(1, _MOST_RENAMED + 1)), len(types))
    chosen = rng.choice(len(types), count, replace=False, p=weights / weights.sum())
    return {types[int(index)]: "".join(_made_up_word(rng) for _ in range(int(rng.integers(1, 3)))) for index in chosen}


def _made_up_word(rng: np.random.Generator) -> str:
    return "".join(str(rng.choice(_SYLLABLES)) for _ in range(3)).capitalize()
