"""Which graphs are accepted. All that is wrong is told at once, so that one repair call can mend it.

The occupy rule as it is read here: what one hand takes it puts down again, and between the two that thing is used as a tool and
taken by nothing else. The other hand and the body may do what they like meanwhile. What shall stay in the hand at the end has a
`complete` node after its occupy in place of a release: many tasks here end with something held, which the original's do not.
Paper: DAG-Plan, rules of its prompt; that the hands suffice is checked by us.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from typing import Final

from interface.actions import ACTIONS, ActionKind
from interface.bodies import Arm
from interface.effects import Grasp, HoldOpen, LetGo, PutDown
from interface.steps import Action, ActionError
from proprio_mllm.planners.chat.dag_plan.graph import Graph, Node, NodeKind, NodeReply
from proprio_mllm.planners.chat.dag_plan.hands import EMPTY, Capacity, Hands
from proprio_mllm.planners.chat.dag_plan.names import Vocabulary

#: Largest graph that is looked at.
_LARGEST: Final = 60
#: The actions of each type of node.
KINDS: Final[Mapping[NodeKind, tuple[str, ...]]] = {
    "occupy": tuple(name for name, spec in ACTIONS.items() if spec.has_effect(Grasp, HoldOpen)),
    "release": tuple(name for name, spec in ACTIONS.items() if spec.has_effect(PutDown, LetGo)),
    "tool-use": tuple(name for name, spec in ACTIONS.items() if spec.tool is not None),
    "operate": tuple(
        name
        for name, spec in ACTIONS.items()
        if spec.kind is not ActionKind.EPISODE and spec.tool is None and not spec.has_effect(Grasp, PutDown, LetGo)
    ),
    "complete": ("Done",),
}


class GraphError(ValueError):
    """A graph that cannot be carried out.

    Attributes:
        problems: what is wrong, one sentence each with the offending value.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = tuple(problems)


def check_graph(
    replies: Sequence[NodeReply], words: Vocabulary, hands: Hands = EMPTY, anchored: frozenset[str] = frozenset()
) -> Graph:
    """The graph that a reply means.

    Args:
        replies: its nodes.
        words: names that it may use.
        hands: what they hold before it starts.
        anchored: which of that they hold in place.

    Raises:
        GraphError: with all that is wrong at the first level where something is: nodes, order, hands.
    """
    if not 0 < len(replies) <= _LARGEST:
        raise GraphError([f"a graph has 1 to {_LARGEST} nodes, got {len(replies)}"])
    nodes, problems = _nodes(replies, words)
    _raise(problems)
    graph = Graph(nodes, _ancestors(nodes))
    _raise([*_ends(graph), *(problem for item in _items(graph) for problem in _held(graph, item, item in hands))])
    if not Capacity(graph, anchored).finishable(frozenset(), hands):
        full = ", ".join(sorted({item for item in hands if item is not None}))
        raise GraphError([f"two hands cannot do these nodes in any order, starting with {full or 'nothing'} in them"])
    return graph


def _raise(problems: Sequence[str]) -> None:
    if problems:
        raise GraphError(problems)


# ---- nodes, one by one


def _nodes(replies: Sequence[NodeReply], words: Vocabulary) -> tuple[tuple[Node, ...], list[str]]:
    ids = [reply.id for reply in replies]
    problems = [f"id {one!r} is used {ids.count(one)} times" for one in dict.fromkeys(ids) if ids.count(one) > 1]
    nodes: list[Node] = []
    for reply in replies:
        try:
            node = _node(reply)
        except ActionError as error:
            problems.append(f"{reply.id}: {error}")
            continue
        nodes.append(node)
        problems += [f"{node.id}: waits for {one!r}, which is no node" for one in node.after if one not in ids]
        for name in dict.fromkeys((node.target, node.item, node.at)):
            refusal = None if name is None else words.refusal(name)
            problems += [] if refusal is None else [f"{node.id}: {refusal}"]
    return tuple(nodes), problems


def _node(reply: NodeReply) -> Node:
    """A node with its action read.

    Raises:
        ActionError: when action, type, arms and item do not go together.
    """
    template = _template(reply.action)
    node = Node(reply.id, template, reply.type, tuple(dict.fromkeys(reply.after)), reply.item or None, reply.at or None)
    if node.verb not in KINDS[node.kind]:
        kinds = [kind for kind, verbs in KINDS.items() if node.verb in verbs]
        raise ActionError(f"type {node.kind!r} with {node.text()}; allowed for {node.verb}: {' or '.join(kinds)}")
    if node.arms and reply.arms != node.arms:
        raise ActionError(f"{node.text()} takes {node.arms} arms, got {reply.arms}")
    if node.kind in ("release", "tool-use"):
        if node.item is None:
            raise ActionError(f"{node.text()} needs the item that the hand holds")
        return node
    return Node(node.id, template, node.kind, node.after, node.target if node.kind == "occupy" else None, node.at)


