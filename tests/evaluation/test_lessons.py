"""Lessons: the teacher reaches the goals in words, names of things are copied and not remembered, nothing private is told."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from configs.schema.collect import CollectConfig
from data.shards import ShardReader
from interface.failures import FailureCode
from interface.observation import HistoryItem
from interface.sightings import Shown
from interface.steps import PlanStep
from proprio_mllm.evaluation import lessons
from proprio_mllm.evaluation.dagger import collect_lessons
from proprio_mllm.evaluation.lessons import Lessons, WordsOnly
from proprio_mllm.model.word_tokens import WordTokens, add_word_tokens
from proprio_mllm.model.wording import answer_words, id_words, text_words
from proprio_mllm.planners.scripted.instruction import read_goals
from proprio_mllm.planners.scripted.words import type_of
from proprio_mllm.training.sources import held_out
from sim.collection.text_world import TextWorld
from sim.scene.compiler import PHYSICS
from sim.tasks.families import FAMILIES
from sim.tasks.sample import UNSEEN_TYPES

SEEDS = range(80)


@pytest.fixture(scope="module")
def episodes() -> list:
    return [Lessons().episode(seed) for seed in SEEDS]


def test_episodes_end_in_success(episodes: list) -> None:
    done = [episode.turns[-1].answer[:1] == ("Done",) for episode in episodes]
    assert np.mean(done) > 0.7  # at `hard` 40 steps are few


def test_an_episode_is_a_function_of_its_seed(episodes: list) -> None:
    assert Lessons().episode(5) == episodes[5]
    assert episodes[5] != episodes[6]


def test_some_episodes_are_told_from_a_later_step_on(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = {}
    for share in (0.0, 1.0):
        monkeypatch.setattr(lessons, "_LATE", share)
        whole[share] = [Lessons().episode(seed) for seed in range(20)]
    for first, late in zip(whole[0.0], whole[1.0], strict=True):
        assert late.prefix == first.prefix and late.turns == first.turns[len(first.turns) - len(late.turns) :]
    dropped = [len(first.turns) - len(late.turns) for first, late in zip(whole[0.0], whole[1.0], strict=True)]
    assert min(dropped) >= 0 and len(set(dropped)) > 5


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of the simulator."""
    folder = tmp_path_factory.mktemp("lessons")
    collect_lessons(CollectConfig("demos", str(folder), 4, robots=("h1",), image_size=28, part_size=2))
    return folder


def test_the_teacher_answers_logs_as_it_did_in_the_simulator(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lessons, "_RENAMED", 0.0)
    monkeypatch.setattr(lessons, "_AS_BIT", 0.0)
    monkeypatch.setattr(lessons, "_LATE", 0.0)
    episode, reader = Lessons().logged(logs), ShardReader(logs, "demos")
    targets: dict[str, list[str]] = {}
    for name, target in zip(reader.column("episode"), reader.column("target"), strict=True):
        targets.setdefault(name, []).append(target)
    told = [[_step(turn.answer) for turn in episode(seed).turns] for seed in (*range(12), *range(-12, 0))]
    wanted = [[answer_words("", "", PlanStep.parse(target))[2:] for target in one] for one in targets.values()]
    assert len({str(one) for one in told}) == len(wanted) == 4
    assert all(one in wanted for one in told)
    assert any(one[-1] == ("Done", ".") for one in told)


def test_some_logs_are_held_out(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lessons, "_RENAMED", 0.0)
    episode, reader = Lessons().logged(logs), ShardReader(logs, "demos")
    mine, others = ({episode(seed).prefix[1:4] for seed in seeds} for seeds in (range(40), range(-40, 0)))
    assert episode(3) == episode(3)
    assert others
    assert not mine & others
    said = dict(zip(reader.column("episode"), reader.column("instruction"), strict=True))
    apart = [name for name in said if held_out(name)] or list(said)[:1]
    assert others == {text_words(said[name])[:3] for name in apart}


@pytest.mark.parametrize("ahead", [False, True])
def test_what_was_foreseen_is_the_answer_with_a_picture_and_never_in_words_alone(
    ahead: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lessons, "_RENAMED", 0.0)
    monkeypatch.setattr(lessons, "_AS_BIT", 0.0)
    monkeypatch.setattr(lessons, "_LATE", 0.0)
    collect_lessons(CollectConfig("demos", str(tmp_path), 2, seed=3, image_size=28, part_size=10, foreseen=ahead))
    reader = ShardReader(tmp_path, "demos")
    taught = [json.loads(text)["taught"] for text in reader.column("privileged")]
    targets = reader.column("target")
    turns = [turn for episode in Lessons().told(tmp_path) for turn in episode.turns]
    assert [turn.tries for turn in turns] == [any(one.spec.arms for one in PlanStep.parse(text).actions) for text in taught]
    learnt = [(turn.answer, target) for turn, target in zip(turns, targets, strict=True) if turn.answer]
    assert all(target.startswith("GoTo(") for turn, target in zip(turns, targets, strict=True) if not turn.answer)
    assert len(learnt) == len(turns) if not ahead else len(learnt) > 0.8 * len(turns)
    assert all(_step(answer) == _step(answer_words("Pick", "", PlanStep.parse(target))) for answer, target in learnt)
    assert (targets != taught) == ahead
    assert reader.manifest.metadata["physics"] == PHYSICS
    alone = [_step(turn.answer) for turn in Lessons().logged(tmp_path)(-1).turns]
    assert all(step in [_step(answer_words("Pick", "", PlanStep.parse(text))) for text in taught] for step in alone)


