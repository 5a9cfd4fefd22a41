"""A model that plans in words: replies are steps, what was read stays read, what was refused twice is not insisted on."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from transformers import DynamicCache

from configs.compose import compose
from configs.schema.train import TrainConfig
from configs.validate import build
from interface.observation import Camera, HistoryItem, Observation, Proprioception
from interface.sightings import Shown
from interface.steps import PlanStep
from proprio_mllm.evaluation.lessons import Lessons, WordsOnly
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import build_model, build_processor, save_model
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.observing import LONGEST_LOG, turn_example, view_of
from proprio_mllm.model.placing import Placing, stands_alone
from proprio_mllm.model.word_tokens import add_word_tokens
from proprio_mllm.model.wording import CAUSES, CHANGES, answer_words, prefix_words
from proprio_mllm.planners.answers import AnswerGrammar
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, WeightsError
from proprio_mllm.planners.words import WordsPlanner, _Answer
from proprio_mllm.training.pipeline import base_model_config

INFO = TaskInfo("", "h1", 20)


def small(sees: bool = False, english: bool = False) -> WordsPlanner:
    whole = build(TrainConfig, compose("train", ["stage=words"])).model
    cfg = whole if sees else base_model_config(whole)
    text = dataclasses.replace(cfg.text, hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96)
    vision = dataclasses.replace(cfg.vision, hidden=32, depth=1, heads=2, intermediate=32)
    motion_cfg = dataclasses.replace(cfg.motion, codes=32)
    cfg = dataclasses.replace(
        cfg,
        sees=sees,
        text=text,
        vision=vision,
        motion=motion_cfg,
        cse=dataclasses.replace(cfg.cse, enabled=sees),
        point_map=dataclasses.replace(cfg.point_map, width=32, depth=1),
    )
    words = Lessons().words()
    processor = build_processor(cfg, [" ".join(words)] * 2)
    if not english:
        add_word_tokens(processor.tokenizer, words)
    motion = MotionTokenizer(motion_cfg).eval() if sees else None
    model = build_model(cfg, processor, 3).eval()
    if model.cse is not None:
        assert model.cse.named is not None
        torch.nn.init.constant_(model.cse.named.bias, 5.0)  # every word is looked up
    return WordsPlanner(model, motion)


@pytest.fixture(scope="module")
def planner() -> WordsPlanner:
    return small()


@pytest.fixture(scope="module")
def seeing() -> WordsPlanner:
    return small(sees=True)


@pytest.fixture(scope="module")
def spelling() -> WordsPlanner:
    """One whose tokenizer spells words."""
    return small(english=True)


def seen(shown: Shown, seed: int) -> Observation:
    """What is shown, with a picture and a body of a seed."""
    rng = np.random.default_rng(seed)
    body = Proprioception(rng.normal(size=(64, 48)).astype(np.float32), 20.0, np.zeros(3), rng.normal(size=(14, 3)))
    image = rng.integers(0, 256, (112, 112, 3)).astype(np.uint8)
    camera = Camera(np.array([[100.0, 0.0, 56.0], [0.0, 100.0, 56.0], [0.0, 0.0, 1.0]]), np.eye(4), 112, 112)
    parts = (shown.visible_objects, shown.known_objects, body, shown.history, len(shown.history), 20)
    return Observation(shown.instruction, shown.robot, image, camera, *parts)


def begin(planner: WordsPlanner, seed: int = 0):
    return planner.begin(INFO, np.random.default_rng(seed))


@pytest.mark.parametrize("which", ["planner", "spelling"])
def test_side_by_side_as_alone(which: str, request: pytest.FixtureRequest) -> None:
    planner: WordsPlanner = request.getfixturevalue(which)
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


def test_side_by_side_as_alone_with_pictures(seeing: WordsPlanner) -> None:
    together, alone = ([WordsOnly(seed) for seed in range(3)] for _ in range(2))
    states, own = ([begin(seeing) for _ in range(3)] for _ in range(2))
    for number in range(4):
        replies = seeing.step_batch([seen(one.shown(), number) for one in together], states)
        for row, reply in enumerate(replies):
            one = seeing.step_batch([seen(alone[row].shown(), number)], [own[row]])[0]
            assert one.text == reply.text
            assert own[row].cached == len(own[row].log) == own[row].cache.get_seq_length()  # no picture stays in the log
            assert one.step is not None
            together[row].take(one.step)
            alone[row].take(one.step)


@pytest.mark.parametrize("changed", ["image", "motion"])
def test_what_is_seen_and_felt_tells_in_the_answer(seeing: WordsPlanner, changed: str) -> None:
    shown = WordsOnly(3).shown()
    one, other = seen(shown, 0), seen(shown, 1)
    mixed = (
        dataclasses.replace(one, image=other.image)
        if changed == "image"
        else dataclasses.replace(
            one, proprioception=dataclasses.replace(one.proprioception, motion=other.proprioception.motion)
        )
    )

    def scores(observation: Observation) -> torch.Tensor:
        state = begin(seeing)
        turn = turn_example(seeing.model, (), state.look(observation), observation, seeing.motion)
        batch = Collator(seeing.model.processor, seeing.model.cfg)([turn])
        return seeing.model.following(seeing.model.look(batch), DynamicCache())

    assert torch.equal(scores(one), scores(one))
    assert not torch.allclose(scores(one), scores(mixed), atol=1e-6)


def test_a_picture_stands_before_the_word_that_opens_the_answer(seeing: WordsPlanner) -> None:
    state, observation = begin(seeing), seen(WordsOnly(3).shown(), 0)
    now = state.look(observation)
    example = turn_example(seeing.model, state.log, now, observation, seeing.motion, answer=[7, 8])
    assert example.tokens is not None
    ids, told = list(example.tokens.ids), [*state.log, *now]
    assert ids[: len(told) - 1] == told[:-1]
    assert ids[-3:] == [told[-1], 7, 8]
    assert example.tokens.targets == (False,) * (len(ids) - 2) + (True, True)
    read = turn_example(seeing.model, state.log, now, observation, seeing.motion, read=5)
    assert read.tokens is not None
    collate = Collator(seeing.model.processor, seeing.model.cfg)
    whole, rest = collate([example]), collate([read])
    assert torch.equal(whole.position_ids[:, :, 5:-2], rest.position_ids)
    assert whole.labels[0, -2:].tolist() == [7, 8]
    assert whole.supervised == 2


def test_token_after_token_is_read_as_all_at_once(seeing: WordsPlanner) -> None:
    model, collate = seeing.model, Collator(seeing.model.processor, seeing.model.cfg)
    turns = [(begin(seeing), seen(WordsOnly(seed).shown(), seed)) for seed in (3, 4)]  # of different lengths: one is padded
    nows = [state.look(observation) for state, observation in turns]
    words = [begin(seeing).words.tokens(said) for said in (("pick", "coffee", "machine"), ("mug", "_2", "do"))]

    def examples(count: int) -> list[Example]:
        return [
            turn_example(model, state.log, now, observation, seeing.motion, answer=answer[:count])
            for (state, observation), now, answer in zip(turns, nows, words, strict=True)
        ]

    cache, batch = DynamicCache(), model.look(collate(examples(0), padding="left"))
    for count in range(4):
        whole = model.following(model.look(collate(examples(count), padding="left")), DynamicCache())
        torch.testing.assert_close(model.following(batch, cache), whole, atol=1e-5, rtol=1e-4)
        if count < 3:
            batch = batch.then(torch.tensor([[answer[count]] for answer in words]))


def test_the_point_map_says_where_things_are(seeing: WordsPlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    model = seeing.model
    plain = model.cfg
    model.cfg = dataclasses.replace(plain, places=True)
    placed, place = WordsPlanner(model, seeing.motion, temperature=3.0), Placing(model, model.point_map)

    def goals(found: float) -> list[tuple[str, ...]]:
        monkeypatch.setattr("proprio_mllm.model.placing._FOUND", found)
        answers = [placed._answer(seen(WordsOnly(seed).shown(), seed), begin(placed, seed)) for seed in range(36)]
        placed._write(answers)
        return [tuple(one.words[: one.words.index("do")]) for one in answers]

    counts = [0, 0]
    for seed, goal in enumerate(goals(-1e9)):
        shown = seen(WordsOnly(seed).shown(), seed)
        at = goal.index("at") if "at" in goal else len(goal)
        there = stands_alone(goal[1:at], shown.visible_objects)
        assert goal[at:] == (place([view_of(shown)], [goal[1:at]])[0] if there else ())
        counts[there] += 1
    assert min(counts) > 0, counts
    assert not any("at" in goal for goal in goals(1e9))  # nothing is found
    model.cfg = plain


def test_what_has_been_read_is_not_read_again(planner: WordsPlanner) -> None:
    episode, state = WordsOnly(5), begin(planner)
    for _ in range(4):
        reply = planner.step_batch([episode.shown()], [state])[0]
        assert state.cached == len(state.log) == state.cache.get_seq_length()
        assert reply.step is not None
        episode.take(reply.step)


def test_a_long_log_loses_its_oldest_steps(planner: WordsPlanner) -> None:
    shown, state, sizes = WordsOnly(5).shown(), begin(planner), []
    lines = [f"GoTo({name}) ok" for name in shown.known_objects[:3]] * 40
    history = tuple(HistoryItem(line.rsplit(" ", 1)[0], line) for line in lines)
    for count in range(len(lines) + 1):
        now = dataclasses.replace(shown, history=history[:count])
        planner.step_batch([now], [state])
        assert state.cached == len(state.log) == state.cache.get_seq_length() == sum(state.sizes)
        sizes.append(len(state.log))
    assert LONGEST_LOG // 2 < max(sizes) <= LONGEST_LOG and len([a for a, b in pairwise(sizes) if b < a]) >= 2
    state.look(now)
    prefix = state.words.tokens(prefix_words(shown))
    assert state.log[: len(prefix)] == prefix
    fresh = dataclasses.replace(state, cache=DynamicCache(), cached=0)
    scores: list[torch.Tensor] = []
    for one in (state, fresh):
        rest = planner._answer(now, one).example(one.cached)
        scores.append(planner.model.following(planner._collator([rest]), one.cache))
    assert torch.allclose(*scores, atol=1e-4)


def test_reflection_is_said_and_the_log_is_the_same_without(planner: WordsPlanner) -> None:
    shown, silent = WordsOnly(3).shown(), WordsPlanner(planner.model, reflection=False)
    lines = ("GoTo(Mug_1) ok", "Pick(left, Mug_1) TooFar", "Pick(right, Mug_1) ok")
    history = tuple(HistoryItem(line.rsplit(" ", 1)[0], line) for line in lines)
    states = {one: begin(one) for one in (planner, silent)}
    said: dict[WordsPlanner, list[PlannerReply]] = {planner: [], silent: []}
    for count in range(len(lines) + 1):
        for one, state in states.items():
            said[one] += one.step_batch([dataclasses.replace(shown, history=history[:count])], [state])
    assert states[planner].log == states[silent].log
    assert [reply.usage.reflections for reply in said[planner]] == [0, 0, 1, 0]
    assert [reply.usage.reflections for reply in said[silent]] == [0, 0, 0, 0]
    reflection, _, step = said[planner][2].text.partition("\n")
    cause, so, change = reflection.split()
    assert (cause in CAUSES, so, change in CHANGES) == (True, "so", True)
    assert said[planner][2].step == PlanStep.parse(step)
    assert said[silent][2].text == said[silent][2].step.to_text()  # type: ignore[union-attr]


def test_a_model_that_has_not_learnt_to_reflect_does_not(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(Lessons, "words", lambda self, words=Lessons.words: tuple(w for w in words(self) if w != "why"))
    made = small()
    assert not made.reflection and not caplog.records
    assert not WordsPlanner(made.model, reflection=False).reflection
    assert "has not learnt to reflect" in caplog.text


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

    first, bold = answer({}), answer({}, insist=True)
    assert answer({first: 1}) == first
    assert answer({bold: 2}, insist=True) == bold
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
    now, wanted = state.look(shown), answer_words("GoTo", "Zubos_1", PlanStep.parse("GoTo(Zubos_1)"))
    answer = _Answer(AnswerGrammar(shown.known_objects), state, turn_example(planner.model, state.log, now, None))
    written: list[int] = []
    expected = state.words.tokens(wanted)
    while not answer.ended:
        written += answer.choose(torch.eye(len(known))[expected[len(written)]], 0.0)
    assert written == expected == answer.begun()
    assert answer.step() == PlanStep.parse("GoTo(Zubos_1)")


def test_a_name_that_begins_as_another_does_is_spelt_to_its_end(spelling: WordsPlanner) -> None:
    shown = Shown("put the mug on the bed", "h1", (), ("Mug_1", "Mug_10", "Mug_11", "Bed_1"))
    for wanted in ("Mug_1", "Mug_10", "Mug_11", "Bed_1"):
        state = begin(spelling)
        answer = _Answer(AnswerGrammar(shown.known_objects), state, turn_example(spelling.model, [], state.look(shown), None))
        words = answer_words("GoTo", wanted, PlanStep.parse(f"GoTo({wanted})"))
        expected, written = state.words.tokens(words), list[int]()
        assert len(expected) > len(words)
        scores = torch.eye(len(spelling.model.processor.tokenizer))
        while not answer.ended:
            written += answer.choose(scores[expected[len(written)]], 0.0)
            written += answer.skip()
        assert written == expected == answer.begun()
        assert tuple(answer.words) == words
        assert answer.step() == PlanStep.parse(f"GoTo({wanted})")


def test_a_pretrained_tokenizer_reads_english(spelling: WordsPlanner) -> None:
    state = begin(spelling)
    now = state.look(Shown("put the mug on the bed", "h1", ("Mug_1",), ("Mug_1", "SideTable_12")))
    text = spelling.model.processor.tokenizer.decode([*state.log, *now])
    assert text == (
        " h1 put the mug on the bed\nIn the room: mug_1 side table_12\nNow: left empty right empty away; in view: mug_1\nDo:"
    )


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


def test_a_stored_model_plans_as_it_did(planner: WordsPlanner, tmp_path: Path) -> None:
    save_model(planner.model, tmp_path / "words")
    loaded = WordsPlanner.load(tmp_path / "words")
    shown = WordsOnly(3).shown()
    ours, theirs = (one.step_batch([shown], [begin(one)])[0] for one in (planner, loaded))
    assert ours.text == theirs.text
    torch.testing.assert_close(loaded.model.table, planner.model.table)
    with pytest.raises(WeightsError, match=r"python train\.py stage=words"):
        WordsPlanner.load(tmp_path / "nothing", train="python train.py stage=words")


def test_what_leaves_no_choice_is_not_asked_for(planner: WordsPlanner, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    answers: list[_Answer] = []
    following, answer = planner.model.following, planner._answer
    monkeypatch.setattr(planner.model, "following", lambda *args: asked.append(1) or following(*args))
    monkeypatch.setattr(planner, "_answer", lambda *args: answers.append(answer(*args)) or answers[-1])
    shown = dataclasses.replace(WordsOnly(5).shown(), known_objects=("Mug_1",), visible_objects=("Mug_1",))
    state, log = begin(planner), begin(planner)
    log.look(shown)
    grammar = AnswerGrammar(shown.known_objects, log.sightings.belief)
    planner.step_batch([shown], [state])
    words = answers[0].words
    assert len(asked) == sum(len(grammar.allowed(words[:size])) > 1 for size in range(len(words))) < len(words)
