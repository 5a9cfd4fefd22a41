"""Judging questions, and how a critic's verdicts become examples; the critic here is a scripted one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from configs.compose import compose
from configs.schema.model import ModelConfig
from configs.schema.train import TrainConfig
from configs.validate import build
from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.batch import Example
from proprio_mllm.model.building import build_model, build_processor
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import add_word_tokens, known_words
from proprio_mllm.model.wording import id_words, read_step, text_words
from proprio_mllm.training import asking, critic
from proprio_mllm.training.critic import (
    Judge,
    Kept,
    ModelJudge,
    OracleJudge,
    Trajectory,
    actor_examples,
    audit,
    critic_examples,
    keep,
)
from proprio_mllm.training.goals import Relabel
from proprio_mllm.training.judging import Verdicts, state_example
from proprio_mllm.training.pipeline import base_model_config
from proprio_mllm.training.rollouts import Moment, Rollout
from proprio_mllm.training.sources import Demos
from proprio_mllm.training.states import history_of

KNOWN = ("Mug_1", "Plate_1", "CoffeeTable_1")


class Scripted(Judge):
    """Says yes to given (episode, moment, goal) triples, and answers every question with one reply."""

    def __init__(self, yes: set[tuple[str, int, str]], reply: str = "none") -> None:
        self.yes, self.reply = yes, reply

    def completed(self, queries: Sequence[tuple[Trajectory, int, str]]) -> list[bool]:
        return [(t.rollout.episode, at, goal) in self.yes for t, at, goal in queries]

    def ask(self, trajectory: Trajectory, relation: str) -> str:
        return self.reply


def trajectory(episode: str, steps: Sequence[tuple[str, bool]], instruction: str, success: bool) -> Trajectory:
    moments = [
        Moment(i, text, f"{text} {'ok' if ok else 'Blocked'}", ok, KNOWN[:2], KNOWN) for i, (text, ok) in enumerate(steps)
    ]
    moments.append(Moment(len(steps), "", "", True, KNOWN[:2], KNOWN))
    count = len(moments)
    from data.shards import encode_png

    row = {
        "images": [encode_png(np.zeros((112, 112, 3), dtype=np.uint8))] * count,
        "intrinsics": np.eye(3).ravel(),
        "cameras_in_pelvis": [np.eye(4).ravel()] * count,
        "key_bodies": [np.zeros(42)] * count,
        "height": 112,
        "width": 112,
    }
    relations = {"held": ["Plate_1"]}
    rollout = Rollout(episode, "h1", "single", instruction, 8, tuple(moments), (), success, relations, row)
    return Trajectory(rollout, (None,) * count)


@pytest.fixture(scope="module")
def reader() -> ProprioMLLM:
    """A small model that reads whole episodes in words."""
    whole = build(TrainConfig, compose("train", [])).model
    text = dataclasses.replace(whole.text, hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96)
    cfg = dataclasses.replace(base_model_config(whole), sees=False, text=text)
    words = Lessons().words()
    processor = build_processor(cfg, [" ".join(words)] * 2)
    add_word_tokens(processor.tokenizer, words)
    return build_model(cfg, processor, 0)


def words_in(model: ProprioMLLM, example: Example, learnt: bool) -> list[str]:
    """The words of a sequence that are learnt, or those that are read."""
    words = {token: word for word, token in known_words(model.processor.tokenizer).items()}
    assert example.tokens is not None
    pairs = zip(example.tokens.ids, example.tokens.targets, strict=True)
    return [words.get(token, "?") for token, target in pairs if target is learnt]


def learnt_words(model: ProprioMLLM, examples: Sequence[Example]) -> list[list[str]]:
    """The answers of sequences."""
    return [words_in(model, example, True) for example in examples]


def taught_words(model: ProprioMLLM, kept: Sequence[Kept]) -> list[list[str]]:
    """The answers that the actor is to learn."""
    return learnt_words(model, actor_examples(model, kept))


def taught(model: ProprioMLLM, kept: Sequence[Kept]) -> list[str]:
    """The steps of these answers."""
    ids = {id_words(name): name for name in KNOWN}
    return [read_step(words, ids).to_text() for words in taught_words(model, kept)]


PICK_PLATE = [("GoTo(Plate_1)", True), ("Pick(left, Plate_1)", False), ("Pick(right, Plate_1)", True), ("MoveAhead(0.3)", True)]


def test_relabelling_and_truncation(reader: ProprioMLLM) -> None:
    good = trajectory("a", [("GoTo(Mug_1)", True), ("Pick(left, Mug_1)", True)], "Pick up the mug.", True)
    wrong = trajectory("b", PICK_PLATE, "Pick up the mug.", False)
    plate = "Pick up the plate."
    judge = Scripted({("a", 2, "Pick up the mug."), ("b", 3, plate), ("b", 4, plate)}, "Plate_1")
    goals: dict[tuple[str, str], Relabel] = {}
    examples = critic_examples(reader, [good, wrong], judge, goals)
    assert [(one.kind, one.episode) for one in examples] == [("direct", "a"), ("negative", "b"), ("relabel", "b")]
    assert learnt_words(reader, [one.example for one in examples]) == [
        ["Done", "do", "Done", "."],
        ["again", "."],
        ["Done", "do", "Done", "."],
    ]
    assert list(goals) == [("b", plate)]
    kept = keep([good, wrong], goals, judge, 10)
    assert [(item.goal, item.end, item.relabelled) for item in kept] == [("Pick up the mug.", 2, False), (plate, 3, True)]
    targets = taught(reader, kept)
    # The failed step is context, not a target, and nothing after the first success is learnt.
    assert targets == ["GoTo(Mug_1)", "Pick(left, Mug_1)", "GoTo(Plate_1)", "Pick(right, Plate_1)"]
    scores = audit([good, wrong], goals, judge)
    assert scores["precision"] == scores["recall"] == 1.0
    assert scores["judged"] == 3.0


def test_a_hallucinated_yes_lowers_precision() -> None:
    wrong = trajectory("b", PICK_PLATE, "Pick up the mug.", False)
    scores = audit([wrong], {}, Scripted({("b", 4, "Pick up the mug.")}))
    assert scores["precision"] == 0.0
    assert "recall" not in scores


def test_a_goal_comes_true_through_a_step_that_worked() -> None:
    """After a walk, a failed step or before the first one nobody asks; an episode's own goal comes true at its end."""
    pick = "Pick up the plate."
    always = {("b", at, pick) for at in range(5)}
    wrong, goals = trajectory("b", PICK_PLATE, "Pick up the mug.", False), {("b", pick): Relabel(pick, (), ())}
    ends = [keep([wrong], goals, Scripted(always - {("b", at, pick) for at in nos}), 10)[0].end for nos in ((), (1,), (3,))]
    assert ends == [3, 3, 4]
    assert keep([trajectory("b", PICK_PLATE, pick, True)], {}, Scripted(always), 10)[0].end == 4