def _step(answer: Sequence[str]) -> tuple[str, ...]:
    return tuple(answer[list(answer).index("do") + 1 :])


def test_a_fourth_walk_to_what_no_arm_has_tried_is_not_learnt() -> None:
    walk, pick = PlanStep.parse("GoTo(Mug_1, 0.5)"), PlanStep.parse("Pick(left, Mug_1)")
    log = [HistoryItem(walk.to_text(), f"{walk.to_text()} ok")] * 4
    looks = [Shown("Pick up the mug.", "h1", ("Mug_1",), ("DiningTable_1", "Mug_1"), tuple(log[:count])) for count in range(5)]
    told = lessons._of_log(looks, False, {}, False, [walk, walk, walk, walk, pick])
    assert [bool(turn.answer) for turn in told.turns] == [True, True, True, False, True]
    assert all(turn.taken for turn in told.turns[:-1])  # it stays in the log


def test_half_of_the_episodes_reflect_on_every_failure() -> None:
    reflecting = 0
    for seed in range(40):
        turns = Lessons().episode(seed).turns
        failed = [_failed(before.taken) for before in turns[:-1]]
        asked = ["why" in turn.now[-2:] for turn in turns[1:]]
        assert asked in (failed, [False] * len(failed))
        assert ["so" in turn.answer[:2] for turn in turns[1:]] == asked
        assert turns[0].now[-1] == "do" and "why" not in turns[0].now
        reflecting += any(asked)
    assert 10 < reflecting < 30


def _failed(taken: Sequence[str]) -> bool:
    return any(word in {*FailureCode, "fail"} for word in taken)


def test_some_episodes_tell_failures_as_one_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    def codes(share: float) -> set[str]:
        monkeypatch.setattr(lessons, "_AS_BIT", share)
        taken = {word for seed in range(20) for turn in Lessons().episode(seed).turns for word in turn.taken}
        return taken & {*FailureCode, "fail"}

    assert codes(1.0) == {"fail"}
    assert "fail" not in codes(0.0) and len(codes(0.0)) > 5


def test_mistakes_are_taken_and_never_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    mistake = PlanStep.parse("RotateLeft(5)")
    monkeypatch.setattr(lessons, "MISTAKES", (0.5,))
    monkeypatch.setattr(TextWorld, "mistake", lambda self, step: mistake)
    words = answer_words("Pick", None, mistake)[3:-1]
    turns = [turn for seed in range(12) for turn in Lessons().episode(seed).turns]
    assert sum(turn.taken[1:3] == words for turn in turns) > 20
    assert not any(turn.answer[-len(words) - 1 : -1] == words for turn in turns)


def test_half_of_the_tasks_are_of_two_things_for_two_arms() -> None:
    optional = [FAMILIES[WordsOnly(seed).task.family].category == "optional" for seed in range(200)]
    assert 0.4 <= np.mean(optional) <= 0.6


def test_things_that_pictures_leave_out_are_in_words(episodes: list) -> None:
    words = {word for one in episodes for turn in one.turns for word in (*one.prefix, *turn.taken)}
    assert all(set(id_words(f"{name}_1")) <= words for name in UNSEEN_TYPES)


def test_every_word_is_known_or_made_up(episodes: list) -> None:
    known = set(Lessons().words())
    used = {word for one in episodes for turn in one.turns for word in (*one.prefix, *turn.now, *turn.answer, *turn.taken)}
    plurals = {word for word in used - known if word.endswith("s") and (word[:-1] in known or word[:-2] in known)}
    made_up = used - known - plurals - {"knives"}
    assert all(re.fullmatch(r"(?:[a-z]{2}){3}s?", word) for word in made_up)
    assert len(made_up) > 20


def test_an_answer_names_what_was_shown(episodes: list) -> None:
    for episode in episodes:
        shown: set[str] = set(episode.prefix)
        for turn in episode.turns:
            shown |= set(turn.now)
            named = [word for word in turn.answer if re.fullmatch(r"(?:[a-z]{2}){3}", word) and word not in Lessons().words()]
            assert set(named) <= shown
            shown |= set(turn.taken)


def test_slots_are_the_same_in_instruction_and_ids() -> None:
    class Tokenizer:
        def __init__(self) -> None:
            self.added: dict[str, int] = {}

        def add_tokens(self, tokens: list) -> None:
            for token in tokens:
                self.added.setdefault(token.content, len(self.added))

        def get_added_vocab(self) -> dict[str, int]:
            return self.added

    tokenizer = Tokenizer()
    add_word_tokens(tokenizer, ["put", "two", "on", "the", "s", "_1", "knife", "box"])
    words = WordTokens(tokenizer, np.random.default_rng(0))
    put, two, zubo, ending = words.tokens(text_words("Put two zubos"))
    assert words.tokens(id_words("Zubo_1"))[0] == zubo
    assert words.tokens(["knives"]) == words.tokens(["knife", "s"])
    assert words.tokens(["boxes"]) == words.tokens(["box", "s"])
    assert len({put, two, zubo, ending}) == 4
    assert words.tokens(["mika"]) != words.tokens(["zubo"])


def test_some_instructions_say_where_a_thing_is_that_is_in_view() -> None:
    """So does the simulator's, where a robot sees more than its task was written for."""
    told, hidden = 0, 0
    for seed in range(150):
        shown = WordsOnly(seed).shown()
        for mention in {goal.obj for goal in read_goals(shown.instruction, shown.known_objects) if goal.obj.place is not None}:
            in_view = any(type_of(name) == mention.name for name in shown.visible_objects)
            told, hidden = told + in_view, hidden + (not in_view)
    assert 0.05 < told / (told + hidden) < 0.3
