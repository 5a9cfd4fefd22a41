"""Task families on a small invented room: legal carriers, goals not met by the draft itself, seeded draws, refusals."""

import numpy as np
import pytest

from sim.tasks.drafts import FAMILIES, NoDraft, Scene, category_of, draw

SCENE = Scene(
    room="test_room",
    furniture=("CounterTop_1", "DiningTable_1", "SideTable_1", "Fridge_1", "Faucet_1"),
    surfaces=("CounterTop_1", "DiningTable_1", "SideTable_1"),
    targets=("CounterTop_1", "DiningTable_1", "SideTable_1"),
    containers=("Fridge_1",),
    switches=("Faucet_1",),
    small=dict.fromkeys(
        ("Mug", "Apple", "Bowl", "Bottle", "Egg"), ("CounterTop_1", "DiningTable_1", "SideTable_1", "Fridge_1")
    ),
    big={"Box": ("DiningTable_1", "SideTable_1")},
)
ALL = [family for families in FAMILIES.values() for family in families]


@pytest.mark.parametrize("family", ALL)
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
            assert set(goal.object_ids()) <= everything
            if goal.kind in ("on", "in"):
                assert draft.objects[goal.object_id] != goal.receptacle_id
        assert set(draft.focus.values()) <= everything


@pytest.mark.parametrize("family", ALL)
def test_sentences_name_where_hidden_objects_are(family):
    draft = draw(family, SCENE, np.random.default_rng(1), distractors=(0, 0))
    sentences = draft.sentences(SCENE.furniture, np.random.default_rng(0), hidden=tuple(draft.objects))
    assert len(set(sentences)) == len(sentences) >= 4
    named = set(draft.focus.values())
    hidden = [object_id for object_id in named & set(draft.objects) if draft.objects[object_id] not in named]
    assert all((" from " in sentence) for sentence in sentences) or not hidden


def test_categories():
    assert category_of("stow_close") == "optional"
    with pytest.raises(KeyError, match="juggle"):
        category_of("juggle")


def test_a_room_without_switches_cannot_offer_toggling():
    bare = Scene("bare", ("SideTable_1",), ("SideTable_1",), ("SideTable_1",), (), (), {"Mug": ("SideTable_1",)}, {})
    with pytest.raises(NoDraft, match="bare has no switch"):
        draw("toggle_on", bare, np.random.default_rng(0))
    with pytest.raises(NoDraft, match="lift"):
        draw("lift", bare, np.random.default_rng(0))
