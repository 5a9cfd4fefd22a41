"""What a thing's place tells, before a first try, of whether an arm would get there: the most that seeing could bring.

    python -m benchmarks.foresight lessons=150
    python -m benchmarks.foresight lessons=0 tasks=2 robot=h1

Lessons are played (`sim.collection.demonstrations`). Of every step of an arm at an object that the rules would take, the
simulator's reach test says whether it would be in reach, too far, or refused because the body is too high or too low. What is
known is robot and verb, and the object's true centre in the pelvis heading frame, mirrored for the right arm, or that centre
with errors of some centimetres along each axis, as a point map makes them. The answer is the commonest among the nearest tries
of other lessons with the same robot and verb; the share that is right is printed beside that of the commonest answer. Refusals
for other reasons are left out.

With `tasks`, the rules play tasks of the benchmark as they are, and once more with the reach test before every try: what a
planner could gain that foresaw reach without an error.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from configs.arguments import command, read_arguments
from configs.schema.collect import CollectConfig
from interface.bodies import Arm
from interface.failures import FailureCode
from interface.observation import HistoryItem, Observation
from interface.steps import Action, PlanStep
from proprio_mllm.evaluation.dagger import Rules
from proprio_mllm.evaluation.seeds import episode_seed
from sim.collection.demonstrations import Foresight, run_lesson
from sim.collection.view_sampling import center_in_pelvis
from sim.session.session import Session
from sim.tasks.task import CATEGORIES, STEP_LIMIT, Task, load_benchmark

_REACH: Final = ("", FailureCode.TOO_FAR, FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW)
_NEAREST: Final = 9
_ERRORS_M: Final = (0.0, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        lessons: how many are played, of both robots in turn; 0 leaves out what places tell.
        seed: of the lessons.
        tasks: one in so many tasks of the benchmark is played; 0 plays none.
        robot: who plays them.
    """

    lessons: int = 150
    seed: int = 21
    tasks: int = 0
    robot: str = "h1"


@dataclass(frozen=True, slots=True)
class Try:
    """A step of an arm at an object that would be taken.

    Attributes:
        lesson: its number.
        kind: robot and verb.
        centre: (3,) of the object, pelvis heading frame, left and right exchanged for the right arm, metres.
        code: of the reach test, empty where it would be in reach.
    """

    lesson: int
    kind: tuple[str, str]
    centre: NDArray[np.float64]
    code: str


class _Watched:
    """The rules, and what the reach test says of the steps that they would take."""

    def __init__(self, lesson: int, sessions: dict[tuple[str, str], Session], found: list[Try]) -> None:
        self._rules, self._lesson, self._sessions, self._found = Rules(), lesson, sessions, found

    def __call__(self, observation: Observation) -> tuple[PlanStep, Action | None] | None:
        answer = self._rules(observation)
        for action in answer[0].actions if answer is not None else ():
            if action.spec.arms and action.object_id is not None:
                self._assess(observation, action)
        return answer

    def after(self, observation: Observation, refused: HistoryItem) -> PlanStep | None:
        return self._rules.after(observation, refused)

    def _assess(self, observation: Observation, action: Action) -> None:
        playing = (one for one in self._sessions.values() if not one.finished)
        session = next(one for one in playing if one.task.instruction == observation.instruction)
        refusal = session.assess(action)
        code = "" if refusal is None else refusal.code
        if code not in _REACH:
            return
        mirrored = center_in_pelvis(session.world, str(action.object_id)) * (1.0, -1.0 if action.arm is Arm.RIGHT else 1.0, 1.0)
        self._found.append(Try(self._lesson, (observation.robot, action.name), mirrored, str(code)))


def tries_of(options: Options) -> list[Try]:
    """Tries of all lessons, in order."""
    config = CollectConfig("demos", "", options.lessons, seed=options.seed, image_size=28, foreseen=True)
    sessions: dict[tuple[str, str], Session] = {}
    found: list[Try] = []
    for lesson in tqdm(range(options.lessons), desc="lessons"):
        run_lesson(config, lesson, sessions, _Watched(lesson, sessions, found))
    return found