def _template(text: str) -> Action:
    """An action written without its arm; arm actions get one as a placeholder."""
    name, opened, rest = text.strip().partition("(")
    spec = ACTIONS.get(name)
    if not opened or spec is None or spec.kind is not ActionKind.ARM:
        return Action.parse(text)
    arguments = [part.strip() for part in rest.rstrip().removesuffix(")").split(",") if part.strip()]
    if arguments and arguments[0].lower() in ("left", "right"):
        raise ActionError(f"{text[:80]!r} names an arm; leave it out, the scheduler chooses it")
    return Action.parse(f"{name}({', '.join((Arm.RIGHT.value, *arguments))})")


# ---- order


def _ancestors(nodes: Sequence[Node]) -> dict[str, frozenset[str]]:
    """Everything that is done before each node.

    Raises:
        GraphError: on a cycle, with its nodes.
    """
    direct = {node.id: node.after for node in nodes}
    try:
        order = tuple(TopologicalSorter(direct).static_order())
    except CycleError as error:
        raise GraphError([f"the nodes wait for each other in a circle: {' -> '.join(error.args[1])}"]) from None
    found: dict[str, frozenset[str]] = {}
    for one in order:
        found[one] = frozenset(direct[one]).union(*(found[before] for before in direct[one]))
    return found


def _ends(graph: Graph) -> list[str]:
    ends = [node.id for node in graph.nodes if node.kind == "complete"]
    problems = [f"{len(ends)} nodes end the task: {', '.join(ends)}"] if len(ends) > 1 else []
    return problems + [
        f"{', '.join(sorted(late))} after {one}, which ends the task" for one in ends if (late := graph.dependents(one))
    ]


# ---- hands


def _items(graph: Graph) -> list[str]:
    return list(dict.fromkeys(node.item for node in graph.nodes if node.item is not None))


def _held(graph: Graph, item: str, held: bool) -> list[str]:
    """What is wrong with the taking, using and putting down of one thing; `held` when a hand holds it from the start."""
    turns = [node for node in graph.nodes if node.item == item and node.kind in ("occupy", "release")]
    turns.sort(key=lambda node: len(graph.ancestors[node.id]))
    for first, second in zip(turns, turns[1:], strict=False):
        if first.id not in graph.ancestors[second.id]:
            return [f"{first.id} and {second.id} both take or put down {item}, and neither waits for the other"]
    uses = [node for node in graph.nodes if node.item == item and node.kind == "tool-use"]
    problems = [problem for node in uses for problem in _used(graph, node, turns, held)]
    taker: Node | None = None
    for node in turns:
        if node.kind == "occupy":
            problems += [f"{node.id}: {node.text()} while a hand already holds {item}"] if held else []
        elif not held:
            problems.append(f"{node.id}: {node.text()} without an occupy of {item} before it")
        elif taker is not None:
            problems += _released(node, taker)
        held, taker = node.kind == "occupy", node
    stays = any(node.kind == "complete" and taker is not None and taker.id in graph.ancestors[node.id] for node in graph.nodes)
    if taker is not None and held and not stays:
        problems.append(f"{taker.id}: {item} is taken and never put down; add its release, or a complete node after it")
    return problems


def _released(release: Node, taker: Node) -> list[str]:
    """What is wrong with how a thing is put down, given how it was taken."""
    if release.arms != taker.arms:
        return [f"{release.id}: {release.text()} with {release.arms} arms of what {taker.text()} took with {taker.arms}"]
    if taker.verb == "Open" and release.verb != "Release":
        return [f"{release.id}: {release.text()} of {taker.item}, which {taker.id} only holds open; Release() lets go of it"]
    return []


def _used(graph: Graph, use: Node, turns: Sequence[Node], held: bool) -> list[str]:
    """What is wrong with a use, given the takings and puttings down of its item in order."""
    earlier = [node for node in turns if node.id in graph.ancestors[use.id]]
    if not (earlier[-1].kind == "occupy" if earlier else held):
        return [f"{use.id}: {use.text()} is not after an occupy of {use.item}"]
    loose = [node.id for node in turns[len(earlier) :][:1] if use.id not in graph.ancestors[node.id]]
    return [f"{one}: puts {use.item} down without waiting for {use.id}, which uses it" for one in loose]
