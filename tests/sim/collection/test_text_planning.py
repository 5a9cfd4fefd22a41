"""Exercises in words: the same for the same number, solvable, and every refusal met with what mends it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from configs.schema.collect import CollectConfig
from data.interface.actions import ACTIONS
from data.interface.steps import Action, PlanStep
from sim.collection.collect import rows_of_part
from sim.collection.text_planning import TextEpisode, dagger_of_part, play
from sim.collection.text_world import TextWorld
from sim.robots.spec import load_robot
from sim.scene.catalogue import load_catalogue
from sim.tasks.families import FAMILIES, draw
from sim.tasks.sample import scene_of

#: Types that a hand picks up.
SMALL = {kind.name for kind in load_catalogue().types.values() if kind.pickupable}
CONFIG = CollectConfig("text_planning", "unused", 300, part_size=300)


@pytest.fixture(scope="module")
def episodes() -> list[TextEpisode]:
    return [play(CONFIG, index) for index in range(300)]


def test_an_episode_is_a_function_of_its_number(episodes: list[TextEpisode]) -> None:
    assert play(CONFIG, 7).rows == episodes[7].rows
    assert rows_of_part(CONFIG, 0) == [row for episode in episodes for row in episode.rows]
    assert episodes[7].rows != episodes[8].rows


def test_most_episodes_end_in_success_in_spite_of_mistakes(episodes: list[TextEpisode]) -> None:
    assert sum(episode.success for episode in episodes) > 235
    codes = set().union(*(episode.codes for episode in episodes))
    wanted = {"ok", "TooFar", "BodyTooHigh", "BodyTooLow", "HandEmpty", "HandOccupied", "AlreadyHeld", "AlreadyInState"}
    assert wanted | {"ObjectNotKnown", "BothHandsBusy", "GraspMissed"} <= codes


def test_every_family_and_every_action_occurs(episodes: list[TextEpisode]) -> None:
    more = [*episodes, *(play(CONFIG, 1000 + index) for index in range(700))]
    history = (item for episode in more for moment in episode.moments for item in moment["history"][-1:] if item["step"])
    steps = [action.name for item in history for action in PlanStep.parse(item["step"]).actions]
    assert set(steps) == set(ACTIONS) - {"Done"}
    assert {episode.family for episode in more} == set(FAMILIES)
    for family in FAMILIES:
        some = [episode.success for episode in more if episode.family == family]
        assert sum(some) > 0.5 * len(some), family


def test_codes_are_those_of_the_table(episodes: list[TextEpisode]) -> None:
    for item in (item for episode in episodes for item in episode.moments[-1]["history"]):
        for text, _, code in (outcome.rpartition(" ") for outcome in item["feedback"].split("; ")):
            assert code == "ok" or code in Action.parse(text).spec.codes, item


def test_steps_name_known_objects_and_follow_from_the_log(episodes: list[TextEpisode]) -> None:
    heights = 0
    for row in (row for episode in episodes for row in episode.rows):
        step = PlanStep.parse(row["target"])
        assert step.to_text() == row["target"]
        assert {action.object_id for action in step.actions} - {None} <= set(row["known"])
        assert set(row["visible"]) <= set(row["known"])
        codes = [item["feedback"].rsplit(" ", 1)[1] for item in row["history"]]
        if step.actions[0].name in ("MoveUp", "MoveDown"):
            heights += 1
            refused = "BodyTooLow" if step.actions[0].name == "MoveUp" else "BodyTooHigh"
            assert refused in codes
        assert not re.match("Rotate|MoveAhead", row["target"])
        if codes and codes[-1] == "TooFar" and len(step.actions) == 1:
            last = row["history"][-1]["step"]
            assert last != row["target"]
    assert heights > 20


def test_judgements_are_balanced_and_true(episodes: list[TextEpisode]) -> None:
    rows = rows_of_part(dataclasses.replace(CONFIG, kind="goal_questions"), 0)
    assert len(rows) == 300
    assert 0.35 < sum(row["target"] == "yes" for row in rows) / len(rows) < 0.6
    for episode, row in zip(episodes, rows, strict=True):
        ends = episode.moments[-1]
        if row["target"] == "yes":
            assert episode.success
            assert row["instruction"] == ends["instruction"]
            assert row["history"] == ends["history"]
        else:
            assert not episode.success or row["step"] < ends["step"] or row["instruction"] != ends["instruction"]


def test_what_is_held_already_is_not_picked_again(episodes: list[TextEpisode]) -> None:
    for row in (row for episode in episodes for row in episode.rows):
        if row["history"] and row["history"][-1]["feedback"].endswith("AlreadyHeld"):
            asked = re.findall(r"Pick\(\w+, (\w+)\)", row["history"][-1]["step"])
            assert not any(f", {name})" in row["target"] and row["target"].startswith("Pick") for name in asked)


def test_what_a_student_picks_up_for_nothing_is_put_back() -> None:
    def student(moments: Sequence[Mapping[str, Any]]) -> list[PlanStep | None]:
        steps: list[PlanStep | None] = []
        for moment in moments:
            spare = [name for name in moment["known"] if name not in moment["named"] and name.rsplit("_", 1)[0] in SMALL]
            verbs = ("GoTo({})", "Pick(left, {})", "Pick(right, {})")
            steps.append(PlanStep.parse(verbs[moment["step"] % 3].format(spare[0])) if spare else None)
        return steps

    config = dataclasses.replace(CONFIG, count=60, part_size=60, noise=0.0)
    rows = list(dagger_of_part(config, 0, student))
    back = 0
    for row in rows:
        last = row["history"][-1]["feedback"] if row["history"] else ""
        picked = re.match(r"Pick\(\w+, (\w+)\) ok", last)
        back += picked is not None and picked[1] not in row["named"] and row["target"].startswith(("Place", "GoTo"))
    assert back > 5


@pytest.mark.parametrize(("robot", "low", "high"), [("h1", 0.0, 0.2), ("x1", 0.3, 0.7)])
def test_a_door_with_a_spring_may_stay_ajar(robot: str, low: float, high: float) -> None:
    found: list[bool] = []
    for seed in range(150):
        rng, scene = np.random.default_rng(seed), scene_of("kitchen_1")
        world = TextWorld(draw("fetch_ajar", scene, rng), scene, load_robot(robot), rng)
        (door,) = world.facts.state.self_closing
        taken = [world.take(PlanStep.parse(text)) for text in (f"GoTo({door})", f"Open(left, {door})", "Release(left)")]
        if taken[1][0][1] == "ok":
            assert taken[2][0][1] == "ok"
            found.append(world.facts.object(door).opened)
    assert len(found) > 30 and low <= np.mean(found) <= high
