"""Wording: natural names, unambiguous phrases, filled templates."""

import re
import string

import numpy as np
import pytest

from sim.tasks.instructions import TEMPLATES, natural_name, phrase, plural, preposition, shuffled, wordings

SCENE = {
    "Cabinet_1": None,
    "Cabinet_2": None,
    "SideTable_1": None,
    "Mug_1": "SideTable_1",
    "Mug_2": "Cabinet_2",
    "Fork_1": "SideTable_1",
    "Fork_2": "SideTable_1",
    "Apple_1": "SideTable_1",
}
FURNITURE = frozenset(("Cabinet_1", "Cabinet_2", "SideTable_1"))


@pytest.mark.parametrize(
    ("object_type", "name"),
    [("CoffeeTable", "coffee table"), ("TVStand", "TV stand"), ("Mug", "mug"), ("CounterTop", "counter")],
)
def test_natural_names(object_type, name):
    assert natural_name(object_type) == name


@pytest.mark.parametrize(
    ("object_id", "text"),
    [
        ("Apple_1", "the apple"),
        ("Cabinet_2", "the second cabinet"),
        ("Mug_1", "the mug from the side table"),
        ("Mug_2", "the mug from the second cabinet"),
        ("Fork_2", "the second fork"),
    ],
)
def test_phrases_mean_one_object(object_id, text):
    assert phrase(object_id, SCENE, FURNITURE) == text


def test_a_located_phrase_says_where_to_look():
    assert phrase("Apple_1", SCENE, FURNITURE, located=True) == "the apple from the side table"
    assert phrase("Cabinet_1", SCENE, FURNITURE, located=True) == "the first cabinet"
    assert phrase("Fork_1", SCENE, FURNITURE, located=True) == "the first fork from the side table"


def test_phrases_of_a_scene_differ():
    phrases = [phrase(object_id, SCENE, FURNITURE) for object_id in SCENE]
    assert len(set(phrases)) == len(phrases)


def test_unknown_objects_and_families_are_named():
    with pytest.raises(KeyError, match="Ghost_1"):
        phrase("Ghost_1", SCENE, FURNITURE)
    with pytest.raises(KeyError, match="juggle"):
        wordings("juggle", {})


def test_prepositions():
    assert preposition("Fridge_1") == "in"
    assert preposition("CoffeeTable_1") == "on"


@pytest.mark.parametrize("family", TEMPLATES)
def test_every_family_has_four_wordings_that_use_every_object(family):
    slots = {name: f"the {name}{name}" for name in ("a", "b", "c", "r", "s")}
    slots |= {"pr": "on", "ps": "in", "n": "two mugs", "on": "on"}
    used = [{name for _, name, _, _ in string.Formatter().parse(template) if name} for template in TEMPLATES[family]]
    assert len(used) >= 4
    objects = {"a", "b", "c", "n", "on"} | (set() if family == "fill" else {"r"})  # there is one tap: it need not be named
    assert all(names & objects == used[0] & objects for names in used)
    for sentence in wordings(family, slots):
        assert re.match(r"^[A-Z].*[.]$", sentence)


def test_shuffling_is_seeded():
    sentences = tuple("abcdef")
    first = shuffled(sentences, np.random.default_rng(3))
    assert first == shuffled(sentences, np.random.default_rng(3))
    assert sorted(first) == list(sentences)


@pytest.mark.parametrize(
    ("object_type", "count", "words"),
    [("Mug", 1, "a mug"), ("Apple", 1, "an apple"), ("Tomato", 2, "two tomatoes"), ("ButterKnife", 2, "two butter knives"),
     ("Box", 3, "three boxes"), ("TissueBox", 2, "two tissue boxes")],
)  # fmt: skip
def test_some_of_a_type(object_type, count, words):
    assert plural(object_type, count) == words
