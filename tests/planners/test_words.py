"""A model that plans in words: replies are steps, what was read stays read, what was refused twice is not insisted on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from configs.compose import compose
from configs.schema.train import TrainConfig
from configs.validate import build
from data.interface.observation import HistoryItem
from data.interface.steps import PlanStep
from proprio_mllm.evaluation.lessons import Lessons, Shown, WordsOnly
from proprio_mllm.model.building import build_model, build_processor, save_model
from proprio_mllm.model.word_tokens import add_word_tokens
from proprio_mllm.model.wording import answer_words
from proprio_mllm.planners.answers import AnswerGrammar
from proprio_mllm.planners.protocol import TaskInfo, WeightsError
from proprio_mllm.planners.words import WordsPlanner, _Answer, plans_in_words
from proprio_mllm.training.pipeline import base_model_config

INFO = TaskInfo("", "h1", 20)


@pytest.fixture(scope="module")
def planner() -> WordsPlanner:
    cfg = dataclasses.replace(base_model_config(build(TrainConfig, compose("train", ["stage=words"])).model), episodes=True)
    small = dataclasses.replace(
        cfg, text=dataclasses.replace(cfg.text, hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96)
    )
    words = Lessons().words()
    processor = build_processor(small, [" ".join(words)] * 2)
    add_word_tokens(processor.tokenizer, words)
    return WordsPlanner(build_model(small, processor, 3).eval())


def begin(planner: WordsPlanner, seed: int = 0):
    return planner.begin(INFO, np.random.default_rng(seed))


def test_side_by_side_as_alone(planner: WordsPlanner) -> None:
    together, alone = ([WordsOnly(seed) for seed in range(4)] for _ in range(2))
    states, own = ([begin(planner) for _ in range(4)] for _ in range(2))
    for _ in range(5):
        replies = planner.step_batch([one.shown() for one in together], states)
        for row, reply in enumerate(replies):
            one = planner.step_batch([alone[row].shown()], [own[row]])[0]
            assert one.text == reply.text
            assert one.step is not None
            if one.step.actions[0].name != "Done":
                together[row].take(one.step)
                alone[row].take(one.step)


def test_what_has_been_read_is_not_read_again(planner: WordsPlanner) -> None:
    episode, state = WordsOnly(5), begin(planner)
    for _ in range(4):
        reply = planner.step_batch([episode.shown()], [state])[0]
        assert state.cached == len(state.log) == state.cache.get_seq_length()
        assert reply.step is not None
        episode.take(reply.step)


def test_temperature_draws_from_the_episodes_generator(planner: WordsPlanner) -> None:
    hot = WordsPlanner(planner.model, temperature=2.0)
    shown = WordsOnly(9).shown()
    texts = [hot.step_batch([shown], [begin(hot, seed)])[0].text for seed in (0, 0, 1, 2, 3)]
    assert texts[0] == texts[1]
    assert len(set(texts)) > 2


def test_what_was_refused_twice_is_not_insisted_on(planner: WordsPlanner) -> None:
    shown = WordsOnly(3).shown()

    def answer(refused: dict[str, int], insist: bool = False) -> str:
        state = begin(planner)
        state.refused |= refused
        return WordsPlanner(planner.model, insist=insist).step_batch([shown], [state])[0].text

    first = answer({})
    assert answer({first: 1}) == first
    assert answer({first: 2}, insist=True) == first
    second = answer({first: 2})
    assert second != first
    assert answer({first: 2, second: 2}) not in (first, second)


def test_names_that_end_like_plurals_are_written_as_they_are_read(planner: WordsPlanner) -> None:
    shown = Shown("put the zubos on the kafus", "h1", (), ("Zubos_1", "Kafus_1"))
    states = [begin(planner) for _ in range(3)]
    hot = WordsPlanner(planner.model, temperature=5.0)
    for _ in range(4):
        for reply, alone in zip(hot.step_batch([shown] * 3, states), states, strict=True):
            assert reply.step is not None
            assert {one.object_id for one in reply.step.actions} <= {None, "Zubos_1", "Kafus_1"}
            assert alone.words.tokens(["zubos"]) == [alone.words.tokens(["zubo"])[0], alone.words.known["s"]]
    state, known = begin(planner), planner.model.processor.tokenizer
    answer = _Answer(AnswerGrammar(shown.known_objects), state)
    prompt, wanted = state.look(shown), answer_words("GoTo", "Zubos_1", PlanStep.parse("GoTo(Zubos_1)"))
    written: list[int] = []
    expected = state.words.tokens(wanted)
    while (token := answer.choose(torch.eye(len(known))[expected[min(len(written), len(expected) - 1)]], 0.0)) is not None:
        written.append(token)
    assert prompt
    assert written == expected == answer.begun()
    assert answer.step() == PlanStep.parse("GoTo(Zubos_1)")


def test_refusals_are_counted_until_something_succeeds(planner: WordsPlanner) -> None:
    shown, state = WordsOnly(3).shown(), begin(planner)
    pick, walk = "Pick(left, Mug_1)", "GoTo(Mug_1)"
    lines = (f"{pick} TooFar", f"{pick} TooFar", f"{walk} ok", f"{walk} ok", f"{walk} ok", f"{pick} TooFar", f"{pick} ok")
    history = tuple(HistoryItem(line.rsplit(" ", 1)[0], line) for line in lines)
    counts = []
    for count in range(len(lines) + 1):
        state.look(dataclasses.replace(shown, history=history[:count]))
        counts.append(dict(state.refused))
    assert counts == [{}, {pick: 1}, {pick: 2}, {}, {walk: 1}, {walk: 2}, {walk: 2, pick: 1}, {}]


def test_a_stored_model_is_known_by_its_configuration(planner: WordsPlanner, tmp_path: Path) -> None:
    save_model(planner.model, tmp_path / "words")
    assert plans_in_words(tmp_path / "words")
    assert not plans_in_words("weights/tiny/base")
    loaded = WordsPlanner.load(tmp_path / "words")
    shown = WordsOnly(3).shown()
    ours, theirs = (one.step_batch([shown], [begin(one)])[0] for one in (planner, loaded))
    assert ours.text == theirs.text
    torch.testing.assert_close(loaded.model.table, planner.model.table)
    with pytest.raises(WeightsError, match=r"python train\.py stage=words"):
        WordsPlanner.load(tmp_path / "nothing", train="python train.py stage=words")
