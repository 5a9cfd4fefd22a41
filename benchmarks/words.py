"""How many episodes in words a model completes alone: planning without eyes, body and physics.

    python -m benchmarks.words models=[weights/tiny/words] episodes=300

Episodes are those of the lessons (`proprio_mllm.evaluation.lessons`) with seeds that training does not draw, so this is where
recipes are compared. The teacher's own success stands in the last line. `insist=true` lets a model take steps that are bound to
be refused (`configs.schema.eval`).
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from configs.arguments import command, read_arguments
from interface.steps import PlanStep
from proprio_mllm.evaluation.lessons import WordsOnly
from proprio_mllm.planners.protocol import TaskInfo
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from proprio_mllm.planners.words import WordsPlanner
from proprio_mllm.report.statistics import wilson
from sim.tasks.families import CATEGORIES, family_of

_STEPS = 50


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        models: folders of stored models.
        episodes: how many.
        first: first seed; episode k has the seed -1 - first - k.
        insist: whether steps may be taken that are bound to be refused.
    """

    models: tuple[str, ...] = ("weights/tiny/words",)
    episodes: int = 200
    first: int = 0
    insist: bool = False


def play(planner: WordsPlanner, episodes: Sequence[WordsOnly]) -> list[bool]:
    """Plays episodes side by side; which of them reach their goals."""
    info = TaskInfo("", "", _STEPS)
    states = [planner.begin(info, np.random.default_rng(number)) for number in range(len(episodes))]
    running = list(range(len(episodes)))
    while running := [row for row in running if not episodes[row].world.done() and episodes[row].steps < _STEPS]:
        replies = planner.step_batch([episodes[row].shown() for row in running], [states[row] for row in running])
        for row, reply in zip(list(running), replies, strict=True):
            step: PlanStep = reply.step  # type: ignore[assignment]  # the grammar leaves no other
            if step.actions[0].name == "Done":
                running.remove(row)
            else:
                episodes[row].take(step)
    return [episode.world.done() for episode in episodes]


def taught(episode: WordsOnly) -> bool:
    """Plays an episode with the teacher."""
    teacher = ScriptedPlanner()
    while not episode.world.done() and episode.steps < _STEPS:
        step, job = teacher.decide(episode.shown())
        if job is None:
            break
        episode.take(step)
    return episode.world.done()


def line(name: str, episodes: Sequence[WordsOnly], done: Sequence[bool], seconds: float) -> str:
    """One row: success with its interval, by category, and steps above the time limit's rule."""
    low, high = wilson(sum(done), len(done))
    limits = [math.ceil(1.5 * family_of(one.task.family).steps) + 2 for one in episodes]
    timely = sum(ok and one.steps <= limit for one, ok, limit in zip(episodes, done, limits, strict=True))
    parts = []
    for category in CATEGORIES:
        rows = [ok for one, ok in zip(episodes, done, strict=True) if family_of(one.task.family).category == category]
        parts.append(f"{category} {sum(rows)}/{len(rows)}")
    steps = sum(one.steps for one in episodes)
    share = f"{sum(done) / len(done):.3f} [{low:.3f}, {high:.3f}] of {len(done)}"
    return f"{name}: {share}; in time {timely}; {', '.join(parts)}; {1000 * seconds / steps:.0f} ms a step\n"


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints one line per model."""
    options = read_arguments(Options, arguments)
    torch.set_num_threads(1)
    seeds = [-1 - options.first - number for number in range(options.episodes)]
    for model in options.models:
        planner = WordsPlanner.load(model, insist=options.insist)
        episodes, started = [WordsOnly(seed) for seed in seeds], time.perf_counter()
        done = play(planner, episodes)
        sys.stdout.write(line(model, episodes, done, time.perf_counter() - started))
    episodes, started = [WordsOnly(seed) for seed in seeds], time.perf_counter()
    sys.stdout.write(line("teacher", episodes, [taught(one) for one in episodes], time.perf_counter() - started))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
