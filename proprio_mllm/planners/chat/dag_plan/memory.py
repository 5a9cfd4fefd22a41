"""What an episode has shown, whatever graph is being carried out.

Paper: DAG-Plan reads the state of arms and objects from its environment; here it is believed from feedback codes alone.
"""

from __future__ import annotations

from collections import Counter

from interface.belief import Belief
from interface.bodies import Arm
from interface.observation import Observation
from proprio_mllm.planners.chat.dag_plan.hands import ARMS, Hands


class Memory:
    """What an episode has shown, whatever graph is carried out.

    Attributes:
        penalties: failures of reach by arm and object.
        doors: doors that a hand stayed at.
        belief: of hands and places, folded from the history.
        here: what the robot walked to last, None when the last walk failed.
        visited: everything it walked to.
    """

    def __init__(self) -> None:
        self.penalties: Counter[tuple[Arm, str]] = Counter()
        self.doors: set[str] = set()
        self.belief = Belief()
        self.here: str | None = None
        self.visited: set[str] = set()

    def look(self, observation: Observation) -> None:
        """Takes in an observation's history, at every step once."""
        self.belief = Belief.of(observation.history, sorted(self.doors))
        self.visited = self.belief.visited
        for event in self.belief.last:
            if event.action.name == "GoTo":
                self.here = event.action.object_id if event.ok else None

    @property
    def hands(self) -> Hands:
        """What the right and the left hand are believed to hold."""
        lifted = self.belief.state.lifted
        right, left = (lifted or self.belief.state.held[arm] for arm in ARMS)
        return right, left

    @property
    def anchored(self) -> frozenset[str]:
        """What hands hold in place."""
        held = {item for item in self.hands if item is not None}
        return frozenset(held & (self.belief.state.in_place | self.doors))
