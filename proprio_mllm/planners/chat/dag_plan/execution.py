"""Carries a graph out: walks and searches before the nodes that need it, and keeps what became of each node.

What the graph leaves out and the executor adds is walking to a node's object and looking for one that has not been seen.
Heights of the body and special stances are the graph's own business: nodes like MoveDown(0.2) or GoTo(Mug_1, 0.5, -20). A step
or turn after a walk counts as staying there.

A node that fails is given up, and what depends on it with it; the others go on. It has failed when it was tried from its own
object: a node that was tried beside another one, or from the furniture's front, walks there first. An effect that is there
already (`AlreadyInState`, something already in the hand) is no failure. Paper: DAG-Plan carries out its graph open loop; what a
failure leads to beyond that is the planner's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from interface.failures import FailureCode
from interface.feedback import ActionOutcome, Feedback
from interface.observation import Observation
from interface.steps import Action, PlanStep
from proprio_mllm.planners.chat.dag_plan.graph import Graph, Node
from proprio_mllm.planners.chat.dag_plan.memory import Memory
from proprio_mllm.planners.chat.dag_plan.names import bindings
from proprio_mllm.planners.chat.dag_plan.scheduler import Job, Scheduler, Situation
from proprio_mllm.planners.chat.dag_plan.search import Search

_DONE: Final = PlanStep((Action("Done"),))
#: Codes of an effect that is there already.
_HOLDS: Final = (FailureCode.ALREADY_IN_STATE, FailureCode.NOT_DIRTY, FailureCode.ALREADY_HELD)
#: Codes that say that the place was wrong and nothing has been touched.
_NOT_THERE: Final = (
    FailureCode.TOO_FAR,
    FailureCode.BODY_TOO_HIGH,
    FailureCode.BODY_TOO_LOW,
    FailureCode.OBSTRUCTED,
    FailureCode.IN_USE,
)
#: Codes that count against an arm at an object.
_PENALISED: Final = (FailureCode.OBSTRUCTED, FailureCode.TOO_FAR, FailureCode.GRASP_MISSED)


@dataclass(frozen=True, slots=True)
class _Try:
    """A job under way; `final` when it fails for good if it fails now."""

    job: Job
    final: bool


class Execution:
    """Carries one graph out.

    Args:
        graph: checked.
        memory: of the episode.
        observation: that the graph was made from.
        parallel: whether both arms may act in one step.
    """

    def __init__(self, graph: Graph, memory: Memory, observation: Observation, parallel: bool = True) -> None:
        self._graph, self._memory, self._parallel = graph, memory, parallel
        self._instruction, self._before = observation.instruction, frozenset(observation.known_objects)
        self._anchored = memory.anchored
        self._scheduler = Scheduler(graph, self._anchored, parallel)
        self._done: set[str] = set()
        self._gone: set[str] = set()
        self._walked_only: set[str] = set()
        self._alone: set[str] = set()
        self._walking: Node | None = None
        self._tries: tuple[_Try, ...] = ()
        self._searches: dict[str, Search] = {}

    def hear(self, feedback: Feedback | None) -> bool:
        """Takes in what became of the last step.

        Returns:
            Whether a node failed for good.
        """
        walking, self._walking = self._walking, None
        tries, self._tries = self._tries, ()
        if feedback is None:
            return False
        if walking is not None and not feedback.success:
            self._give_up(walking)
            return True
        if any(outcome.code == FailureCode.ARM_CONFLICT for outcome in feedback.outcomes):
            self._alone |= {one.job.node.id for one in tries}
            return False
        failed = [self._judge(one, outcome) for one, outcome in zip(tries, feedback.outcomes, strict=False)]
        return any(failed)

    def _judge(self, one: _Try, outcome: ActionOutcome) -> bool:
        """Settles a node by its outcome; whether it failed for good."""
        node, code = one.job.node, outcome.code
        if outcome.success or code in _HOLDS or (node.verb, code) == ("Release", FailureCode.HAND_EMPTY):
            self._done.add(node.id)
            if outcome.success and node.anchors and node.verb == "Open" and node.target is not None:
                self._memory.doors.add(node.target)
            return False
        if code in _NOT_THERE and not one.final:
            self._walked_only.add(node.id)
            return False
        if code in _PENALISED and one.job.arm is not None and node.target is not None:
            self._memory.penalties[one.job.arm, node.target] += 1
        self._give_up(node)
        return True

    def _give_up(self, node: Node) -> None:
        self._gone |= {node.id, *self._graph.dependents(node.id)}

    def next(self, observation: Observation) -> PlanStep:
        """The next step; `Done()` when nothing is left that can be done."""
        self._learn_names(observation)
        self._let_go_of_nothing()
        now = self._situation(observation)
        jobs = self._scheduler.choose(now)
        if not jobs:
            return _DONE
        moved = None if self._memory.anchored else self._approach(jobs[0].node, now, observation)
        if moved is not None:
            return PlanStep((moved,))
        self._tries = tuple(_Try(job, self._is_final(job.node, now)) for job in jobs)
        return PlanStep(tuple(job.node.action(job.arm) for job in jobs))

    def _approach(self, node: Node, now: Situation, observation: Observation) -> Action | None:
        """The walk or look around that a node needs first; None when it is tried from here."""
        target = node.target
        if target is None or target in now.hands:
            return None
        if target not in now.known:
            if target not in self._searches:
                place = now.at.get(target)
                self._searches[target] = Search(self._instruction, observation.known_objects, place, self._memory.visited)
            return self._searches[target].next(now.here, self._memory.belief)
        if now.reached(node):
            return None
        self._walking = node
        return Action("GoTo", object_id=target)

    def _is_final(self, node: Node, now: Situation) -> bool:
        return bool(self._memory.anchored) or node.target in (None, now.here, *now.hands) or node.verb == "GoTo"

    def _situation(self, observation: Observation) -> Situation:
        memory = self._memory
        return Situation(
            settled=frozenset(self._done | self._gone),
            hands=memory.hands,
            here=memory.here,
            known=frozenset(observation.known_objects),
            visible=frozenset(observation.visible_objects),
            at={node.target: node.at for node in self._graph.nodes if node.target and node.at} | memory.belief.state.at,
            penalties=memory.penalties,
            walked_only=frozenset(self._walked_only),
            alone=frozenset(self._alone),
        )

    def _learn_names(self, observation: Observation) -> None:
        names = bindings(self._graph, self._before, observation.known_objects, self._memory.visited)
        if names:
            self._graph = self._graph.renamed(names)
            self._scheduler = Scheduler(self._graph, self._anchored, self._parallel)

    def _let_go_of_nothing(self) -> None:
        """A Release whose item no hand holds any more has nothing left to do."""
        for node in self._graph.nodes:
            waits = not self._done.issuperset(node.after) or node.id in self._done | self._gone
            if node.verb == "Release" and node.item not in self._memory.hands and not waits:
                self._done.add(node.id)

    def text(self) -> str:
        """Every node with what became of it."""
        return "; ".join(f"{node.id} {node.text()}: {self._state(node.id)}" for node in self._graph.nodes)

    def _state(self, node_id: str) -> str:
        if node_id in self._done:
            return "done"
        return "given up" if node_id in self._gone else "open"
