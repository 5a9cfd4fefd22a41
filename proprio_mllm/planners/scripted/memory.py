"""What has been seen when, which id a phrase means, and where to look for what has not been seen.

Paper: not in it; part of a reference planner of this project.
"""

from __future__ import annotations

from typing import Final

from interface.belief import Belief
from interface.effects import Condition
from interface.failures import FailureCode
from interface.sightings import Sightings
from interface.steps import Action
from proprio_mllm.planners.furniture import CONTAINERS, SEATS, SURFACES
from proprio_mllm.planners.scripted.words import Mention, candidates, type_of

#: How to look around at a place: names and amounts.
_LOOKS: Final = (("RotateLeft", 45.0), ("RotateRight", 90.0), ("MoveBack", 0.3), ("RotateLeft", 45.0), ("MoveUp", 0.2))

#: How often a walk that was blocked is taken again.
_PATIENCE: Final = 4


class Memory:
    """What an episode has shown.

    Attributes:
        seen: what has been seen when, and the newest belief.
    """

    def __init__(self) -> None:
        self.seen = Sightings()
        self._meant: dict[tuple[Mention, int], str] = {}
        self._tried: Action | None = None
        self._blocked_before = self._blocked_then = 0
        self._ways: dict[Mention, list[Action]] = {}

    @property
    def belief(self) -> Belief:
        """What the log says."""
        return self.seen.belief

    def find(self, mention: Mention, index: int = 0) -> str | None:
        """The id that a phrase means, None when nothing that fits has been seen; once chosen it stays."""
        key = (mention, index)
        if self._meant.get(key) in self.belief.broken:
            del self._meant[key]
        if key not in self._meant:
            taken = {name for (other, _), name in self._meant.items() if other == mention}
            fitting = [name for name in candidates(mention, self.seen.known) if name not in taken | self.belief.broken]
            if mention.place is not None and fitting:
                fitting = self._at_place(fitting, mention)
            fitting.sort(key=lambda name: name not in self.seen.visible)
            if not fitting:
                return None
            self._meant[key] = fitting[0]
        return self._meant[key]

    def _at_place(self, fitting: list[str], mention: Mention) -> list[str]:
        """Of several things of a name those that came into view, or are in view, at the place where one is said to be.

        Before the robot was there, the only one that is known is taken for it while both it and the place are in view.
        """
        assert mention.place is not None
        place = self.find(mention.place)
        if place is None or place not in self.belief.visited:
            alone = len(fitting) == 1 and type_of(fitting[0]) == mention.name and {fitting[0], place} <= set(self.seen.visible)
            return fitting if place is None or alone else []
        found = [name for name in fitting if self.seen.found_at.get(name) == place]
        return found or [name for name in fitting if name in self.seen.visible]

    def is_near(self, target: str, place: str | None) -> bool:
        """Whether the robot went to a thing, or to what it stands on, last."""
        here = self.belief.state.here
        if here is None:
            return False
        where = self.belief.state.at.get(target, place if place is not None else self.seen.found_at.get(target))
        return here == target or (here == where and here in self.belief.visited and target in self.seen.visible)

    def search(self, mention: Mention | None) -> Action:
        """The next step of looking for something: to the place that was named, then from furniture to furniture."""
        if mention is None:
            return Action("Done")
        if mention not in self._ways:
            self._ways[mention] = self._round(mention)
        ways = self._ways[mention]
        if self._tried is not None:
            blocked = len(self._blocked(self._tried))
            patience = _PATIENCE if self._tried.name == "GoTo" else 1
            if self._blocked_then < blocked <= self._blocked_before + patience:
                self._blocked_then = blocked
                return self._tried
        while ways:
            action = self._tried = ways.pop(0)
            if action.name != "Open" or (
                action.object_id and self.belief.state.is_in(Condition.OPEN, action.object_id) is not True
            ):
                self._blocked_before = self._blocked_then = len(self._blocked(action))
                return action
        return Action("Done")

    def _blocked(self, action: Action) -> list[str]:
        events = self.belief.failures(action.name, action.object_id)
        return [event.code for event in events if event.code == FailureCode.BLOCKED_PATH]

    def _round(self, mention: Mention) -> list[Action]:
        named = None if mention.place is None else self.find(mention.place)
        order: list[str] = [] if named is None else [named]
        for group in (SURFACES, SEATS, CONTAINERS):
            order += [name for name in self.seen.known if type_of(name) in group and name != named]
        steps = [] if named is not None else [Action("MoveUp", amount=0.2), *[Action("RotateLeft", amount=90.0)] * 3]
        for name in order:
            steps.append(Action("GoTo", object_id=name))
            free = self.belief.state.free_arms()
            if type_of(name) in CONTAINERS and free:
                steps.append(Action("Open", arm=free[0], object_id=name))
            looks = _LOOKS if name == named else _LOOKS[:2]
            steps += [Action(verb, amount=amount) for verb, amount in looks]
        return steps
