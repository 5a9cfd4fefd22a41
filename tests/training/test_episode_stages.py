"""The stages where whole episodes are read: the language model is taken over, every decision carries its own picture."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import build_model, build_processor, load_model, merge_adapter, save_model
from proprio_mllm.model.groups import group_of, train_only
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.word_tokens import WordTokens
from proprio_mllm.model.wording import WordEpisode, WordTurn
from proprio_mllm.training.critic import Kept, Trajectory, actor_examples
from proprio_mllm.training.pipeline import Pipeline, base_model_config
from proprio_mllm.training.rollouts import read_rollouts
from proprio_mllm.training.stages import STAGES
from proprio_mllm.training.stages.inputs import episodes_in_words, lesson_folders, lessons_of, turns_of
from proprio_mllm.training.turns import TURNS, Turns
from tests.training.conftest import collect, correct


def test_every_stage_reads_the_one_before(trained: Pipeline) -> None:
    assert list(trained.stages) == ["words", "practice", "base", "pointmap", "tokenizer", "alignment", "selu"]
    assert trained.ancestors("selu") == tuple(trained.stages)
    assert all(trained.run(stage) is None for stage in trained.stages)


def test_later_models_see_and_feel(trained: Pipeline) -> None:
    found = {name: load_model(trained.paths.model(name)).cfg for name in ("practice", "base", "selu")}
    assert [cfg.sees for cfg in found.values()] == [False, True, True]
    assert [cfg.proprioception for cfg in found.values()] == [False, False, True]


def test_a_turn_is_the_decision_of_its_row(trained: Pipeline) -> None:
    model, tokens = load_model(trained.paths.model("selu")), MotionTokenizer.load(trained.paths.model("tokenizer"))
    demos = lessons_of(trained, model.cfg)
    turns = turns_of(trained, model, demos, tokens)
    told = [turn for folder in lesson_folders(trained) for one in Lessons().told(folder) for turn in one.turns]
    rows = sorted((*turns.train, *turns.test))
    assert len(rows) == len(told) > 50
    words = WordTokens(model.processor.tokenizer)
    for row, turn in list(zip(rows, told, strict=True))[::7]:
        example = turns.example(int(row))
        assert example.tokens is not None
        learnt = [token for token, target in zip(example.tokens.ids, example.tokens.targets, strict=True) if target]
        assert learnt == words.tokens(turn.answer)
        assert np.array_equal(example.views[0].image, demos.view(demos.reader[int(row)]).image)


def test_unknown_words_are_each_episodes_own(trained: Pipeline) -> None:
    model = load_model(trained.paths.model("base"))
    demos, words = lessons_of(trained, model.cfg), WordTokens(model.processor.tokenizer)
    turn = WordTurn(("now", "do"), ("Done", "do", "Done", "."), ())
    episodes = [WordEpisode((f"zubo{number}", "room"), (turn,)) for number in range(len(demos.starts))]
    turns = Turns(model, demos, episodes)
    starts = {turns.example(int(row)).tokens.ids[:2] for row in (*turns.train, *turns.test)}
    assert starts == {tuple(words.tokens(("zubo", "room")))} and len(episodes) > 2


def test_tries_of_an_arm_are_drawn_more_often(trained: Pipeline) -> None:
    model = load_model(trained.paths.model("base"))
    turns = turns_of(trained, model, lessons_of(trained, model.cfg))
    told = [turn for folder in lesson_folders(trained) for one in Lessons().told(folder) for turn in one.turns]
    tries = dict(zip(sorted((*turns.train, *turns.test)), (turn.tries for turn in told), strict=True))
    example, drawn = turns.example, list[int]()
    turns.example = lambda row, read=0: drawn.append(row) or example(row, read)  # type: ignore[method-assign]
    for seed in range(12):
        turns.batch(np.random.default_rng(seed), 8)
    there, asked = (np.mean([tries[row] for row in rows]) for rows in (turns.train, drawn))
    assert 0.2 < there < 0.8 and asked > there + 0.5 * (3.0 * there / (1.0 + 2.0 * there) - there), (there, asked)


@pytest.mark.parametrize("stage", ["base", "selu"])
def test_decisions_beside_a_log_are_learnt_as_alone(trained: Pipeline, stage: str) -> None:
    model = load_model(trained.paths.model(stage), trainable=True).eval()
    if model.cse is not None:
        assert model.cse.named is not None
        torch.nn.init.constant_(model.cse.named.bias, 5.0)  # every word is looked up
    tokens = MotionTokenizer.load(trained.paths.model("tokenizer")) if model.cfg.proprioception else None
    turns = turns_of(trained, model, lessons_of(trained, model.cfg), tokens)
    parts = turns.batch(np.random.default_rng(3), 6)
    assert [part.input_ids.shape[0] for part in parts] == [4 * TURNS, 2 * TURNS]
    asked: list[Example] = []
    example = turns.example
    turns.example = lambda row, read=0: asked.append(example(row)) or example(row, read)  # type: ignore[method-assign]
    turns.batch(np.random.default_rng(3), 6)
    collate = Collator(model.processor, model.cfg)
    packed = sum(model(part).loss for part in parts)
    alone = [model(collate([one])) for one in asked]
    count = sum(out.supervised for out in alone)
    assert count == parts[0].out_of and sum(model(part).correct for part in parts) == sum(out.correct for out in alone)
    plain = sum(out.loss * out.supervised for out in alone) / count
    torch.testing.assert_close(packed, plain, atol=1e-4, rtol=1e-4)
    learnt = [one for one in model.parameters() if one.requires_grad]
    for one, other in zip(*(torch.autograd.grad(loss, learnt, allow_unused=True) for loss in (packed, plain)), strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            torch.testing.assert_close(one, other, atol=2e-4, rtol=1e-3)


def test_episodes_in_words_are_learnt_through_the_adapter(trained: Pipeline) -> None:
    model = load_model(trained.paths.model("alignment"), trainable=True)
    train_only(model, ("lora",))
    words = episodes_in_words(trained, model, "key")
    for part in words.batch(np.random.default_rng(0), 2):
        loss, _ = words.loss(model, part, torch.Generator())
        loss.backward()
    moved = [float(p.grad.abs().sum()) for p in model.parameters() if p.grad is not None]
    assert moved
    assert max(moved) > 0.0


def test_alignment_that_goes_all_the_way_back_has_the_layers_of_words(
    trained: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(trained.paths.root, tmp_path / "tiny")
    alignment = dataclasses.replace(trained.cfg.alignment, go_back=1.0)
    cfg = dataclasses.replace(trained.cfg, output=str(tmp_path), alignment=alignment)
    pipeline = Pipeline(STAGES, cfg, collect, "", None, Lessons())
    monkeypatch.setattr(pipeline, "loop", lambda *loop: None)
    assert pipeline.run("alignment") is not None
    model = load_model(pipeline.paths.model("alignment"))
    merge_adapter(model)
    before, base = (dict(load_model(trained.paths.model(name)).core.named_parameters()) for name in ("practice", "base"))
    layers = {name: weights for name, weights in model.core.named_parameters() if group_of(name) == "lm"}
    assert layers and all(torch.equal(weights, before[name]) for name, weights in layers.items())
    assert any(not torch.equal(weights, base[name]) for name, weights in layers.items())


def test_pretrained_weights_read_episodes_as_english(trained: Pipeline, tmp_path: Path) -> None:
    cfg = base_model_config(trained.cfg.model)
    processor = build_processor(cfg, [" ".join(Lessons().words())] * 2)
    save_model(build_model(cfg, processor, 0), tmp_path / "given")
    weights = tmp_path / "given" / "vlm"
    shutil.copytree(tmp_path / "given" / "processor", weights, dirs_exist_ok=True)
    shutil.copytree(trained.paths.root / "data", tmp_path / "tiny" / "data")
    shutil.rmtree(tmp_path / "tiny" / "data" / "practice")
    model = dataclasses.replace(trained.cfg.model, weights=str(weights))
    with pytest.raises(ValueError, match=r"point_map\.encoder 'named'"):
        dataclasses.replace(trained.cfg, model=model)
    model = dataclasses.replace(model, places=False, point_map=dataclasses.replace(model.point_map, encoder="sim"))
    given = dataclasses.replace(trained.cfg, output=str(tmp_path), model=model)
    pipeline = Pipeline(STAGES, given, collect, "", None, Lessons())
    done = {stage: pipeline.run(stage) for stage in pipeline.stages}
    assert all(set(done[name] or ()) == {"seconds"} for name in ("words", "practice", "base"))
    assert (done["alignment"] or {})["turns"] > 0
    made, motion = load_model(pipeline.paths.model("selu")), MotionTokenizer.load(pipeline.paths.model("tokenizer"))
    turns = turns_of(pipeline, made, lessons_of(pipeline, made.cfg), motion)
    example = turns.example(int(turns.train[0]))
    assert example.tokens is not None
    text = made.processor.tokenizer.decode(example.tokens.ids)
    assert re.search(r"\nNow: left empty right empty .*<\|image_pad\|>.*<motion_end>\nDo: \w+ [\w ]+\nDo: \w+", text)

    assert lesson_folders(pipeline) == [pipeline.paths.shards("lessons")]
    student = dataclasses.replace(given.practice, student=str(pipeline.paths.model("selu")))
    acted = Pipeline(STAGES, dataclasses.replace(given, practice=student), collect, "", correct, Lessons())
    assert (acted.run("practice") or {})["own_as_teacher"] == 0.5
    assert not acted.paths.model("practice").exists()  # it acts, and learns in the next alignment
    assert lesson_folders(acted) == [acted.paths.shards("lessons"), acted.paths.shards("practice")]
    assert not acted.is_current("alignment")


def test_hindsight_names_the_sub_goal(trained: Pipeline) -> None:
    model, tokens = load_model(trained.paths.model("selu")), MotionTokenizer.load(trained.paths.model("tokenizer"))
    rollout = read_rollouts(trained.paths.stage("selu") / "round_0" / "rollouts")[0]
    motion = tuple(tokens.encode_window(window) for window in rollout.motions)
    examples = actor_examples(model, [Kept(Trajectory(rollout, motion), "Put the cup on the table.", rollout.length, True)])
    words, texts = WordTokens(model.processor.tokenizer), list[str]()
    names = {token: word for word, token in words.known.items()}
    for example in examples:
        assert example.tokens is not None
        pairs = zip(example.tokens.ids, example.tokens.targets, strict=True)
        texts.append(" ".join(names[token] for token, target in pairs if target))
    assert texts == [
        "Pick mug _1 do GoTo mug _1 .",
        "Pick mug _1 do Pick left mug _1 .",
        "Place coffee table _1 do Place left coffee table _1 .",
    ]
