"""Task families on a small invented room: legal carriers, goals not met by the draft itself, seeded draws, refusals."""

import numpy as np
import pytest

from sim.tasks.drafts import NoDraft, Scene
from sim.tasks.families import CATEGORIES, FAMILIES, draw, family_of

SURFACES = ("CounterTop_1", "DiningTable_1", "SideTable_1", "CounterTop_2")
CONTAINERS = ("Fridge_1", "Drawer_1", "Microwave_1")
SCENE = Scene(
    room="test_room",
    furniture=(*SURFACES, *CONTAINERS, "Faucet_1", "SinkBasin_1", "Toilet_1", "StoveKnob_1", "StoveKnob_2"),
    surfaces=SURFACES,
    targets=SURFACES,
    containers=CONTAINERS,
    switches=("Faucet_1", "StoveKnob_1", "StoveKnob_2"),
    small=dict.fromkeys(
        ("Mug", "Apple", "Bowl", "Bottle", "Egg", "Bread", "Potato", "Knife", "DishSponge", "TissueBox", "Book", "DeskLamp"),
        (*SURFACES, *CONTAINERS),
    ),
    big={"Box": ("DiningTable_1", "SideTable_1"), "Pot": ("DiningTable_1", "CounterTop_1")},
    lids=("Toilet_1",),
    basins={"Faucet_1": "SinkBasin_1"},
    heaters={"Microwave_1": "Microwave_1"},
    near={"Faucet_1": ("CounterTop_1",), "Microwave_1": ("CounterTop_2",), "StoveKnob_1": ("StoveKnob_2",)},
    roomy=SURFACES,
)


@pytest.mark.parametrize("family", FAMILIES)
def test_drafts_are_legal_and_seeded(family):
    for seed in range(20):
        draft = draw(family, SCENE, np.random.default_rng(seed))
        again = draw(family, SCENE, np.random.default_rng(seed))
        assert draft == again
        for object_id, carrier in draft.objects.items():
            fits = (SCENE.small | SCENE.big)[object_id.rsplit("_", 1)[0]]
            assert carrier in fits
        everything = set(draft.objects) | set(SCENE.furniture)
        for goal in draft.goals:
            assert set(goal.involved(everything)) <= everything
            if goal.kind in ("on", "in"):
                assert draft.objects[goal.object_id] != goal.receptacle_id
        assert set(draft.focus.values()) <= everything
        assert set(draft.beside) <= set(draft.objects)
        assert set(draft.beside.values()) <= everything


@pytest.mark.parametrize("family", FAMILIES)
def test_sentences_name_where_hidden_objects_are(family):
    draft = draw(family, SCENE, np.random.default_rng(1), distractors=(0, 0))
    sentences = draft.sentences(SCENE.furniture, np.random.default_rng(0), hidden=tuple(draft.objects))
    assert len(set(sentences)) == len(sentences) >= 4
    named = set(draft.focus.values())
    hidden = [object_id for object_id in named & set(draft.objects) if draft.objects[object_id] not in named]
    assert all((" from " in sentence) for sentence in sentences) or not hidden


def test_types_that_are_left_out_do_not_occur():
    for seed in range(20):
        draft = draw("transport_two", SCENE, np.random.default_rng(seed), without=("Mug", "Apple"))
        assert not {name.rsplit("_", 1)[0] for name in draft.objects} & {"Mug", "Apple"}


def test_categories():
    assert {family.category for family in FAMILIES.values()} == set(CATEGORIES)
    assert family_of("stow_close").category == "optional"
    with pytest.raises(KeyError, match="juggle"):
        family_of("juggle")


def test_a_room_without_switches_cannot_offer_toggling():
    bare = Scene("bare", ("SideTable_1",), ("SideTable_1",), ("SideTable_1",), (), (), {"Mug": ("SideTable_1",)}, {})
    with pytest.raises(NoDraft, match="bare has no switch"):
        draw("toggle_on", bare, np.random.default_rng(0))
    with pytest.raises(NoDraft, match="lift"):
        draw("lift", bare, np.random.default_rng(0))
    with pytest.raises(NoDraft, match="pair of switches for toggle_both"):
        draw("toggle_both", bare, np.random.default_rng(0))
