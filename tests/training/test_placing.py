"""Answers that say where their thing is."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from torch.nn import functional

from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.building import load_model
from proprio_mllm.model.named_map import NamedPointMap
from proprio_mllm.model.placing import Placing, finder_of, stands_alone
from proprio_mllm.model.point_map import GeoFeatures, Named
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import PLACE_SCALES, PLACES, WordEpisode, Words, WordTurn, id_words, place_words
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.placing import behind_places, placed, thing_of
from proprio_mllm.training.sources import Views
from proprio_mllm.training.stages.alignment import start
from proprio_mllm.training.stages.inputs import episodes_in_words, lessons_of, point_map_of, turns_of


class Finder(NamedPointMap):
    """Sees one thing, in one cell, 1 m ahead of the camera."""

    def __init__(self, row: torch.Tensor) -> None:
        super().__init__(32, 1, len(row), 32)
        self.row = functional.normalize(row, dim=0)
        torch.nn.init.constant_(self.scale, 6.0)

    def forward(self, rgb, points_m=None, stance=None) -> GeoFeatures:
        keys = -self.row.expand(len(rgb), 2, 2, -1).clone()
        keys[:, 1, 0] *= -1.0
        centres = torch.full((len(rgb), 2, 2, 3), 9.0)
        centres[:, 1, 0] = torch.tensor([0.0, 0.0, 1.0])
        ones = torch.ones(len(rgb), 2, 2)
        return GeoFeatures(None, centres, ones, Named(keys, centres, ones))


@pytest.mark.parametrize(
    ("answer", "thing"),
    [
        ("Pick mug _1 do MoveDown 0.10 .", "mug _1"),
        ("body so height Pick mug _1 do MoveDown 0.10 .", "mug _1"),
        ("Pick unseen do GoTo fridge _1 .", ""),
        ("Release do Release left .", ""),
    ],
)
def test_what_an_answer_is_about(answer: str, thing: str) -> None:
    assert " ".join(thing_of(tuple(answer.split()))) == thing


@pytest.mark.parametrize(
    ("visible", "expected"), [("Mug_1 Pan_1", True), ("Mug_1 Mug_2", False), ("Mug_2", False), ("Pan_1", False)]
)
def test_what_stands_alone_of_its_name(visible: str, expected: bool) -> None:
    assert stands_alone(("mug", "_1"), visible.split()) is expected


def test_only_what_is_seen_alone_has_a_place(trained: Pipeline) -> None:
    model = load_model(trained.paths.model("base"))
    demos, words = lessons_of(trained, model.cfg), tokens_of(model.processor.tokenizer)
    row, visible = next((i, one) for i, one in enumerate(demos.reader.column("visible")) if one)
    thing = id_words(visible[0])
    which = max(i for i, start in enumerate(demos.starts) if start <= row)
    nothing = WordTurn((), (), ())

    def answers(*asked: Words) -> list[WordEpisode]:
        """An episode for every one of the demonstrations; the row's answers are about these."""
        turns = [nothing] * (row - demos.starts[which]) + [WordTurn((), ("Pick", *one, "do", "Done"), ()) for one in asked]
        return [WordEpisode((), tuple(turns) if number == which else ()) for number in range(len(demos.starts))]

    finder = Finder(model.table.detach()[words.tokens(thing[:-1])].mean(0))
    view = demos.view(demos.reader[row])
    ahead = view.camera.camera_in_pelvis @ np.array([0.0, 0.0, 1.0, 1.0])
    place = place_words(ahead[:3], view.key_bodies)
    assert placed(answers(thing), demos, Placing(model, finder))[which].turns[-1].answer == (
        "Pick",
        *thing,
        *place,
        "do",
        "Done",
    )
    numb = dataclasses.replace(view, key_bodies=np.zeros_like(view.key_bodies))
    assert Placing(model, finder)([view, numb], [thing, thing]) == [place, ()], "from a hidden body nothing can be placed"
    other = answers((*thing[:-1], "_16"))
    assert placed(other, demos, Placing(model, finder)) == other
    torch.nn.init.constant_(finder.scale, -9.0)  # nothing looks like anything
    assert placed(answers(thing), demos, Placing(model, finder)) == answers(thing)


def test_behind_a_place_only_the_step_is_learnt() -> None:
    place = place_words(np.array([0.5, 0.1, 0.2]), np.zeros((14, 3)) + np.eye(14, 3))
    here, there = WordTurn(("now",), ("Pick", "mug", "_1", *place, "do", "MoveDown", "."), ("log",)), WordTurn((), ("x",), ())
    first, second = behind_places(WordEpisode(("H1",), (here, there))).turns
    assert first == WordTurn(("now", "Pick", "mug", "_1", *place), ("do", "MoveDown", "."), ("log",))
    assert second == there


