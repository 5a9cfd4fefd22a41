"""What the benchmark is made of: how many tasks of each family, and in which rooms.

Totals per category are the paper's (60 single-arm, 166 dual-arm optional, 133 dual-arm essential); the families are ours. A
family with a count of 0 was searched in vain: X1 reaches no tap and no microwave with what it holds. It keeps its place,
because the seeds of those after it follow from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_KITCHENS: Final = ("kitchen_1", "kitchen_2", "kitchen_3")
_LIVING: Final = ("living_room_1", "living_room_2", "living_room_3")
_BEDROOMS: Final = ("bedroom_1", "bedroom_2")
_BATHROOMS: Final = ("bathroom_1", "bathroom_2")
_ALL: Final = (*_KITCHENS, *_LIVING, *_BEDROOMS, *_BATHROOMS)
_DRY: Final = (*_KITCHENS, *_LIVING, *_BEDROOMS)
#: Rooms in which the shorter robot gets things from one place to another; the first bathroom is too narrow for it.
_SPACIOUS: Final = (*_DRY, "bathroom_2")

#: Rooms with a drawer that both arms of both robots put things into, and the other dry ones.
_WITH_EASY_DRAWERS: Final = (*_KITCHENS, "living_room_1")
_OTHERS: Final = tuple(room for room in _DRY if room not in _WITH_EASY_DRAWERS)


@dataclass(frozen=True, slots=True)
class Share:
    """A family's part of the benchmark.

    Attributes:
        family: a name of `sim.tasks.families.FAMILIES`.
        count: how many tasks.
        rooms: where, dealt out in turn; those after the first `count` stand in for rooms that cannot give their share.
        spare: further rooms that stand in when all of those are exhausted.
    """

    family: str
    count: int
    rooms: tuple[str, ...]
    spare: tuple[str, ...] = ()


COMPOSITION: Final = (
    # 60 single-arm tasks: pick 14, place 14, open and close 12, toggle 12, and one action on food, dishes or supplies 8
    Share("pick", 14, _ALL),
    Share("place", 10, _ALL),
    Share("place_any", 4, (*_LIVING, "kitchen_2", *_BEDROOMS)),
    Share("open", 6, (*_LIVING, *_BEDROOMS, "bathroom_2", *_KITCHENS)),
    Share("close", 6, (*_KITCHENS, *_BEDROOMS, "bathroom_1", *_LIVING)),
    Share("toggle_on", 6, (*_KITCHENS, *_LIVING, *_BEDROOMS)),
    Share("toggle_off", 6, (*_KITCHENS, "living_room_2", "bedroom_2", "bathroom_1")),
    Share("fill", 0, ("kitchen_2", "kitchen_1", "kitchen_3", *_BATHROOMS)),
    Share("slice", 3, ("kitchen_2", "kitchen_3", "kitchen_1")),
    Share("clean", 3, ("kitchen_3", "kitchen_2", "kitchen_1")),
    Share("cook", 0, ("kitchen_2", "kitchen_3", "kitchen_1")),
    Share("use_up", 2, ("bathroom_1", "bedroom_1", "kitchen_1")),
    # 166 optional: two objects 60, two actions at once 36, through an opened receptacle 40, three objects 30
    Share("transport_two", 30, _SPACIOUS),
    Share("transport_any_two", 10, _DRY),
    Share("transport_each", 20, _SPACIOUS),
    Share("pick_and_toggle_on", 16, (*_KITCHENS, *_BEDROOMS)),
    Share("pick_and_toggle_off", 18, (*_KITCHENS, *_BEDROOMS)),
    Share("toggle_both", 2, _KITCHENS),
    Share("fetch_two", 14, _DRY),
    Share("stow_two", 14, _WITH_EASY_DRAWERS, _OTHERS),
    Share("stow_two_close", 12, _WITH_EASY_DRAWERS, _OTHERS),
    Share("set_three", 6, _DRY),
    Share("tidy_three", 24, _DRY),
    # 133 essential: lift and carry 40, hold open while storing or taking out 45, hold while acting 28, carry level 20
    Share("lift", 16, _DRY),
    Share("carry", 24, _DRY),
    Share("store_ajar", 25, _DRY),
    Share("fetch_ajar", 20, _DRY),
    Share("slice_steady", 16, _KITCHENS),
    Share("clean_steady", 12, _KITCHENS),
    Share("carry_level", 20, _KITCHENS),
)
