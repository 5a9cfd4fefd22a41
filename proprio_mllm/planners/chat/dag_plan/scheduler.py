"""Which ready node each arm does next.

The cost of the original is not published; this one is ours. Nodes whose predecessors are done form the candidate set. A node
is feasible when a hand is as it needs it: free, or holding its item, so the arm that occupies a thing also owns its tool-use
and release, and what takes two arms waits for both. Among the feasible (node, arm) pairs, alone or two of them at once, the
lowest price per node wins, where the price of a step is

    1 + walk + reach penalties,   walk in steps: 0 there, 1 elsewhere, 2 nobody knows where; elsewhere
                                  1/2 less at the same piece of furniture, 1/8 more to take and 1/4 to put something down,

a penalty is one per earlier failure of this arm at this object, and 1/2 for a second node whose object is only in view. Ties
go to the shorter walk, then to the lower index, then to the right arm. What would leave the rest of the graph undoable (both
hands full, a drawer still to be opened) is not chosen. All prices are multiples of 1/16, so ties are exact.

Paper: DAG-Plan, candidate set, feasibility, cost, parallel execution. A planner here sees no positions: where things are is
what graph, own walks and own putting down say.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from interface.bodies import Arm
from proprio_mllm.planners.chat.dag_plan.graph import Graph, Node
from proprio_mllm.planners.chat.dag_plan.hands import ARMS, BLOCKED, EMPTY, Capacity, Hands, after, arms_for

_SHORT: Final = 0.5
#: What needs an empty hand comes before what fills one, and hands are filled before a walk to put down.
_TURN: Final = {"occupy": 0.125, "release": 0.25}
_ONLY_SEEN: Final = 0.5


@dataclass(frozen=True, slots=True)
class Situation:
    """What the planner believes, as far as scheduling needs it.

    Attributes:
        settled: nodes that are done or given up.
        hands: what the right and the left hand hold.
        here: what the robot walked to last, None when it stands nowhere in particular.
        known: ids that have been seen.
        visible: ids in view.
        at: furniture that things are on or in.
        penalties: failures of reach by arm and object.
        walked_only: nodes that failed from where another thing was reached, and need a walk of their own.
        alone: nodes that exclude another one when both arms act at once.
    """

    settled: frozenset[str] = frozenset()
    hands: Hands = EMPTY
    here: str | None = None
    known: frozenset[str] = frozenset()
    visible: frozenset[str] = frozenset()
    at: Mapping[str, str] = field(default_factory=dict)
    penalties: Mapping[tuple[Arm, str], int] = field(default_factory=dict)
    walked_only: frozenset[str] = frozenset()
    alone: frozenset[str] = frozenset()

    def place(self, name: str | None) -> str | None:
        """The furniture that something is at, or the thing itself."""
        return None if name is None else self.at.get(name, name)

    def reached(self, node: Node) -> bool:
        """Whether a node is tried from here: the robot stands at its object, or at the furniture with the object in view."""
        target = node.target
        if target is None or target == self.here or target in self.hands or node.verb == "GoTo":
            return True
        return node.id not in self.walked_only and target in self.visible and self.beside(target)

    def beside(self, target: str) -> bool:
        """Whether the robot stands at the furniture that something is at."""
        return self.here is not None and self.place(target) == self.place(self.here)


@dataclass(frozen=True, slots=True)
class Job:
    """A node and the arm that does it, None for both arms or the body."""

    node: Node
    arm: Arm | None


@dataclass(frozen=True, slots=True, order=True)
class _Price:
    """Orders choices: price per node, walk, index, index of the second node, arm."""

    per_node: float
    walk: float
    index: int
    second: int
    arm: int


class Scheduler:
    """Chooses steps of one graph.

    Args:
        graph: checked.
        anchored: things that hands held in place when it was made.
        parallel: whether both arms may act in one step; otherwise one node at a time, with one arm alone where one suffices.
    """

    def __init__(self, graph: Graph, anchored: frozenset[str] = frozenset(), parallel: bool = True) -> None:
        self._graph, self._parallel = graph, parallel
        self._capacity = Capacity(graph, anchored)
        self._index = {node.id: index for index, node in enumerate(graph.nodes)}

    def choose(self, now: Situation) -> tuple[Job, ...]:
        """The jobs of the next step: one, or two for different arms; none when nothing more can be done."""
        hands = self._usable(now)
        careful = self._capacity.finishable(now.settled, hands)
        for _, jobs in sorted(self._priced(now, hands), key=lambda pair: pair[0]):
            if not careful or self._leaves_a_way(now.settled, hands, jobs):
                return jobs
        return ()

    def _priced(self, now: Situation, hands: Hands) -> Iterator[tuple[_Price, tuple[Job, ...]]]:
        """What the hands allow, with its price."""
        ready = [node for node in self._capacity.ready(now.settled) if self._capacity.beside(node, hands)]
        jobs = [Job(node, arm) for node in ready for arm in arms_for(node, hands)]
        for job in jobs:
            walk = self._walk(job.node, now, hands)
            index, arm = self._index[job.node.id], ARMS.index(job.arm) if job.arm else 0
            step = 1.0 + walk + self._penalty(job, now)
            yield _Price(step, walk, index, len(self._index), arm), (job,)
            partner = job.arm.other if self._parallel and job.arm is not None else None
            for other in jobs if partner is not None else ():
                if other.arm is not partner or not self._together(job.node, other.node, now, walk):
                    continue
                extra = 0.0 if self._same_place(job.node, other.node, now) else _ONLY_SEEN
                step_of_two = step + extra + self._penalty(other, now)
                yield _Price(step_of_two / 2, walk, index, self._index[other.node.id], arm), (job, other)

    def _usable(self, now: Situation) -> Hands:
        """The hands, without the left one when nodes go one by one and the right arm alone can do the rest."""
        right, left = now.hands
        if self._parallel or left is not None:
            return now.hands
        return (right, BLOCKED) if self._capacity.finishable(now.settled, (right, BLOCKED)) else now.hands

    def _leaves_a_way(self, settled: frozenset[str], hands: Hands, jobs: tuple[Job, ...]) -> bool:
        for job in jobs:
            hands = after(job.node, job.arm, hands)
        return self._capacity.finishable(settled.union(job.node.id for job in jobs), hands)

    def _walk(self, node: Node, now: Situation, hands: Hands) -> float:
        target = node.target
        if target is None or self._capacity.holds_still(hands):
            return 0.0
        if target not in now.known and target not in hands and target not in now.at:
            return 2.0
        if node.verb == "GoTo":
            return 0.0 if target == now.here else 1.0
        if now.reached(node):
            return 0.0
        return 1.0 - (_SHORT if now.beside(target) else 0.0) + _TURN.get(node.kind, 0.0)

    @staticmethod
    def _penalty(job: Job, now: Situation) -> int:
        return 0 if job.arm is None or job.node.target is None else now.penalties.get((job.arm, job.node.target), 0)

    def _together(self, node: Node, other: Node, now: Situation, walk: float) -> bool:
        """Whether another node can be tried from where the first one is done, at the same time."""
        if node.id == other.id or not {node.target, other.target} <= now.known | {None} or {node.id, other.id} & now.alone:
            return False
        if node.target is not None and node.target == other.target:
            return node.verb == other.verb == "Place"
        near = self._same_place(node, other, now) or (walk == 0.0 and other.target in now.visible)
        return near and other.id not in now.walked_only

    @staticmethod
    def _same_place(node: Node, other: Node, now: Situation) -> bool:
        if other.target is None or other.target in now.hands:
            return True
        return now.place(node.target) == now.place(other.target)
