"""The graph of a task: what a model writes, and the same with actions read and ancestors known.

Paper: DAG-Plan, G = (V, E, T, N): sub-tasks, what waits for what, the sub-task's type, the arms it takes. The baseline's wire
format is not published in full; here a node also names the item that the hand holds, since `Place` and the tools name only
their target, and where its object is, since a planner sees no positions. Which graphs are accepted is in `checks`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from interface.actions import ActionKind
from interface.bodies import Arm
from interface.steps import Action

#: occupy: the hand is full afterwards; release: it is empty again; tool-use: it works with what it holds; operate: it is empty
#: before and after, or the body moves; complete: the task ends.
NodeKind = Literal["occupy", "release", "tool-use", "operate", "complete"]


class NodeReply(BaseModel):
    """One node as a model writes it."""

    model_config = ConfigDict(extra="ignore", coerce_numbers_to_str=True)

    id: str = Field(description="short name of the node, each used once")
    action: str = Field(description="one action of the grammar without its arm, for example Pick(Mug_1)")
    type: NodeKind = Field(description="what the action does to the hand")
    arms: Literal[1, 2] = Field(description="arms that the action takes")
    after: list[str] = Field(description="ids of the nodes that have to be done before")
    item: str | None = Field(default=None, description="release and tool-use: the object that the hand holds")
    at: str | None = Field(default=None, description="the furniture on or in which the action's object is")


class GraphReply(BaseModel):
    """The whole task."""

    model_config = ConfigDict(extra="ignore")

    reasoning: str = Field(default="", description="what has to be done and what can be done side by side, in two sentences")
    nodes: list[NodeReply] = Field(description="the nodes of the graph")


class RevisedGraph(BaseModel):
    """What is left of a task after a failure, with why it failed."""

    model_config = ConfigDict(extra="ignore")

    cause: str = Field(description="why the last step failed")
    change: str = Field(description="what has to be done differently")
    nodes: list[NodeReply] = Field(description="the nodes of a new graph for what is left to do")


@dataclass(frozen=True, slots=True)
class Node:
    """One sub-task.

    Attributes:
        id: its name.
        template: its action; the arm of an arm action is a placeholder, see `action`.
        kind: its type.
        after: nodes that have to be done before.
        item: what the hand holds after an occupy, or before a release or tool-use; None for others.
        at: where the action's object is said to be.
    """

    id: str
    template: Action
    kind: NodeKind
    after: tuple[str, ...] = ()
    item: str | None = None
    at: str | None = None

    @property
    def verb(self) -> str:
        """Name of the action."""
        return self.template.name

    @property
    def target(self) -> str | None:
        """The action's object."""
        return self.template.object_id

    @property
    def arms(self) -> int:
        """Arms that the action takes, 0 for what the body or nobody does."""
        return {ActionKind.ARM: 1, ActionKind.TWO_ARM: 2}.get(self.template.spec.kind, 0)

    @property
    def anchors(self) -> bool:
        """Whether the hand stays where the thing is, and the robot with it: a steadied object, a door held open."""
        return self.kind == "occupy" and self.verb in ("Hold", "Open")

    def action(self, arm: Arm | None) -> Action:
        """The action, done by an arm; None for what takes both or none."""
        return replace(self.template, arm=arm)

    def text(self) -> str:
        """The action as it is written in a graph, without an arm."""
        return f"{self.verb}({self.target or ''})" if self.arms == 1 else self.template.to_text()


@dataclass(frozen=True, slots=True)
class Graph:
    """Nodes in the order in which they were written.

    Attributes:
        nodes: all of them.
        ancestors: by node, everything that is done before it.
    """

    nodes: tuple[Node, ...]
    ancestors: Mapping[str, frozenset[str]]

    def dependents(self, node_id: str) -> frozenset[str]:
        """What waits for a node, directly or not."""
        return frozenset(node.id for node in self.nodes if node_id in self.ancestors[node.id])

    def renamed(self, names: Mapping[str, str]) -> Graph:
        """The graph with other object ids in place of those that `names` holds."""

        def new(name: str | None) -> str | None:
            return name if name is None else names.get(name, name)

        nodes = [
            replace(node, template=replace(node.template, object_id=new(node.target)), item=new(node.item), at=new(node.at))
            for node in self.nodes
        ]
        return replace(self, nodes=tuple(nodes))

    def objects(self) -> frozenset[str]:
        """All object ids that it names."""
        return frozenset(name for node in self.nodes for name in (node.target, node.item, node.at) if name is not None)