def test_the_oracle_knows_the_end_alone() -> None:
    picked = trajectory("b", PICK_PLATE, "Pick up the mug.", False)
    relabelled = {
        ("b", "Pick up the plate."): Relabel("Pick up the plate.", (("pick", "Plate_1", ""),), ()),
        ("b", "Pick up both."): Relabel("Pick up both.", (("pick", "Plate_1", ""), ("pick", "Mug_1", "")), ()),
        ("b", "Open it."): Relabel("Open it.", (("open", "Plate_1", ""),), ()),
    }
    oracle = OracleJudge(relabelled)
    goals = ["Pick up the plate.", "Pick up both.", "Open it.", "Pick up the mug.", "Dance!"]
    assert [oracle.truth(picked.rollout, goal) for goal in goals] == [True, False, False, False, None]
    assert oracle.completed([(picked, 4, goal) for goal in goals]) == [True, False, False, False, False]
    done = trajectory("a", PICK_PLATE, "Pick up the plate.", True)
    assert oracle.completed([(done, at, "Pick up the plate.") for at in range(5)]) == [False] * 4 + [True]
    assert [oracle.ask(picked, relation) for relation in ("held", "open")] == ["Plate_1", "none"]


def test_the_model_answers_every_question_under_the_critics_adapter(
    reader: ProprioMLLM, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, sizes, adapters = iter([" Done", " again", "Done", " Pick", " done", "Plate_1"]), list[tuple[int, int]](), list[str]()

    class Batch(list[Example]):
        def to(self, device: str) -> Batch:
            return self

    def reply(batch: Batch, tokens: int, allowed: None) -> list[str]:
        sizes.append((len(batch), tokens))
        return [next(told) for _ in batch]

    monkeypatch.setattr(critic, "use_adapter", lambda model, name: adapters.append(name))
    monkeypatch.setattr(asking, "Collator", lambda processor, cfg: lambda examples, generation: Batch(examples))
    monkeypatch.setattr(asking, "_BATCH", 2)
    model = SimpleNamespace(cfg=reader.cfg, processor=reader.processor, device="cpu", reply=reply)
    model.eval = lambda: model
    judge = ModelJudge(cast(ProprioMLLM, model))
    whole = trajectory("b", PICK_PLATE, "Pick up the mug.", False)
    for _ in range(2):
        assert judge.completed([(whole, at, "Pick up the mug.") for at in range(5)]) == [True, False, True, False, False]
    assert [size for size, _ in sizes] == [2, 2, 1]  # nothing is asked twice
    assert judge.ask(whole, "held") == "Plate_1"
    assert sizes[-1][0] == 1 and sizes[-1][1] > sizes[0][1]  # ids are longer than a yes
    assert set(adapters) == {"critic"}


def test_precision_is_of_the_yes_alone() -> None:
    class Said(ModelJudge):
        def __init__(self, *said: bool) -> None:
            self.said = list(said)

        def agrees(self, asked: Sequence[Example]) -> list[bool]:
            return self.said

    asked = [(Example(), truth) for truth in (True, False, True, True, False)]
    assert critic.precision(Said(True, True, True, False, False), asked) == pytest.approx(2 / 3)
    assert critic.precision(Said(*[False] * 5), asked) == 0.0


def test_duplicates_and_caps() -> None:
    same = [trajectory(name, PICK_PLATE[:1], "Pick up the mug.", True) for name in "ab"]
    judge = Scripted({(name, 1, "Pick up the mug.") for name in "abcd"})
    assert len(keep(same, {}, judge, 10)) == 1
    others = [trajectory(name, [(f"MoveAhead(0.{n})", True)], "Pick up the mug.", True) for n, name in enumerate("abcd", 1)]
    assert len(keep(others, {}, judge, 2)) == 2


def test_a_sub_goal_is_the_next_work_of_an_arm(reader: ProprioMLLM) -> None:
    steps = [("MoveAhead(0.3)", True), ("Pick(left, Mug_1)", False), ("Pick(left, Mug_1)", True), ("MoveUp(0.1)", True)]
    whole = trajectory("a", [*steps, ("Place(left, CoffeeTable_1)", True), ("MoveUp(0.1)", True)], "Put the mug away.", True)
    first, *others = whole.rollout.moments
    unseen = dataclasses.replace(first, visible=("Plate_1",), known=("Plate_1", "CoffeeTable_1"))
    rollout = dataclasses.replace(whole.rollout, moments=(unseen, *others))
    kept = Kept(dataclasses.replace(whole, rollout=rollout), "Put the mug away.", 6, False)
    words = taught_words(reader, [kept, kept])
    mug, table = id_words("Mug_1"), id_words("CoffeeTable_1")
    goals = [("Pick", "unseen"), ("Pick", *mug), ("Place", *table), ("Place", *table)]
    assert [tuple(answer[: answer.index("do")]) for answer in words[4:]] == goals
    goals[1] = ("chance", "so", "again", *goals[1])  # every other one reflects
    assert [tuple(answer[: answer.index("do")]) for answer in words[:4]] == goals


def test_standing_still_is_not_learnt(reader: ProprioMLLM) -> None:
    steps = [("GoTo(Mug_1)", False), ("GoTo(Mug_1)", True), ("GoTo(Mug_1)", True), ("MoveUp(0.1)", True), ("MoveUp(0.1)", True)]
    steps += [("Pick(left, Mug_1)", True)]
    kept = keep([trajectory("a", steps, "Pick up the mug.", True)], {}, Scripted({("a", 6, "Pick up the mug.")}), 10)
    targets = taught(reader, kept)
    assert targets == ["GoTo(Mug_1)", "MoveUp(0.1)", "MoveUp(0.1)", "Pick(left, Mug_1)"]


@pytest.fixture
def demos(shards: Path, cfg: ModelConfig) -> Demos:
    return Demos(shards / "lessons", cfg)


def goal_in(model: ProprioMLLM, example: Example) -> list[str]:
    """The words of the goal that a question is about."""
    words = words_in(model, example, False)
    return words[1 : words.index("room")]


def spoken(model: ProprioMLLM, goal: str) -> list[str]:
    """A goal as `words_in` reads it."""
    known = known_words(model.processor.tokenizer)
    return [word if word in known else "?" for word in text_words(goal)]


def test_an_episode_is_asked_whether_it_met_the_goal_of_another(
    demos: Demos, reader: ProprioMLLM, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, asked = demos.shown, list[tuple[int, str]]()
    monkeypatch.setattr(demos, "shown", lambda index, goal: asked.append((index, goal)) or shown(index, goal))
    rng, verdicts = np.random.default_rng(0), Verdicts(reader, demos, None)
    found = [verdicts.draw(rng) for _ in range(100)]
    answers = [answer[0] for answer in learnt_words(reader, found)]
    assert set(answers) == {"Done", "again"} and min(map(answers.count, answers)) > 10
    for example, answer, (index, goal) in zip(found, answers, asked, strict=True):
        assert goal_in(reader, example) == spoken(reader, goal)
        assert (answer == "Done") is (goal == demos.reader[index]["instruction"])
        assert demos.reader[index]["target"] == "Done()" and index in demos.split.train
        assert words_in(reader, example, False)[-1] == "do"


def test_what_was_shown_begins_with_the_episode(demos: Demos) -> None:
    for index in range(demos.starts[3]):
        shown = demos.shown(index, "Tidy up.")
        assert {one.instruction for one in shown} == {"Tidy up."}
        assert [list(one.history) for one in shown] == [history_of(demos.reader[index])[:at] for at in range(len(shown))]
        assert len(shown[-1].history) == len(history_of(demos.reader[index]))


def test_questions_about_states_are_answered_with_ids(demos: Demos) -> None:
    rng = np.random.default_rng(0)
    found = [state_example(demos, int(rng.choice(demos.split.train)), rng, None).messages[-1].text for _ in range(100)]
    assert "none" in found and any(reply.endswith("_1") for reply in found)


def holds(demos: Demos, index: int, goal: str) -> bool:
    """Whether a goal is met before a row."""
    return demos.reader[index]["target"] == "Done()" and goal == demos.reader[index]["instruction"]


def test_a_held_out_question_about_the_goal_of_another_is_answered_no(
    demos: Demos, reader: ProprioMLLM, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demos.split, "test", np.arange(len(demos.motions)))  # so that there are several goals
    shown, told = demos.shown, list[tuple[int, str]]()
    monkeypatch.setattr(demos, "shown", lambda index, goal: told.append((index, goal)) or shown(index, goal))
    truths = [truth for _, truth in Verdicts(reader, demos, None).held_out(60)]
    assert truths == [holds(demos, index, goal) for index, goal in told]
    assert any(goal != demos.reader[index]["instruction"] for index, goal in told)


def test_held_out_questions_are_of_episodes_that_no_training_sees(
    demos: Demos, reader: ProprioMLLM, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, told = demos.shown, list[tuple[int, str]]()
    monkeypatch.setattr(demos, "shown", lambda index, goal: told.append((index, goal)) or shown(index, goal))
    asked, again = (Verdicts(reader, demos, None).held_out(60) for _ in range(2))
    assert [(one.tokens, truth) for one, truth in asked] == [(one.tokens, truth) for one, truth in again]
    assert {truth for _, truth in asked} == {True, False}
    for (_, truth), (index, goal) in zip(asked, told[:60], strict=True):
        assert index in demos.split.test
        assert truth is holds(demos, index, goal)
    assert not any(learnt_words(reader, [one for one, _ in asked]))  # the answer is not shown
    rows = [demos.reader[int(index)] for index in demos.split.test]
    goals = [spoken(reader, row["instruction"]) for row in rows]
    done = [spoken(reader, row["instruction"]) for row in rows if row["target"] == "Done()"]
    assert all(goal_in(reader, one) in (done if truth else goals) for one, truth in asked)
