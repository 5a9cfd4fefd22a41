"""What two hands can do: which arm a node may use, what the hands hold after it, and whether all nodes can still be done.

Paper: DAG-Plan's feasibility checks, as far as they concern the hands; positions are unknown here. The look ahead is ours: a
graph may ask for a free hand later (a drawer to open), and filling both hands before that would end it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from interface.bodies import Arm
from proprio_mllm.planners.chat.dag_plan.graph import Graph, Node

#: What the right and the left hand hold; an object in both is held by both together.
Hands = tuple[str | None, str | None]

EMPTY: Final[Hands] = (None, None)
#: The arms in the order of `Hands`; the first one is taken where nothing else decides.
ARMS: Final = (Arm.RIGHT, Arm.LEFT)
#: Stands in a hand that shall not be used.
BLOCKED: Final = "-"
#: Most states that one look ahead visits; beyond that it trusts the graph.
_STATES: Final = 5000


def held_by(hands: Hands, item: str | None) -> tuple[Arm, ...]:
    """The arms that hold something."""
    return tuple(arm for arm, held in zip(ARMS, hands, strict=True) if held == item)


def arms_for(node: Node, hands: Hands) -> tuple[Arm | None, ...]:
    """The arms that may do a node now: the one that holds its item, or any free one; None for both arms or the body.

    Returns:
        Nothing when the hands do not allow it.
    """
    if node.kind in ("release", "tool-use"):
        owners = held_by(hands, node.item)
        if len(owners) != node.arms:
            return ()
        return owners if node.arms == 1 else (None,)
    free = held_by(hands, None)
    if node.arms == 2:
        return (None,) if len(free) == 2 else ()
    if node.arms == 1:
        return free or (ARMS if node.verb == "ResetArm" else ())
    return (None,)


def after(node: Node, arm: Arm | None, hands: Hands) -> Hands:
    """What the hands hold after a node that `arms_for` allows."""
    if node.kind == "occupy":
        now = node.item
    elif node.kind == "release":
        now = None
    else:
        return hands
    right, left = (now if arm in (None, side) else held for side, held in zip(ARMS, hands, strict=True))
    return right, left


class Capacity:
    """Looks ahead in one graph.

    Args:
        graph: with checked nodes.
        anchored: things that hands held in place when the graph was made.
    """

    def __init__(self, graph: Graph, anchored: frozenset[str] = frozenset()) -> None:
        self._graph = graph
        self._nodes = [node for node in graph.nodes if node.kind != "complete"]
        self._all = frozenset(node.id for node in self._nodes)
        self._occupiers: dict[str, list[str]] = {item: [] for item in anchored}
        for node in self._nodes:
            if node.anchors and node.item is not None:
                self._occupiers.setdefault(node.item, []).append(node.id)
        self._known: dict[tuple[frozenset[str], frozenset[str | None]], bool] = {}

    def holds_still(self, hands: Hands) -> tuple[str, ...]:
        """Things in the hands that keep the robot where it stands."""
        return tuple(item for item in hands if item is not None and item in self._occupiers)

    def beside(self, node: Node, hands: Hands) -> bool:
        """Whether a node can be done without walking away from what the hands hold in place."""
        if node.arms == 0 and self.holds_still(hands):
            return False
        return all(self._beside(node, item) for item in self.holds_still(hands))

    def _beside(self, node: Node, item: str) -> bool:
        if item in (node.item, node.target, node.at) or node.target is None:
            return True
        return any(one in self._graph.ancestors[node.id] for one in self._occupiers[item])

    def ready(self, settled: frozenset[str]) -> Iterator[Node]:
        """Nodes that wait for nothing any more, in order; the end of the task is none of them."""
        return (n for n in self._nodes if n.id not in settled and settled.issuperset(n.after))

    def finishable(self, settled: frozenset[str], hands: Hands) -> bool:
        """Whether some order does all other nodes.

        Args:
            settled: nodes that are done or given up, with what depends on the latter.
            hands: what they hold.
        """
        return self._search(settled, hands, [_STATES])

    def _search(self, settled: frozenset[str], hands: Hands, left: list[int]) -> bool:
        settled, hands = self._without_taking(settled, hands)
        if self._all <= settled:
            return True
        key = (settled, frozenset(hands))
        if key in self._known:
            return self._known[key]
        left[0] -= 1
        if left[0] < 0:
            return True
        self._known[key] = any(
            self._search(settled | {node.id}, after(node, arms[0], hands), left)
            for node in self.ready(settled)
            if (arms := arms_for(node, hands) if self.beside(node, hands) else ())
        )
        return self._known[key]

    def _without_taking(self, settled: frozenset[str], hands: Hands) -> tuple[frozenset[str], Hands]:
        """Does all that fills no hand: it never makes anything else impossible."""
        moved = True
        while moved:
            moved = False
            for node in list(self.ready(settled)):
                arms = arms_for(node, hands) if node.kind != "occupy" and self.beside(node, hands) else ()
                if arms:
                    settled, hands, moved = settled | {node.id}, after(node, arms[0], hands), True
        return settled, hands