def test_models_that_say_places_learn_the_simulators_steps_behind_them(trained: Pipeline) -> None:
    model = load_model(trained.paths.model("base"))
    turns = turns_of(trained, model, lessons_of(trained, model.cfg))
    place = place_words(np.array([0.5, 0.1, 0.2]), np.zeros((14, 3)) + np.eye(14, 3))
    turns.episodes = [WordEpisode(("H1",), (WordTurn(("now",), ("Pick", "mug", "_1", *place, "do", "Done", "."), ()),))]
    do, found = tokens_of(model.processor.tokenizer).tokens(["do"])[0], []
    for places in (False, True):
        model.cfg = dataclasses.replace(model.cfg, places=places)
        parts = episodes_in_words(trained, model, "key", turns).batch(np.random.default_rng(0), 40)
        firsts = [part.labels[:, 1:][(part.labels[:, 1:] >= 0) & (part.labels[:, :-1] < 0)] for part in parts]
        found.append(any(do in first for first in firsts))
    assert found == [False, True]


def test_answers_say_where_their_thing_is(trained: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proprio_mllm.model.placing._FOUND", -1e9)
    model = load_model(trained.paths.model("base"))
    model.cfg = dataclasses.replace(model.cfg, places=True)
    demos, words = lessons_of(trained, model.cfg), tokens_of(model.processor.tokenizer)
    said, plain = turns_of(trained, model, demos), Lessons().told(trained.paths.shards("lessons"))
    answers = {
        number: turn.answer for number, turn in enumerate(turn for episode in plain for turn in episode.turns) if turn.answer
    }
    at, changed = words.tokens(["at"])[0], 0
    for row in (*said.train, *said.test):
        if row not in answers:
            continue
        told = said.example(int(row)).tokens
        learnt = [token for token, by in zip(told.ids, told.targets, strict=True) if by]
        do = len(answers[row][: answers[row].index("do")])
        if at in learnt:
            changed += 1
            assert learnt[:do] + learnt[do + len(PLACES) :] == words.tokens(answers[row])
            assert learnt[do] == at
        else:
            assert learnt == words.tokens(answers[row])
    assert changed > 0


def test_a_model_that_is_told_places_does_not_learn_to_say_them(trained: Pipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proprio_mllm.model.placing._FOUND", -1e9)
    model = start(trained)
    model.cfg = dataclasses.replace(model.cfg, places=True)
    demos, words = lessons_of(trained, model.cfg), tokens_of(model.processor.tokenizer)
    assert finder_of(model) is model.point_map
    turns = turns_of(trained, model, demos)
    scales = {words.tokens([word])[0] for scale in PLACE_SCALES for word in scale}
    row = next(int(row) for row in turns.train if scales & set(turns.example(int(row)).tokens.ids))
    told = turns.example(row).tokens
    learnt = [token for token, by in zip(told.ids, told.targets, strict=True) if by]
    do, at = (words.tokens([word])[0] for word in ("do", "at"))
    assert not scales & set(learnt) and at not in learnt
    assert do in learnt and learnt.index(do) > 0  # the goal before it is, and the step behind it
    model.cse = model.point_map = None  # as `no_cse`
    said = turns_of(trained, model, demos).example(row).tokens
    assert sum(said.targets) == len(learnt) + len(PLACES) and said.ids == told.ids


def test_places_need_a_point_map_that_knows_names(trained: Pipeline) -> None:
    sim = dataclasses.replace(trained.cfg.model.point_map, encoder="sim")
    with pytest.raises(ValueError, match=r"model\.places is learnt from .* not 'sim'"):
        dataclasses.replace(trained.cfg, model=dataclasses.replace(trained.cfg.model, places=True, point_map=sim))


def test_views_are_asked_for_places_too(trained: Pipeline) -> None:
    views = Views(trained.paths.shards("views"), dataclasses.replace(trained.cfg.model, places=True))
    row = next(one for one in map(views.row, views.split.train) if any(int(thing["pixels"]) >= 6 for thing in one.objects))
    asked = views.asked(row, ("place",), 1, np.random.default_rng(0))[0]
    words = place_words(np.asarray(asked.thing["center_in_pelvis"]), row.view.key_bodies)
    assert asked.question == f"at {asked.name}" and asked.answer.split() == list(words[1:])
    assert json.dumps(asked.answer)[1] == " "  # its first word is the token of episodes


def test_the_point_map_that_finds_them_is_the_trained_one(trained: Pipeline) -> None:
    one, other = (point_map_of(trained, trained.cfg.model) for _ in range(2))
    fresh = type(one)(32, 1, trained.cfg.model.text.hidden, trained.cfg.model.image_size)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(one.parameters(), fresh.parameters(), strict=True))
