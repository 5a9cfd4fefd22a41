"""Where the executor looks for an object that has not been seen: from furniture to furniture, in a fixed order.

First where the graph says it is, then the furniture that the task names, then the rest as things usually lie; containers come
last and are opened. Furniture that was visited before is passed over. Paper: none; DAG-Plan is given the places of all objects.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final

from interface.belief import Belief
from interface.bodies import Arm
from interface.effects import Condition
from interface.steps import Action
from proprio_mllm.planners.furniture import CONTAINERS, SEATS, SURFACES
from proprio_mllm.planners.scripted.words import candidates, find_mentions, type_of

#: How the robot looks around where a thing is said to be.
_LOOKS: Final = (Action("RotateLeft", amount=45.0), Action("RotateRight", amount=90.0))


class Search:
    """The search for one object.

    Args:
        instruction: the task.
        known: ids known at its start.
        place: furniture at which it is said to be.
        visited: furniture at which the robot was before.
    """

    def __init__(self, instruction: str, known: Sequence[str], place: str | None, visited: Collection[str]) -> None:
        mentions = find_mentions(instruction, known)[1]
        spoken = [name for mention in mentions for name in candidates(mention, known)]
        usual = [name for group in (SURFACES, SEATS, CONTAINERS) for name in sorted(known) if type_of(name) in group]
        order = [name for name in dict.fromkeys([*spoken, *usual]) if name in usual and name != place and name not in visited]
        order.sort(key=lambda name: type_of(name) in CONTAINERS and name not in spoken)
        self._ways = deque(Action("GoTo", object_id=place) for place in ([place] if place in known else []))
        self._ways.extend(_LOOKS if place in known else ())
        for name in order:
            self._ways.append(Action("GoTo", object_id=name))
            if type_of(name) in CONTAINERS:
                self._ways.append(Action("Open", arm=Arm.RIGHT, object_id=name))

    def next(self, here: str | None, belief: Belief) -> Action | None:
        """The next action, None when everything has been seen.

        Args:
            here: where the robot is.
            belief: which hands are free, and what is open.
        """
        while self._ways:
            action = self._ways.popleft()
            if action.name == "Open":
                free = belief.state.free_arms()
                if not free or belief.state.is_in(Condition.OPEN, action.object_id or "") or here != action.object_id:
                    continue
                return replace(action, arm=free[0])
            if action.name != "GoTo" or action.object_id != here:
                return action
        return None
