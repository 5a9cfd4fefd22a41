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
from proprio_mllm.model.placing import stands_alone
from proprio_mllm.model.point_map import GeoFeatures, Named
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import PLACES, id_words, place_words
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.placing import Places, thing_of
from proprio_mllm.training.sources import Views
from proprio_mllm.training.stages.inputs import lessons_of, point_map_of, turns_of


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
    other = (*thing[:-1], "_16")
    finder = Finder(model.table.detach()[words.tokens(thing[:-1])].mean(0))
    places = Places(model, finder, demos)
    view = demos.view(demos.reader[row])
    ahead = view.camera.camera_in_pelvis @ np.array([0.0, 0.0, 1.0, 1.0])
    assert places([(row, thing), (row, other)]) == {row: place_words(ahead[:3], view.key_bodies)}
    torch.nn.init.constant_(finder.scale, -9.0)  # nothing looks like anything
    assert places([(row, thing)]) == {}


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
