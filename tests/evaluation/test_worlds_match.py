"""The text world refuses as the simulator does: the same teacher meets the same codes about as often in both.

Shares are of the actions of episodes that end in success, over training tasks; what geometry decides is drawn in words.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.validate import build
from interface.episode import Outcome
from interface.symbolic import Event, events_of
from proprio_mllm.evaluation.lessons import WordsOnly
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from sim.tasks.sample import sample_task
from sim.tasks.task import write_tasks

TASKS, EPISODES, FIRST = 40, 300, 400_000_000


def in_simulator(robot: str, folder: Path) -> Iterator[tuple[str, str]]:
    write_tasks([sample_task(FIRST + number) for number in range(TASKS)], folder / "tasks.jsonl")
    overrides = [
        f"robot={robot}",
        "planner=scripted",
        "planner.image_size=0",
        f"tasks={folder}/tasks.jsonl",
        f"output={folder}",
    ]
    result = evaluate(build(EvalConfig, compose("eval", [*overrides, "workers=2"])))
    for record in result.records:
        if record.outcome is Outcome.SUCCESS:
            for step in record.trace:
                for outcome in step["outcomes"]:
                    yield str(outcome["action"]).split("(")[0], str(outcome["code"]) or "ok"


def in_words(robot: str) -> Iterator[tuple[str, str]]:
    for seed in range(EPISODES):
        episode, teacher = WordsOnly(seed, robots=(robot,)), ScriptedPlanner()
        while not episode.world.done() and episode.steps < 50:
            episode.take(teacher.decide(episode.shown())[0])
        events: list[Event] = [event for step in events_of(episode.shown().history) for event in step]
        yield from ((event.action.name, str(event.code)) for event in events)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_codes_are_met_as_often(robot: str, tmp_path: Path) -> None:
    simulated, told = Counter(in_simulator(robot, tmp_path)), Counter(in_words(robot))

    def share(found: Counter, codes: tuple[str, ...], verbs: tuple[str, ...]) -> float:
        total = sum(count for (verb, _), count in found.items() if verb in verbs)
        return sum(count for (verb, code), count in found.items() if verb in verbs and code in codes) / total

    reaching = ("Pick", "Place", "Open", "Close", "ToggleOn", "ToggleOff", "UseUp", "Hold")
    for codes, verbs, tolerance in (
        (("ok",), ("GoTo",), 0.08),
        (("TooFar",), reaching, 0.15),
        (("BodyTooHigh", "BodyTooLow"), reaching, 0.12),
        (("Obstructed", "GraspMissed", "HandleSlipped", "ReceptacleFull", "PlaceMissed"), reaching, 0.12),
        (("ok",), reaching, 0.15),
    ):
        ours, theirs = share(told, codes, verbs), share(simulated, codes, verbs)
        assert abs(ours - theirs) <= tolerance, (
            f"{robot}: {codes} of {verbs}: {ours:.2f} in words, {theirs:.2f} in the simulator"
        )