def right(tries: Sequence[Try], error_m: float | None, seed: int = 0) -> NDArray[np.bool_]:
    """Which tries are foretold by others (N,).

    Args:
        tries: of all lessons.
        error_m: standard deviation of the error along each axis of the centres that are known; None where they are not.
        seed: of the errors.
    """
    noise = np.random.default_rng(seed).normal(size=(len(tries), 3)) * (error_m or 0.0)
    known = np.array([one.centre for one in tries]) + noise
    lessons, codes = np.array([one.lesson for one in tries]), [one.code for one in tries]
    kinds = [one.kind for one in tries]
    found = np.zeros(len(tries), dtype=bool)
    for index, one in enumerate(tries):
        others = np.array([k for k, kind in enumerate(kinds) if kind == one.kind and lessons[k] != one.lesson], dtype=np.int64)
        if error_m is not None:
            others = others[np.argsort(np.linalg.norm(known[others] - known[index], axis=1), kind="stable")[:_NEAREST]]
        answers = Counter(codes[k] for k in others).most_common(1)
        found[index] = bool(answers) and answers[0][0] == one.code
    return found


def played(tasks: Sequence[Task], robot: str, foresees: bool) -> list[tuple[bool, bool]]:
    """Which tasks the rules solve within the paper's steps, and in time, with or without the reach test."""
    session, results = Session(robot, "easy", 28), list[tuple[bool, bool]]()
    for task in tqdm(tasks, desc="with the reach test" if foresees else "rules"):
        observation = session.reset(task, episode_seed(0, task.id, robot, 0))
        session.step_limit, rules = STEP_LIMIT, Rules()
        foresight = Foresight(rules)
        while not session.finished and (answer := rules(observation)) is not None:
            step = foresight.better(session, observation, answer[0]) if foresees else answer[0]
            observation, _ = session.step(step)
            foresight.taken(step)
        results.append((session.succeeded, session.succeeded and session.stats.charged <= task.time_limit))
    return results


def _print_bound(options: Options) -> None:
    tasks = load_benchmark()[:: options.tasks]
    sys.stdout.write(f"{options.robot}, {len(tasks)} tasks: solved, in time\n")
    for foresees in (False, True):
        results = np.array(played(tasks, options.robot, foresees))
        by_category = [results[[task.category == name for task in tasks]].sum(axis=0) for name in CATEGORIES]
        parts = ", ".join(f"{name} {solved} {timely}" for name, (solved, timely) in zip(CATEGORIES, by_category, strict=True))
        solved, timely = results.sum(axis=0)
        sys.stdout.write(f"{'with the reach test' if foresees else 'rules':20} {solved:4} {timely:4}  ({parts})\n")


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints the tables."""
    options = read_arguments(Options, arguments)
    if options.tasks:
        _print_bound(options)
    if options.lessons:
        _print_places(options)
    return 0


def _print_places(options: Options) -> None:
    tries = tries_of(options)
    columns = {"words": right(tries, None), **{f"{100 * error:.0f} cm": right(tries, error) for error in _ERRORS_M}}
    verbs = Counter(one.kind[1] for one in tries)
    sys.stdout.write(f"{'':12} {'tries':>6} {'in reach':>9} " + " ".join(f"{name:>7}" for name in columns) + "\n")
    for verb in ("all", *(verb for verb, count in verbs.most_common() if count >= len(tries) / 20)):
        these = np.array([verb in ("all", one.kind[1]) for one in tries])
        reached = np.mean([not one.code for one, chosen in zip(tries, these, strict=True) if chosen])
        shares = " ".join(f"{100 * float(values[these].mean()):7.1f}" for values in columns.values())
        sys.stdout.write(f"{verb:12} {int(these.sum()):6} {100 * reached:9.1f} {shares}\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
